"""``shapecat annotate``."""

from pathlib import Path
from typing import Any

import click

from .options import ANY_PATH, BOXES, BOXES_HELP
from .render import missed_words, progress_bars


@click.command()
@click.argument("run", type=ANY_PATH)
@click.option("--labels", type=ANY_PATH, help="The corrected table; RUN/tracks.csv by default.")
@click.option(
    "--by-place",
    is_flag=True,
    help="LABELS is the table, or folder, of another run: label the objects in the same places.",
)
@click.option("--boxes", type=click.Choice(BOXES), help=BOXES_HELP)
@click.option("--recording", type=ANY_PATH, help="Where the recording is now, if it was moved.")
def annotate(
    *,
    run: Path,
    labels: Path | None,
    by_place: bool,
    boxes: str | None,
    recording: Path | None,
) -> None:
    """Write annotated.mcap and review.rrd again after tracks.csv was corrected.

    Fill the column `label` of RUN/tracks.csv in a spreadsheet: a category, or a name of your own.

    \b
    shapecat annotate results/lab --labels corrected.csv
    shapecat annotate again/lab --labels results/lab --by-place
    """
    from shapecat.pipeline import annotate_again

    if by_place and labels is None:
        msg = "--by-place needs --labels: the table, or folder, of the other run"
        raise click.UsageError(msg)
    with progress_bars() as bars:
        transfer = annotate_again(
            run, labels, bars, by_place=by_place, boxes=boxes, recording=recording
        )
    click.echo(f"{run}: wrote annotated.mcap and review.rrd")
    if transfer is not None:
        _show(transfer.as_dict(), labels)


def _show(transfer: dict[str, Any], labels: Path | None) -> None:
    from shapecat.runs.label_transfer import TABLE_ALONE

    done, missed = transfer["transferred"], transfer["not_transferred"]
    click.echo(f"{len(done)} of {len(done) + len(missed)} labels have found their objects")
    if transfer["by"] == TABLE_ALONE:
        text = "the run is not beside the table: assumed to have the same fixed frame, and that"
        click.echo(
            f"{labels}: {text} nothing was moved; give the run's folder to be sure", err=True
        )
    for item in missed:
        click.echo(missed_words(item), err=True)
