"""``shapecat compare``."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from shapecat.outputs.counts import plural

from .options import ANY_PATH, json_option, recording_option
from .render import print_json, print_table, progress_bars

if TYPE_CHECKING:
    from shapecat.evaluation.comparison import Comparison


@click.command()
@click.argument("run", type=ANY_PATH)
@click.argument("truth", type=ANY_PATH)
@click.option(
    "--out",
    type=ANY_PATH,
    help="New folder for three files: a page with pictures, a table of all objects, and the "
    "metrics as JSON.",
)
@recording_option
@json_option
def compare(
    *, run: Path, truth: Path, out: Path | None, recording: Path | None, as_json: bool
) -> None:
    """Compare a run with ground truth, other labels, or another run.

    TRUTH is the NAME.truth.json that `shapecat simulate` writes, or the simulated recording beside
    that file; a COCO file; a KITTI folder that contains label_2; or another run of the same
    recording.
    Frames are matched by timestamp, or by number if TRUTH has no timestamps.

    \b
    shapecat compare results/demo demo.truth.json
    shapecat compare results/lab results-before/lab --out differences
    """
    from shapecat.evaluation.comparison import compare as compare_run
    from shapecat.evaluation.comparison.page import figure_rows, prepare_new, write_comparison

    if out is not None:
        prepare_new(out)
    with progress_bars() as bars:
        comparison = compare_run(run, truth, recording=recording, observe=bars)
    if out is not None:
        write_comparison(out, comparison)
    if as_json:
        print_json(comparison.as_dict())
        return
    _print(comparison, figure_rows(comparison))
    if out is not None:
        click.echo(f"\n{out / 'comparison.html'}")


def _print(comparison: "Comparison", rows: Sequence[Sequence[str]]) -> None:
    """Print ``rows`` of metric, value and meaning, then the number of differences of each kind."""
    click.echo(f"{comparison.run} compared with {comparison.reference} ({comparison.kind})\n")
    print_table(("metric", "value", "meaning"), rows)
    click.echo(f"\n{_describe_differences(comparison.as_dict()['differences'])}")
    for note in comparison.notes:
        click.echo(note, err=True)


def _describe_differences(counts: dict[str, int]) -> str:
    if not counts:
        return "no differences"
    parts = [f"{count} {kind}" for kind, count in Counter(counts).most_common()]
    return f"{plural(sum(counts.values()), 'difference')}: {', '.join(parts)}"
