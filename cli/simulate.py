"""``shapecat simulate``."""

from pathlib import Path
from typing import Any

import click

from .options import ANY_PATH, seed_option
from .render import progress_bars


@click.command()
@click.argument("out", type=ANY_PATH)
@click.option(
    "--scene",
    type=click.Choice(
        ["tabletop", "shelf", "clutter", "turntable", "walking", "crossing", "rearranged"]
    ),
    default="tabletop",
    show_default=True,
)
@click.option(
    "--format",
    "container",
    type=click.Choice(["mcap", "ros1", "ros2"]),
    help="Recording format; by default what the suffix of OUT says, else mcap.",
)
@click.option("--sensor", type=click.Choice(["kinect", "realsense"]), default="kinect")
@click.option(
    "--frames", type=click.IntRange(1), default=90, show_default=True, help="30 per second."
)
@click.option("--clouds", is_flag=True, help="Write PointCloud2 instead of depth images.")
@seed_option
def simulate(
    *,
    out: Path,
    scene: Any,
    container: Any,
    sensor: Any,
    frames: int,
    clouds: bool,
    seed: int,
) -> None:
    """Make a recording of simulated objects, with the truth beside it.

    OUT.truth.json says what stands where in each frame; OUT.labels.npz which pixel is whose.

    \b
    shapecat simulate demo.mcap --scene clutter --frames 60 --seed 3
    """
    from shapecat.simulation import simulate as write_simulation

    if container is None:
        container = {".bag": "ros1", "": "ros2"}.get(out.suffix, "mcap")
    with progress_bars() as bars:
        path = write_simulation(
            out,
            scene=scene,
            format=container,
            sensor=sensor,
            frames=frames,
            clouds=clouds,
            seed=seed,
            observe=bars,
        )
    click.echo(path)
