"""Floors, walls, tables, shelves and bins; lengths in metres, z up."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.scenes.worlds import Support
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.parts import placed
from shapecat.simulation.shapes.primitives import extrude, rounded_box

__all__ = [
    "as_equipment",
    "make_bin",
    "make_compartment",
    "make_counter",
    "make_rack",
    "make_room",
    "make_shelf",
    "make_table",
    "make_tote",
    "make_wall",
    "round_table",
]

FLOOR, TABLE, BOARD, EQUIPMENT, SIDE, BACK, WALL = 1, 2, 2, 6, 7, 8, 9
"""Pixel labels; the boards of a shelf count up from `BOARD`."""
_SIDES = {"left_side", "right_side", "front", "back"}
"""Names of the sides of a bin."""


def make_room(rng: Generator, *, wall_chance: float) -> list[Support]:
    """Return a floor and, with probability ``wall_chance``, a wall behind the table."""
    floor = _slab("floor", FLOOR, (8.0, 8.0, 0.05), (0, 0, 0))
    if rng.random() >= wall_chance:
        return [floor]
    return [floor, make_wall("wall", (8.0, 0.1, 2.6), (0, rng.uniform(0.8, 1.6)))]


def make_counter(rng: Generator) -> Support:
    """Return a counter top 2.4 m long, longer than the field of view."""
    height, depth = rng.uniform(0.75, 0.95), rng.uniform(0.55, 0.65)
    return _slab("table", TABLE, (2.4, depth, 0.04), (0, 0, height))


def make_table(rng: Generator, min_size: tuple[float, float] | None = None) -> Support:
    """Return a random table top, one in five round.

    ``min_size`` is the minimum size in x and y, metres; with it, the table is rectangular.
    """
    height, thick = rng.uniform(0.6, 0.9), rng.uniform(0.018, 0.04)
    if min_size is not None:
        size = (rng.uniform(1, 1.2) * min_size[0], rng.uniform(1, 1.2) * min_size[1], thick)
        return _slab("table", TABLE, size, (0, 0, height))
    if rng.random() < 0.2:
        return round_table(rng.uniform(0.5, 0.7), height, thick)
    size = (rng.uniform(1.1, 1.8), rng.uniform(0.75, 1.0), thick)
    return _slab("table", TABLE, size, (0, 0, height))


def round_table(radius: float, height: float, thick: float) -> Support:
    """Return a disc on the world's z axis, ``thick`` metres thick, its upper face at ``height``."""
    t = np.arange(48) * (2 * np.pi / 48)
    ring = np.stack([radius * np.cos(t), radius * np.sin(t)], -1)
    mesh = placed(extrude(ring, thick), (0, 0, height - thick))
    return Support("table", TABLE, mesh, np.column_stack([ring, np.full(48, height)]))


def make_shelf(
    width: float, depth: float, low: float, step: float
) -> tuple[list[Support], list[Support]]:
    """Return the three boards of a shelf, ``width`` by ``depth``, and its two sides and back.

    The lowest board is at z = ``low``; the spacing of the boards is ``step``.
    """
    thick = 0.02
    boards = [
        _slab(f"board_{k + 1}", BOARD + k, (width, depth, thick), (0, 0, low + k * step))
        for k in range(3)
    ]
    return boards, _sides(width, depth, low + 3 * step, thick)


