"""``shapecat report``."""

from pathlib import Path

import click

from .options import ANY_PATH
from .render import progress_bars


@click.command()
@click.argument("folders", nargs=-1, required=True, type=ANY_PATH, metavar="DIR...")
def report(*, folders: tuple[Path, ...]) -> None:
    """Make a page per run, to review and correct its tracks in a browser.

    Each DIR is a run, or a folder of runs, which also gets an index.html. Click categories on the
    page, download the corrected tracks.csv, and apply it with `shapecat annotate`.

    \b
    shapecat report results
    shapecat annotate results/lab --labels ~/Downloads/tracks.csv
    """
    from shapecat.outputs.report import write_reports

    with progress_bars() as bars:
        pages = write_reports(folders, bars)
    for page in pages:
        click.echo(page)
