"""``shapecat view``."""

from pathlib import Path

import click

from .options import ANY_PATH


@click.command()
@click.argument("run", type=ANY_PATH)
@click.option("--screenshot", type=ANY_PATH, metavar="PNG", help="Draw it to a file, no window.")
def view(*, run: Path, screenshot: Path | None) -> None:
    """Open the review of a run in the Rerun viewer.

    \b
    shapecat view results/lab
    shapecat view results/lab --screenshot lab.png
    """
    from shapecat.outputs.review_viewer import open_viewer, take_screenshot

    review = run / "review.rrd" if run.is_dir() else run
    if screenshot is None:
        open_viewer(review)
    else:
        take_screenshot(review, screenshot)
        click.echo(screenshot)
