"""``shapecat report``."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from shapecat.system import stopping

from .options import ANY_PATH
from .render import progress_bars

if TYPE_CHECKING:
    from shapecat.outputs.report import Reports


@click.command()
@click.argument("folders", nargs=-1, required=True, type=ANY_PATH, metavar="DIR...")
@click.option("--serve", is_flag=True, help="Serve the pages to this machine until Ctrl+C.")
@click.option(
    "--port", type=click.IntRange(0, 65535), help="Port of --serve; by default one that is free."
)
def report(*, folders: tuple[Path, ...], serve: bool, port: int | None) -> None:
    """Make a page per run, to review and correct its tracks in a browser.

    Each DIR is a run, or a folder of runs, which also gets an index.html. The page needs no
    network and can be mailed; download the corrected tracks.csv and apply it with
    `shapecat annotate`. With --serve the page writes corrections to RUN/tracks.csv as you make
    them.

    \b
    shapecat report results
    shapecat annotate results/lab --labels ~/Downloads/tracks.csv

    \b
    shapecat report results/lab --serve
    shapecat annotate results/lab
    """
    from shapecat.outputs.report import read_reports

    if port is not None and not serve:
        msg = "--port needs --serve"
        raise click.UsageError(msg)
    with progress_bars() as bars:
        reports = read_reports(folders, bars)
        pages = reports.write()
    if serve:
        _serve(reports, port or 0)
        return
    for page in pages:
        click.echo(page)


def _serve(reports: "Reports", port: int) -> None:
    """Serve until a signal comes; then the pages hold the corrections as well."""
    from shapecat.outputs.report.serving import serve_reports

    with serve_reports(reports, port=port) as address:
        click.echo(address)
        click.echo("corrections go to tracks.csv as you make them; Ctrl+C ends", err=True)
        try:
            while True:
                stopping.check()
                time.sleep(0.1)
        finally:
            reports.write()
