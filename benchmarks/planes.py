"""Detection of a table's plane where little of the image shows which way is up.

    python -m benchmarks.planes --first 730000 --count 100

Detection gets one frame of each simulated table, and no up direction. Four fifths of the table are
covered with flat boxes, or the table fills only a fifth of the image, or the camera looks down by 8
to 85 degrees, or the table is a counter in front of a wall, above a cupboard.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import click
import numpy as np
from numpy.random import Generator

from benchmarks.measure import markdown
from benchmarks.scenes import Array, detected
from shapecat.geometry import inverse
from shapecat.simulation import KINECT, PlacedObject, Support, World, make_scene, render_frame
from shapecat.simulation.camera.render import render
from shapecat.simulation.scenes.furniture import WALL, make_room, make_table
from shapecat.simulation.scenes.paths import looking_at
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.parts import placed
from shapecat.simulation.shapes.primitives import rounded_box
from shapecat.types import CATEGORIES, Camera, Frame, Pose, Scene

HEIGHT_M, TILT_COS = 0.02, float(np.cos(np.radians(4)))
"""Maximum distance of a found plane above or below the table, and cosine of its maximum tilt."""
COVERED, SHOWN, SEEN = 0.8, 0.2, 0.01
"""Fraction of a covered table under boxes; fraction of the image filled by a cut table and its
objects; least fraction of the image in which a covered table is visible between its boxes."""
PREVIEW = Camera(80, 60, 65.6, 65.6, 39.5, 29.5)
"""A Kinect at an eighth of its resolution, to see quickly what an image would show."""


def covered(rng: Generator) -> World:
    """Cover four fifths of a table with a dozen or more flat boxes with narrow gaps."""
    while True:
        table = make_table(rng, tuple(rng.uniform([0.6, 0.45], [0.9, 0.65])))
        supports = (*make_room(rng, wall_chance=0.3), table)
        path = (_view(rng, table, rng.uniform(25, 65), rng.uniform(0.8, 1.2)),)
        world = World("covered", supports, _flat_boxes(rng, table), path)
        if _shown(world)[0] > SEEN:
            return world


def _flat_boxes(rng: Generator, table: Support) -> tuple[PlacedObject, ...]:
    half = np.abs(table.outline[:, :2]).max(axis=0)
    fill = rng.uniform(np.sqrt(COVERED), 0.97)  # side of a box relative to its tile
    tiles = list(_tiles(rng, -half, half, int(rng.integers(14, 28))))
    objects: list[PlacedObject] = []
    left = COVERED * np.prod(2 * half)
    for k in rng.permutation(len(tiles)):
        low, high = tiles[k]
        size = fill * (high - low)
        middle = (low + high) / 2 + rng.uniform(-0.5, 0.5, 2) * (1 - fill) * (high - low)
        pose = Pose(np.eye(3), np.round([*middle, table.height], 6))
        mesh = rounded_box([*size, rng.uniform(0.02, 0.06)], fine=1)
        objects.append(PlacedObject(len(objects), "box", "box", mesh, pose, table.name, None))
        left -= np.prod(size)
        if left < 0:
            break
    return tuple(objects)


def _tiles(rng: Generator, low: Array, high: Array, count: int) -> Iterator[tuple[Array, Array]]:
    """Divide a rectangle recursively, across its longer side, into ``count`` tiles.

    Yields the lowest and the highest corner (2,) of each tile.
    """
    if count == 1:
        yield low, high
        return
    first, axis = round(count * rng.uniform(0.4, 0.6)), int(np.argmax(high - low))
    first = min(max(first, 1), count - 1)
    middle = (np.arange(2) == axis) * (high - low) * first / count
    other = (np.arange(2) != axis) * (high - low)
    yield from _tiles(rng, low, low + middle + other, first)
    yield from _tiles(rng, low + middle, high, count - first)


def cut(rng: Generator) -> World:
    """Look past a cluttered table so that it fills only a fifth of the image."""
    while True:
        world = make_scene("clutter", rng, frames=1)
        pose, angle = world.path[0], rng.uniform(0, 2 * np.pi)
        aside = np.cos(angle) * pose.rotation[:, 0] + np.sin(angle) * pose.rotation[:, 1]
        near, far = 0.0, 1.3
        for _ in range(8):
            turn = (near + far) / 2
            gaze = np.cos(turn) * pose.rotation[:, 2] + np.sin(turn) * aside
            world = replace(world, path=(looking_at(pose.translation, pose.translation + gaze),))
            near, far = (turn, far) if sum(_shown(world)) > SHOWN else (near, turn)
        if sum(_shown(world)) > SHOWN / 2:  # else the table is nearer than a Kinect can measure
            return world


def _shown(world: World) -> tuple[float, float]:
    """Return the fraction of the image that shows the table, and that of the objects on it."""
    seen = render(world.geometry(0), PREVIEW, world.path[0])
    mesh_ids = np.where(seen.depth > KINECT.nearest_m, seen.mesh_ids, -1)
    table = mesh_ids == world.supports.index(_table(world))
    return float(table.mean()), float((mesh_ids >= len(world.supports)).mean())


def tilted(rng: Generator) -> World:
    """Look at a cluttered table from a random elevation between 8 and 85 degrees."""
    world = make_scene("clutter", rng, frames=1)
    pose = _view(rng, _table(world), rng.uniform(8, 85), rng.uniform(0.65, 1.3))
    return replace(world, path=(pose,))


def counter(rng: Generator) -> World:
    """Look at a counter with objects that fills less of the image than the wall behind it."""
    table = make_table(rng, (rng.uniform(1.1, 2.0), rng.uniform(0.28, 0.55)))
    half, height = table.outline[:, :2].max(axis=0), table.height
    wall = rounded_box([2 * half[0], 0.02, height + 0.8], fine=10)
    front = rounded_box([2 * half[0], 0.02, height - 0.05], fine=10)
    supports = (
        table,
        Support("wall", WALL, placed(wall, [0, half[1] + 0.01, 0])),
        Support("front", WALL, placed(front, [0, 0.03 - half[1], 0])),
    )
    objects = []
    for k, x in enumerate(rng.permutation(np.linspace(-0.4, 0.4, 5))[: rng.integers(2, 6)]):
        category = str(rng.choice(CATEGORIES))
        pose = Pose(np.eye(3), np.round([x, rng.uniform(-0.3, 0.3) * half[1], height], 6))
        mesh = make_object(category, rng)
        objects.append(PlacedObject(k, category, category, mesh, pose, table.name, None))
    path = (_view(rng, table, rng.uniform(15, 60), rng.uniform(0.6, 1.3)),)
    return World("counter", supports, tuple(objects), path)


def _view(rng: Generator, table: Support, elevation: float, distance: float) -> Pose:
    up, side = np.radians(elevation), rng.uniform(-2.1, -1.0)
    target = np.array([*rng.uniform(-0.05, 0.05, 2), table.height])
    flat = np.cos(up)
    eye = target + distance * np.array([flat * np.cos(side), flat * np.sin(side), np.sin(up)])
    return looking_at(eye, target, roll=float(np.radians(rng.normal(0, 3))))


SCENES: dict[str, Callable[[Generator], World]] = {
    "covered to four fifths": covered,
    "cut to a fifth": cut,
    "8 to 85 degrees": tilted,
    "counter before a wall": counter,
}


def view_of(kind: str, seed: int) -> tuple[World, Frame]:
    """Return a scene of a kind and a Kinect frame of it."""
    rng = np.random.default_rng(seed)
    world = SCENES[kind](rng)
    return world, render_frame(world, 0, rng=rng, sensor=KINECT)[0]


def keeps_table(world: World, found: Scene) -> bool:
    """Return whether one of the found planes is the table."""
    pose = inverse(world.path[0])
    up, height = pose.rotation[:, 2], _table(world).height - world.path[0].translation[2]
    return any(
        plane.normal @ up > TILT_COS and abs(plane.offset - height) < HEIGHT_M
        for plane in found.planes
    )


def _table(world: World) -> Support:
    return next(support for support in world.supports if support.name == "table")


@click.command(help=__doc__)
@click.option("--first", default=730000, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=100, show_default=True, help="Scenes of each kind.")
def main(*, first: int, count: int) -> None:
    """Print the number of scenes in which the table is found, and the seeds of the others."""
    rows = []
    for kind in SCENES:
        lost = []
        for seed in range(first, first + count):
            world, frame = view_of(kind, seed)
            if not keeps_table(world, detected(frame)):
                lost.append(seed)
        rows.append((kind, f"{count - len(lost)} of {count}", " ".join(map(str, lost)) or "-"))
    title = f"Planes of tables without a hint of up, scenes {first} to {first + count - 1}"
    print(markdown(title, ("scenes", "table kept", "lost"), rows))


if __name__ == "__main__":
    main()
