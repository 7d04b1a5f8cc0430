"""Output of the commands: progress on stderr, results on stdout. Rich loads on first use."""

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import click

from shapecat.errors import printable
from shapecat.outputs.counts import plural
from shapecat.system import stopping

PHASES = {
    "simulate": "simulating",
    "perceive": "finding and categorizing objects",
    "revise": "revising uncertain frames",
    "annotate": "writing annotated.mcap",
    "review": "writing review.rrd",
    "report": "drawing reports",
    "export": "exporting",
    "train": "training",
    "baselines": "comparing classifiers",
    "evaluate": "evaluating",
    "compare": "comparing",
}
"""What progress displays call each phase."""

_WIDEST = 100_000
"""Width, in characters, of tables for a file or another program; their lines are not folded."""


class Bars:
    """One progress bar per phase; silent when stderr is not a terminal."""

    def __init__(self, progress: Any) -> None:
        self._progress = progress
        self._tasks: dict[str, Any] = {}

    def __call__(self, phase: str, done: int, total: int | None) -> None:
        """Show the progress of a phase; raise `Stopped` after a signal."""
        stopping.check()
        if phase not in self._tasks:
            name = PHASES.get(phase, phase)
            self._tasks[phase] = self._progress.add_task(name, total=total)
        self._progress.update(self._tasks[phase], completed=done, total=total)


def rich_progress() -> Any:
    """Return progress bars for stderr, not yet started."""
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TimeRemainingColumn(),
    )
    return rich.Progress(*columns, console=Console(stderr=True, markup=False, emoji=False))


@contextmanager
def progress_bars() -> Iterator[Bars]:
    """Show progress bars on stderr, if it is a terminal, while the block runs."""
    progress = rich_progress()
    progress.disable = not sys.stderr.isatty()  # Rich would obey FORCE_COLOR
    with progress:
        yield Bars(progress)


def print_json(value: Any) -> None:
    """Print one JSON value; non-ASCII characters are escaped unless stdout is UTF-8."""
    as_it_is = sys.stdout.encoding.lower() == "utf-8"
    click.echo(json.dumps(value, indent=1, ensure_ascii=not as_it_is))


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table with right-aligned columns of numbers; text is not interpreted as markup.

    On a terminal, cells are wrapped to fit its width.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for k, name in enumerate(columns):
        numeric = bool(rows) and all(isinstance(row[k], int | float) for row in rows)
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(printable(str(cell)) for cell in row))
    width = None if sys.stdout.isatty() else _WIDEST  # Rich would obey FORCE_COLOR
    console = Console(width=width, markup=False, emoji=False)
    with console.capture() as printed:  # Rich would end the process if nobody reads
        console.print(table)
    click.echo(printed.get(), nl=False)


@contextmanager
def for_any_reader() -> Iterator[None]:
    """Let the block print to stdout; a reader that stops early, such as `head`, causes no error."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        discard_stdout()


def discard_stdout() -> None:
    """Discard the buffered output that stdout could not write, and all further output."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def note_off_support(categories: Sequence[str]) -> None:
    """Warn on stderr of categories whose views are probably in another coordinate frame."""
    if categories:
        text = "most views do not stand at z = 0: z must point up, with the support at z = 0"
        click.echo(f"Warning: {', '.join(categories)}: {text}", err=True)


def note_skipped(learned: Mapping[str, Any]) -> None:
    """Report on stderr the defective views in the data set of `train` or `learn`.

    It names the number of skipped views, the folders without a usable view, and the categories
    whose views mostly do not stand at z = 0. ``learned`` is the result of `train_on_folder` or
    `learn_on_folder`.
    """
    note_off_support(learned["off_support"])
    if learned["skipped"]:
        views = plural(learned["skipped"], "view")
        click.echo(f"skipped {views} with too few points for a surface", err=True)
    if learned["lost"]:
        names = ", ".join(learned["lost"])
        click.echo(f"Warning: {names}: no usable views (.pcd, .ply or .npz)", err=True)


def describe_missed(missed: Mapping[str, Any]) -> str:
    """Describe a label that was not transferred, with the reason, from a `Missed` as a dict."""
    what = f"track #{missed['old_track']}, {missed['label']}: " if missed["old_track"] else ""
    return f"  {what}{missed['reason']}"


def changed_labels(before: Mapping[int, str], after: Mapping[int, str]) -> str:
    """Describe how the labels of tracks changed: ``2 labels set, 1 label cleared (#3 bowl)``."""
    changed = [k for k in after if after[k] != before.get(k, "")]
    tracks_by_change = {
        "set": [k for k in changed if not before.get(k)],
        "replaced": [k for k in changed if before.get(k) and after[k]],
        "cleared": [k for k in before if before[k] and not after.get(k)],
    }
    parts = []
    for change, tracks in tracks_by_change.items():
        lost = ", ".join(f"#{k} {before[k]}" for k in tracks if before.get(k))
        if tracks:
            parts.append(f"{plural(len(tracks), 'label')} {change}{f' ({lost})' if lost else ''}")
    return ", ".join(parts)
