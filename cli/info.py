"""``shapecat info``."""

from pathlib import Path
from typing import Any

import click

from .options import ANY_PATH, json_option
from .render import print_json, print_table


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=ANY_PATH)
@json_option
def info(*, recordings: tuple[Path, ...], as_json: bool) -> None:
    """Show what a recording holds, and which cloud streams can be processed.

    \b
    shapecat info lab.mcap
    """
    from shapecat.recordings.overview import describe_recording

    overviews = [describe_recording(path) for path in recordings]
    if as_json:
        print_json(overviews)
        return
    for overview in overviews:
        _show(overview)


def _show(overview: dict[str, Any]) -> None:
    click.echo(
        f"{overview['path']}: {overview['kind']}, {overview['bytes'] / 1e6:.1f} MB, "
        f"{overview['seconds']:.1f} s"
    )
    rows = [(t["name"], t["type"], t["encoding"], t["count"], t["use"]) for t in overview["topics"]]
    print_table(("topic", "type", "encoding", "messages", "use"), rows)
    for warning in overview["warnings"]:
        click.echo(f"warning: {warning}")
