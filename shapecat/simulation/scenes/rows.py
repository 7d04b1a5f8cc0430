"""Scenes of similar objects in rows, grids and stacks, as in shops, warehouses and kitchens."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.geometry import compose
from shapecat.simulation.scenes.footprints import inside, overlap
from shapecat.simulation.scenes.furniture import make_bin, make_room, make_shelf, make_table
from shapecat.simulation.scenes.layout import SUPPORTING, Piece, make_piece, place_piece
from shapecat.simulation.scenes.paths import Filming, arc_orbit
from shapecat.simulation.scenes.worlds import PlacedObject, Support, World, pose_from_yaw
from shapecat.simulation.shapes.randomness import log_uniform
from shapecat.types import Pose

__all__ = ["rows"]

_GAPS_M = (0.0005, 0.002, 0.005, 0.01, 0.02, 0.04)
"""Distances between the objects of a group, of which one is drawn."""
_SHIFT = 0.3
"""Maximum shift of the objects of an irregular group, as a fraction of the gap."""
_MISSING = 0.15
"""In half of the groups, the probability that an object with nothing on top is missing."""
_DIFFERENT = 0.3
"""Probability that a group is a single row of objects of different sizes."""
_MOST_ALONG = (6, 5, 4)
"""Maximum number of objects of a group along its rows, across them, and in height."""
_MOST = 120
"""Maximum number of objects of a scene."""
_MARGIN_M = 0.01
"""Minimum distance of a group from the edge of its support and from other groups."""
_AREA_M = 0.45
"""Maximum half size of the area, in the middle of a support, in which groups are placed."""
_TOP_M = 0.03
"""Minimum width of a top face that carries another object."""


class _Place(NamedTuple):
    """An object of a group.

    ``corner`` (3,) is the minimum corner of its bounding box in the group, metres; ``below`` is the
    index of the object that it stands on, None if it stands on the support.
    """

    piece: Piece
    corner: F8
    below: int | None


def rows(rng: Generator, categories: Sequence[str], filming: Filming) -> World:
    """Return a scene of groups of similar objects: on a table, on a shelf, or in a bin.

    Parameters
    ----------
    categories : category of each group. A table uses the first one to five, a bin the first; groups
        for which there is no room are left out.
    filming : number of frames and frame rate.
    """
    groups = _Groups(rng)
    kind = rng.choice(["table", "shelf", "bin"], p=[0.5, 0.3, 0.2])
    if kind == "table":
        table = make_table(rng)
        supports = [*make_room(rng, wall_chance=0.3), table]
        for category in categories[: int(rng.integers(1, 6))]:
            groups.put(category, table, rng.uniform(0, 2 * np.pi), headroom_m=0.5)
        height, distance, elevation = table.height + 0.05, log_uniform(rng, 0.6, 1.5), (15.0, 80.0)
    elif kind == "shelf":
        low, step = rng.uniform(0.25, 0.4), rng.uniform(0.33, 0.42)
        boards, sides = make_shelf(rng.uniform(0.85, 1.15), rng.uniform(0.3, 0.42), low, step)
        supports = [*make_room(rng, wall_chance=0.0), *boards, *sides]
        for k, category in enumerate(categories):
            groups.put(category, boards[k % 3], 0.0, headroom_m=step - 0.04)
        height, distance, elevation = low + 1.15 * step, rng.uniform(0.9, 1.55), (5.0, 30.0)
    else:
        bottom, walls = make_bin(rng)
        supports = [*make_room(rng, wall_chance=0.2), bottom, *walls]
        groups.put(categories[0], bottom, 0.0, headroom_m=0.25)
        height, distance, elevation = bottom.height + 0.05, rng.uniform(0.6, 1.2), (60.0, 84.0)
    target = np.append(groups.middle(), height)
    path = arc_orbit(rng, target, filming, distance=distance, elevation=elevation, sweep=(20, 50))
    return World("rows", tuple(supports), tuple(groups.objects), path)


class _Groups:
    """Groups of objects, which `put` places on supports one by one; ``objects`` lists them all."""

    def __init__(self, rng: Generator) -> None:
        self.objects: list[PlacedObject] = []
        self._rng = rng
        self._outlines: list[tuple[Support, F8]] = []

    def put(self, category: str, support: Support, yaw: float, *, headroom_m: float) -> None:
        """Place a random group of a category on a support, if there is room.

        Parameters
        ----------
        yaw : direction of the rows of the group about z, radians.
        headroom_m : maximum height of the group.
        """
        rng, edge = self._rng, support.outline[:, :2]
        middle = edge.mean(axis=0)
        half = np.minimum(np.ptp(edge, axis=0) / 2, _AREA_M)
        gap = float(rng.choice(_GAPS_M))
        for _ in range(40):
            group = _draw_group(category, rng, gap, np.array([*(1.6 * half), headroom_m]))
            if not group:
                continue
            length, depth, _ = np.max([p.corner + _extent(p.piece) for p in group], axis=0)
            corner = -np.array([length, depth, 0]) / 2
            outline = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * corner[:2]
            spot = middle + rng.uniform(-half, half)
            turn = pose_from_yaw(yaw, np.round([*spot, support.height], 6))
            outline = outline @ turn.rotation[:2, :2].T + spot
            others = [other for below, other in self._outlines if below is support]
            if (
                len(self.objects) + len(group) <= _MOST
                and inside(outline, edge, _MARGIN_M)
                and not any(overlap(outline, other, _MARGIN_M) for other in others)
            ):
                self._outlines.append((support, outline))
                self._add(group, corner, turn, support, _SHIFT * gap * rng.integers(2))
                return

    def middle(self) -> F8:
        """Return the mean position (2,) of the groups; the origin if there are none."""
        middles = [outline.mean(axis=0) for _, outline in self._outlines]
        return np.mean(middles, axis=0) if middles else np.zeros(2)

    def _add(
        self, group: Sequence[_Place], corner: F8, turn: Pose, support: Support, shift_m: float
    ) -> None:
        """Add the objects of a group; a few that carry nothing may be left out at random.

        ``corner`` (3,) is the minimum corner of the group, metres, before ``turn`` moves it to its
        support. Each object is shifted at random, by up to ``shift_m`` in x and y.
        """
        rng, missing = self._rng, _MISSING * self._rng.integers(2)
        carrying = {place.below for place in group}
        tracks: dict[int | None, int] = {}
        for k, place in enumerate(group):
            if k not in carrying and rng.random() < missing:
                continue
            size = place.piece.footprint
            low = np.array([*size.outline.min(axis=0), size.low])
            shift = np.array([*rng.uniform(-shift_m, shift_m, 2), 0])
            moved = Pose(np.eye(3), np.round(corner + place.corner - low + shift, 6))
            pose = compose(turn, compose(moved, place.piece.stable_pose.pose))
            tracks[k] = len(self.objects)
            below = tracks.get(place.below)
            self.objects.append(place_piece(place.piece, tracks[k], pose, support, below))


def _draw_group(category: str, rng: Generator, gap: float, room: F8) -> list[_Place]:
    """Draw a block of equal objects, layer by layer, or a row of objects of different sizes.

    ``gap`` is the distance between objects, ``room`` (3,) the maximum size of a block, metres. The
    result is empty if not even one object fits.
    """
    piece = make_piece(category, rng)
    between = np.array([gap, gap, 0])
    step = _extent(piece) + between
    most = np.minimum((room + between) / step, _MOST_ALONG).astype(int)
    if most.min() < 1:
        return []
    columns, lines, layers = rng.integers(1, most + 1, (2, 3)).max(axis=0).tolist()
    if rng.random() < _DIFFERENT:
        return _draw_row(category, rng, gap, columns, room[2])
    top = piece.footprint.top
    if category not in SUPPORTING or len(top) < 3 or np.ptp(top, axis=0).min() < _TOP_M:
        layers = 1
    return [
        _Place(piece, step * [x, y, z], k - lines * columns if z else None)
        for k, (z, y, x) in enumerate(np.ndindex(layers, lines, columns))
    ]


def _draw_row(
    category: str, rng: Generator, gap: float, count: int, headroom_m: float
) -> list[_Place]:
    """Draw a row of objects of different sizes, aligned at the front, like books on a shelf.

    ``count`` objects are drawn; ``gap`` is the distance between objects, metres. Objects taller
    than ``headroom_m`` are left out.
    """
    row, along = [], 0.0
    for _ in range(count):
        piece = make_piece(category, rng)
        length, _, height = _extent(piece)
        if height <= headroom_m:
            row.append(_Place(piece, np.array([along, 0, 0]), None))
            along += length + gap
    return row


def _extent(piece: Piece) -> F8:
    """Return the size (3,) of the bounding box of a piece, metres."""
    size = piece.footprint
    return np.array([*np.ptp(size.outline, axis=0), size.high - size.low])
