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
@click.option("--serve", is_flag=True, help="Serve the pages on this machine until Ctrl+C.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    metavar="PORT",
    help="Port of --serve; by default a free one.",
)
@click.pass_context
def report(
    ctx: click.Context, /, *, folders: tuple[Path, ...], serve: bool, port: int | None
) -> None:
    """Make a page per run to review and correct tracks in a browser.

    Each DIR is a run (RUN), or a folder of runs. The page of a run is RUN/report.html. For several
    runs, an index.html is also written to the folder that contains them all. A page needs no
    network and can be sent by e-mail. Download the corrected table from it and apply it with
    `shapecat annotate`. With --serve, the page writes corrections to RUN/tracks.csv as you make
    them; `shapecat annotate RUN` then applies them to the other files. If a recording was moved,
    first run `shapecat annotate RUN --recording PATH`.

    \b
    shapecat report results
    shapecat annotate results/lab --labels downloaded.csv

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
    for error in reports.failed.values():
        click.echo(f"Error: {error}", err=True)
    if serve and reports.runs:
        _serve(reports, port or 0)
    elif not serve:
        for page in pages:
            click.echo(page)
    ctx.exit(1 if reports.failed else 0)


def _serve(reports: "Reports", port: int) -> None:
    """Serve until a signal arrives, then write the pages again with the corrections."""
    from shapecat.outputs.report.serving import serve_reports

    message = stopping.stop_message("stopping the server")
    with serve_reports(reports, port=port) as address, message:
        click.echo(address)
        click.echo(
            "corrections are written to tracks.csv as you make them; Ctrl+C stops the server",
            err=True,
        )
        try:
            while not stopping.asked():
                time.sleep(0.1)
        finally:
            reports.write()
