"""``shapecat view``."""

import subprocess
from contextlib import suppress
from pathlib import Path

import click

from shapecat.system import stopping

from .options import ANY_PATH


@click.command()
@click.argument("run", type=ANY_PATH)
@click.option(
    "--web", is_flag=True, help="Serve the viewer to a browser on this machine until Ctrl+C."
)
@click.option(
    "--screenshot",
    type=ANY_PATH,
    metavar="PNG",
    help="Write a screenshot instead of opening a window.",
)
def view(*, run: Path, web: bool, screenshot: Path | None) -> None:
    """Open the review.rrd of a run in the Rerun viewer.

    \b
    shapecat view results/lab
    shapecat view results/lab --web
    shapecat view results/lab --screenshot lab.png
    """
    from shapecat.outputs.review.viewer import open_viewer, take_screenshot
    from shapecat.runs.folder import read_run
    from shapecat.system.files import require_writable

    if web and screenshot is not None:
        msg = "--web and --screenshot exclude each other"
        raise click.UsageError(msg)
    if screenshot is not None and screenshot.suffix.lower() != ".png":
        msg = f"--screenshot {screenshot}: name it .png"
        raise click.UsageError(msg)
    review = run if run.suffix.lower() == ".rrd" else run / "review.rrd"
    if not review.is_file():
        read_run(run)  # raises if there is no run
    if screenshot is not None:
        require_writable(screenshot)
        take_screenshot(review, screenshot)
        click.echo(screenshot)
    elif web:
        _serve(review)
    else:
        open_viewer(review)


def _serve(review: Path) -> None:
    """Serve until the viewer ends or a signal arrives."""
    from shapecat.outputs.review.viewer import serve_viewer

    message = stopping.stop_message("stopping the viewer")
    with serve_viewer(review) as (address, viewer), message:
        click.echo(address)
        while viewer.poll() is None and not stopping.asked():
            with suppress(subprocess.TimeoutExpired):
                viewer.wait(0.1)
