"""``shapecat annotate``."""

from pathlib import Path

import click

from .options import ANY_PATH
from .render import progress_bars


@click.command()
@click.argument("run", type=ANY_PATH)
@click.option("--labels", type=ANY_PATH, help="The corrected table; RUN/tracks.csv by default.")
def annotate(*, run: Path, labels: Path | None) -> None:
    """Write annotated.mcap and review.rrd again after tracks.csv was corrected.

    Fill the column `label` of RUN/tracks.csv in a spreadsheet: a category, or a name of your own.
    The recording must be where it was when it was processed.

    \b
    shapecat annotate results/lab --labels corrected.csv
    """
    from shapecat.pipeline import annotate_again

    with progress_bars() as bars:
        annotate_again(run, labels, bars)
    click.echo(f"{run}: annotated.mcap and review.rrd are up to date")
