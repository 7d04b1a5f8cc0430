"""``shapecat annotate``."""

from pathlib import Path
from typing import Any

import click

from shapecat.outputs.counts import plural

from .options import ANY_PATH, boxes_option
from .render import changed_labels, describe_missed, progress_bars


@click.command()
@click.argument("run", type=ANY_PATH)
@click.option(
    "--labels",
    type=ANY_PATH,
    metavar="LABELS",
    help="Corrected table; its labels are copied into RUN/tracks.csv. By default, the labels in "
    "RUN/tracks.csv are applied.",
)
@click.option(
    "--by-place",
    is_flag=True,
    help="LABELS is another run, or its tracks.csv: transfer its labels to the objects at "
    "the same places.",
)
@boxes_option("In annotated.mcap, {}; if not given, boxes are not changed.")
@click.option(
    "--recording", type=ANY_PATH, help="New path of a moved recording; stored in run.json."
)
def annotate(
    *, run: Path, labels: Path | None, by_place: bool, boxes: str | None, recording: Path | None
) -> None:
    """Apply corrected labels to the files of a run.

    Fill in the column `label` of RUN/tracks.csv in a spreadsheet, or correct tracks in the page
    that `shapecat report` makes. A label is a category, the name of a new category, `delete`, or
    `merge with N` for the number N of another track. The labels are written to tracks.csv,
    annotated.mcap and review.rrd.

    \b
    shapecat annotate results/lab --labels corrected.csv
    shapecat annotate again/lab --labels results/lab --by-place
    """
    from shapecat.pipeline import annotate_again
    from shapecat.runs.folder import OUTPUTS

    if by_place and labels is None:
        msg = "--by-place needs --labels: the folder or the tracks.csv of the other run"
        raise click.UsageError(msg)
    if labels is not None and labels.is_dir() and not by_place:
        msg = f"--labels {labels}: is a folder; name the table in it, or add --by-place"
        raise click.UsageError(msg)
    before = _labels_of(run)
    with progress_bars() as bars:
        transfer = annotate_again(
            run, labels, bars, by_place=by_place, boxes=boxes, recording=recording
        )
    written = [name for name in OUTPUTS if (run / name).exists()]
    click.echo(f"{run}: wrote {' and '.join(written) or 'only its tables'}")
    if changes := changed_labels(before, _labels_of(run)):
        click.echo(f"{run}: {changes}")
        if (run / "report.html").exists():
            click.echo(f"report.html shows the earlier labels; renew it: shapecat report {run}")
    if transfer is not None:
        _show(transfer.as_dict(), labels)
    _warn_of_far_merges(run)


def _labels_of(run: Path) -> dict[int, str]:
    """Return the label of each track of a run; empty if it has no readable table."""
    from shapecat.errors import OutputError
    from shapecat.runs.labels.track_table import read_track_table

    try:
        return read_track_table(run / "tracks.csv").labels
    except OutputError:
        return {}


def _warn_of_far_merges(run: Path) -> None:
    """Print to stderr the merged tracks that are too far apart to be one object."""
    from shapecat.errors import listed
    from shapecat.runs.finished import read_finished
    from shapecat.runs.labels.far_merges import far_merges

    if gaps := far_merges(run, read_finished(run).labels):
        pairs = [
            f"#{a} and #{b} ({100 * distance:.0f} cm apart in {plural(frames, 'frame')})"
            for (a, b), frames, distance in gaps
        ]
        text = "merged tracks are in different places at the same time"
        click.echo(f"Warning: {text}: {listed(pairs)}; check the labels", err=True)


def _show(transfer: dict[str, Any], labels: Path | None) -> None:
    from shapecat.runs.labels.transfer import TABLE_ALONE

    done, missed = transfer["transferred"], transfer["not_transferred"]
    click.echo(f"{len(done)} of {len(done) + len(missed)} labels transferred")
    if transfer["by"] == TABLE_ALONE:
        text = "this table is not in a run folder, so shapecat assumes the same fixed frame and"
        click.echo(f"{labels}: {text} unmoved objects; give the run folder to check both", err=True)
    for item in missed:
        click.echo(describe_missed(item), err=True)