def make_rack(rng: Generator, supports: Sequence[Support]) -> list[Support]:
    """Return the ``supports`` of a shelf with four posts instead of its sides.

    The back stays with a probability of 1/3.
    """
    points = np.concatenate([s.mesh.vertices for s in supports if s.name.startswith("board")])
    wide = rng.uniform(0.012, 0.05, 2)
    place = np.abs(points[:, :2]).max(axis=0) + rng.uniform(-0.7, 0.5) * wide
    tall = float(points[:, 2].max()) + rng.uniform(0.02, 0.4)
    posts = [
        _board(f"post_{k}", EQUIPMENT, (*wide, tall), (*place * (x, y), 0))
        for k, (x, y) in enumerate([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    ]
    gone = {"left_side", "right_side", "back" if rng.random() < 2 / 3 else ""}
    return [*(support for support in supports if support.name not in gone), *posts]


def make_bin(rng: Generator) -> tuple[Support, list[Support]]:
    """Return the bottom and the four sides of an open bin, on the floor or up to 0.9 m above it."""
    width, depth, tall = rng.uniform(0.3, 0.6), rng.uniform(0.25, 0.45), rng.uniform(0.1, 0.3)
    height, thick = rng.choice([0.01, rng.uniform(0.4, 0.9)]), rng.uniform(0.003, 0.012)
    bottom = _slab("bin", TABLE, (width, depth, 0.01), (0, 0, height))
    left, right, back = _sides(width, depth, tall, thick, height)
    size, place = (width + 2 * thick, thick, tall), (0, -(depth + thick) / 2, height)
    return bottom, [left, right, _board("front", BACK, size, place), back]


def make_tote(rng: Generator, supports: Sequence[Support]) -> list[Support]:
    """Return the ``supports`` of a bin with sides that lean outwards and, half the time, a rim."""
    bottom = next(support for support in supports if support.name == "bin")
    sides = [support for support in supports if support.name in _SIDES]
    points = np.concatenate([side.mesh.vertices for side in sides])
    half, top = np.ptp(points[:, :2], axis=0) / 2, float(points[:, 2].max())
    if rng.random() < 0.5:
        sides += _rim(half, rng.uniform(0.01, 0.05), top)
    slope = np.tan(np.radians(rng.uniform(2, 25)))
    leaning = [replace(s, mesh=_widened(s.mesh, half, slope, bottom.height)) for s in sides]
    return [*(support for support in supports if support.name not in _SIDES), *leaning]


def _rim(half: F8, wide: float, height: float) -> Iterator[Support]:
    """Yield the four boards of a rim, ``wide`` metres wide, around a bin.

    ``half`` (2,) is half the length and width of the bin; the rim lies at ``height``, on its top.
    """
    for name, axis, side in (("left", 0, -1), ("right", 0, 1), ("near", 1, -1), ("far", 1, 1)):
        size, place = 2 * half + 2 * wide, np.zeros(2)
        size[axis], place[axis] = wide, side * (half[axis] + wide / 2)
        yield _board(f"{name}_rim", SIDE, (*size, 0.006), (*place, height))


def _widened(mesh: Mesh, half: F8, slope: float, height: float) -> Mesh:
    """Lean the side of a bin outwards by ``slope``, in metres per metre above ``height``.

    ``half`` (2,) is half the length and width of the bin, whose middle is on the z axis.
    """
    points = mesh.vertices.astype(np.float64)
    points[:, :2] *= 1 + slope * np.maximum(points[:, 2:] - height, 0) / half
    return Mesh(points.astype(np.float32), mesh.triangles)


def make_compartment(rng: Generator) -> tuple[Support, list[Support], Support]:
    """Return a shelf compartment, open at the front: its board, its sides and back, and its top."""
    width, depth, tall = rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.4), rng.uniform(0.22, 0.35)
    height, thick = rng.uniform(0.3, 1.2), 0.012
    board = _slab("board_1", BOARD, (width, depth, thick), (0, 0, height))
    walls = _sides(width, depth, tall, thick, height)
    top = _board("top", WALL, (width + 2 * thick, depth, thick), (0, 0, height + tall))
    return board, walls, top


def _slab(name: str, label: int, size: Sequence[float], top_middle: Sequence[float]) -> Support:
    """Return a horizontal board of ``size`` (3,); its upper face is centred at ``top_middle``."""
    x, y, z = top_middle
    mesh = placed(rounded_box(size, fine=1), (x, y, z - size[2]))
    a, b = size[0] / 2, size[1] / 2
    corners = [[x - a, y - b, z], [x + a, y - b, z], [x + a, y + b, z], [x - a, y + b, z]]
    return Support(name, label, mesh, np.array(corners))


def make_wall(name: str, size: Sequence[float], place: Sequence[float]) -> Support:
    """Return a wall or cupboard of size (3,) on the floor, centred at ``place`` (2,)."""
    return _board(name, WALL, size, (*place, 0))


def _sides(
    width: float, depth: float, tall: float, thick: float, height: float = 0.0
) -> list[Support]:
    """Return the left side, the right side and the back around an area ``width`` by ``depth``.

    They are ``tall`` metres tall and ``thick`` metres thick; their lower edge is at ``height``.
    """
    beside, behind = (width + thick) / 2, (depth + thick) / 2
    return [
        _board("left_side", SIDE, (thick, depth, tall), (-beside, 0, height)),
        _board("right_side", SIDE, (thick, depth, tall), (beside, 0, height)),
        _board("back", BACK, (width + 2 * thick, thick, tall), (0, behind, height)),
    ]


def _board(name: str, label: int, size: Sequence[float], place: Sequence[float]) -> Support:
    """Return a board that holds no objects; ``place`` (3,) is the centre of its lower face."""
    return Support(name, label, placed(rounded_box(size, fine=1), place))


def as_equipment(name: str, meshes: Sequence[Mesh]) -> list[Support]:
    """Return meshes in the world frame as supports ``name_0``, ``name_1``... that hold nothing."""
    return [Support(f"{name}_{k}", EQUIPMENT, mesh) for k, mesh in enumerate(meshes)]
