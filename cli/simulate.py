"""``shapecat simulate``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import ANY_PATH, choice_option, seed_option
from .render import progress_bars

if TYPE_CHECKING:
    from shapecat.simulation.containers import FormatName
    from shapecat.simulation.scenes.kinds import SceneKind

_SCENES = ("tabletop", "shelf", "clutter", "pile", "bin", "shelf_bin", "room", "rows", "turntable",
           "walking", "crossing", "rearranged")  # fmt: skip
_SENSORS = (
    "kinect",
    "realsense",
    "kinect-v2",
    "azure-kinect",
    "d415",
    "d435",
    "d455",
    "sr300",
    "l515",
    "phone",
)
_SUFFIXES: "dict[FormatName, str]" = {"mcap": ".mcap", "ros1": ".bag", "ros2": ""}
"""Suffix by format. These three constants repeat the simulator's: ``--help`` must not load it."""


@click.command()
@click.argument("out", type=ANY_PATH)
@choice_option("--scene", _SCENES, "Kind of scene, listed above.", metavar="SCENE")
@click.option(
    "--format",
    "container",
    type=click.Choice(["mcap", "ros1", "ros2"]),
    help="Format of the recording; by default from the suffix of OUT.",
)
@choice_option("--sensor", _SENSORS, "Depth camera, listed above.", metavar="SENSOR")
@click.option(
    "--frames",
    type=click.IntRange(1),
    default=90,
    show_default=True,
    metavar="N",
    help="Number of frames, at 30 per second.",
)
@click.option("--clouds", is_flag=True, help="Write PointCloud2 instead of depth images.")
@click.option("--color", is_flag=True, help="Add a colour camera beside the depth camera.")
@click.option("--overwrite", is_flag=True, help="Replace an existing recording.")
@seed_option
def simulate(
    *,
    out: Path,
    scene: "SceneKind",
    container: "FormatName | None",
    sensor: str,
    frames: int,
    clouds: bool,
    color: bool,
    overwrite: bool,
    seed: int,
) -> None:
    """Simulate a recording of objects, with ground truth beside it.

    OUT is NAME.mcap, NAME.bag (ROS 1), or NAME for a ROS 2 bag. NAME.truth.json lists the
    objects in each frame; NAME.labels.npz says which object each depth pixel shows, and with
    --color, NAME.color_labels.npz which object each colour pixel shows.

    \b
    Scenes:
    tabletop    separate objects on a table
    shelf       objects on the three shelves of a rack
    clutter     objects close together and stacked on a table
    pile        objects dropped in a heap on a table
    bin         objects dropped into a bin
    shelf_bin   objects in a compartment of a rack, seen from the front
    room        a table among robot arms, people and furniture
    rows        similar objects in rows, grids and stacks
    turntable   a turntable in front of a fixed camera
    walking     a camera that moves along a counter and back
    crossing    two moving objects that occlude each other and others
    rearranged  objects that are added, removed, carried and pushed

    \b
    Sensors:
    kinect        Kinect v1, Xtion or Carmine, registered to the colour camera
    realsense     Intel D435 with its spatial filter
    kinect-v2     Kinect v2
    azure-kinect  Azure Kinect, narrow field of view
    d415          Intel D415 without filters
    d435          Intel D435 without filters
    d455          Intel D455 without filters
    sr300         Intel SR300 or F200
    l515          Intel L515 (lidar)
    phone         lidar of a phone

    \b
    shapecat simulate demo.mcap --scene clutter --frames 60 --seed 3
    """
    from shapecat.simulation import simulate as write_simulation
    from shapecat.simulation.files import require_replaceable, written_paths

    container = _format_of(out, container)
    # Even without --color, colour labels of another scene must not remain.
    there = [path for path in written_paths(out, container) if path.exists()]
    if there and not overwrite:
        require_replaceable(there[0])
        msg = f"{there[0]} exists already; --overwrite replaces it"
        raise click.UsageError(msg)
    with progress_bars() as bars:
        path = write_simulation(
            out,
            scene=scene,
            format=container,
            sensor=sensor,
            frames=frames,
            clouds=clouds,
            color=color,
            seed=seed,
            observe=bars,
        )
    click.echo(path)


def _format_of(out: Path, wanted: "FormatName | None") -> "FormatName":
    """Return the format that the suffix or the option names; reject a contradiction."""
    if out.name in {"", ".."}:
        msg = f"{out} is a folder: name a recording in it, such as demo.mcap"
        raise click.UsageError(msg)
    named = next((name for name, suffix in _SUFFIXES.items() if suffix == out.suffix), None)
    if named is None:
        stem = out.with_suffix("").name
        msg = f"{out.name}: name it {stem}.mcap, {stem}.bag, or {stem} for a ROS 2 folder"
        raise click.UsageError(msg)
    if wanted is None or wanted == named or not out.suffix:
        return wanted or named
    right = out.with_suffix(_SUFFIXES[wanted]).name
    kind = "a folder" if wanted == "ros2" else "a file"
    msg = f"--format {wanted} writes {kind}: name it {right}, not {out.name}"
    raise click.UsageError(msg)
