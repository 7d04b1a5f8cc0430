"""``shapecat info``."""

from pathlib import Path
from typing import Any

import click

from shapecat.errors import ShapecatError, common_exit_code, printable
from shapecat.outputs.counts import size_words

from .options import ANY_PATH, array_option
from .render import print_json, print_table


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=ANY_PATH, metavar="RECORDING...")
@array_option
@click.pass_context
def info(ctx: click.Context, /, *, recordings: tuple[Path, ...], as_json: bool) -> None:
    """List the topics of recordings, and the depth streams to process.

    Each RECORDING is an MCAP file, a ROS 1 bag, a ROS 2 bag (file or folder), or a folder
    with recordings.

    \b
    shapecat info lab.mcap
    shapecat info /data/recordings
    """
    from shapecat.batch.finding import find_recordings

    paths = [Path(source.path) for source in find_recordings(list(map(str, recordings))).sources]
    overviews, codes = [], []
    for path in paths:
        overview, code = _describe(path)
        codes.append(code)
        if overview is not None:
            overviews.append(overview)
            if not as_json:
                _show(overview)
    if as_json:
        print_json(overviews)
    ctx.exit(common_exit_code(codes))


def _describe(path: Path) -> tuple[dict[str, Any] | None, int]:
    """Return the contents of a recording, None if unreadable, and an exit code; print errors."""
    from shapecat.recordings.overview import describe_recording

    try:
        return describe_recording(path), 0
    except ShapecatError as error:
        click.echo(f"Error: {error}", err=True)
        return None, error.exit_code


def _show(overview: dict[str, Any]) -> None:
    click.echo(
        f"{overview['path']}: {overview['kind']}, {size_words(overview['bytes'])}, "
        f"{overview['seconds']:.1f} s long"
    )
    rows = [(t["name"], t["type"], t["encoding"], t["count"], t["use"]) for t in overview["topics"]]
    print_table(("topic", "type", "encoding", "messages", "use"), rows)
    for warning in overview["warnings"]:
        click.echo(printable(f"Warning: {warning}"))
