"""``shapecat compare``."""

from pathlib import Path
from typing import Any

import click

from shapecat.outputs.counts import plural

from .options import ANY_PATH, json_option, recording_option
from .render import print_json, print_table, progress_bars


@click.command()
@click.argument("run", type=ANY_PATH)
@click.argument("truth", type=ANY_PATH)
@click.option(
    "--out",
    type=ANY_PATH,
    help="New folder for a page with pictures, a table of all objects, and the metrics as JSON.",
)
@recording_option
@json_option
def compare(
    *, run: Path, truth: Path, out: Path | None, recording: Path | None, as_json: bool
) -> None:
    """Compare a run with ground truth, other labels, or another run.

    TRUTH is the NAME.truth.json that `shapecat simulate` writes (or the recording beside it), a
    COCO file, a KITTI folder that contains label_2, or another run of the same recording.
    Frames are matched by timestamp, or by number if TRUTH has no timestamps.

    \b
    shapecat compare results/demo demo.truth.json
    shapecat compare results/lab results-before/lab --out differences
    """
    from shapecat.evaluation.comparison import compare as compare_run
    from shapecat.evaluation.comparison.page import figure_rows, require_new, write_comparison

    if out is not None:
        require_new(out)
    with progress_bars() as bars:
        found = compare_run(run, truth, recording=recording, observe=bars)
    if out is not None:
        write_comparison(out, found)
    if as_json:
        print_json(found.as_dict())
        return
    _print(found, figure_rows(found))
    if out is not None:
        click.echo(f"\n{out / 'comparison.html'}")


def _print(found: Any, rows: Any) -> None:
    """Print the metrics, then the number of differences of each kind."""
    click.echo(f"{found.run} compared with {found.reference} ({found.kind})\n")
    print_table(("metric", "value", "meaning"), rows)
    kinds = found.as_dict()["differences"]
    click.echo(f"\n{_words(kinds)}")
    for note in found.notes:
        click.echo(note, err=True)


def _words(kinds: dict[str, int]) -> str:
    if not kinds:
        return "no differences"
    parts = [f"{count} {name}" for name, count in sorted(kinds.items(), key=lambda i: -i[1])]
    return f"{plural(sum(kinds.values()), 'difference')}: {', '.join(parts)}"
