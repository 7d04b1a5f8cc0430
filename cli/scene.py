"""``shapecat scene``."""

from pathlib import Path

import click

from .options import ANY_PATH


@click.command()
@click.argument("run", type=ANY_PATH)
@click.option(
    "--frame",
    type=click.IntRange(0),
    required=True,
    metavar="N",
    help="Number of the frame on its topic, from 0.",
)
@click.option("--topic", metavar="TOPIC", help="Topic of the frame, if the run has several.")
def scene(*, run: Path, frame: int, topic: str | None) -> None:
    """Print the planes of one frame, and the objects on them.

    Tracks that a person merged are one object; tracks that a person deleted are left out.

    \b
    shapecat scene results/lab --frame 12
    """
    from shapecat.outputs.scene_tree import describe_scene

    click.echo(describe_scene(run, frame, topic=topic))
