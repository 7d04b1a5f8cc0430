"""Scenes arranged by physics: piles on tables, filled bins, crowded shelf compartments."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.geometry import rotation_from_quaternion, transform
from shapecat.simulation.scenes.furniture import make_bin, make_compartment, make_room, make_table
from shapecat.simulation.scenes.paths import Filming, arc_orbit
from shapecat.simulation.scenes.physics import Drop, SettledPose, settle
from shapecat.simulation.scenes.worlds import PlacedObject, Support, World
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.distractors import KINDS, make_distractor
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.randomness import log_uniform, random_rotation
from shapecat.types import UNKNOWN

__all__ = ["Item", "bin_picking", "make_item", "pile", "settled", "shelf_bin"]

_UPRIGHT = 0.45
"""Fraction of the objects that are dropped nearly upright; others get a random rotation."""
_TILT_DEG = 8.0
"""Standard deviation of the tilt of nearly upright objects about x and about y."""
_UPRIGHT_COS, _LYING_COS = np.cos(np.radians(15)), np.sin(np.radians(15))
"""Cosines of the angle between an axis and the vertical: minimum of an upright axis (15 degrees),
and maximum of a lying axis (75 degrees)."""
_FALLEN_M = 0.02
"""Objects this far below the surface of their support have fallen off."""


class Item(NamedTuple):
    """An object to drop.

    A distractor has the ``category`` ``unknown`` and its own ``kind``; for other objects, the two
    are equal.
    """

    category: str
    kind: str
    mesh: Mesh


def pile(
    rng: Generator, categories: Sequence[str], filming: Filming, *, kinds: Sequence[str] = KINDS
) -> World:
    """Return a scene of objects dropped on a table.

    The objects lean on each other, lie across each other, or lie in each other.

    Parameters
    ----------
    categories : category of each object; ``unknown`` is a distractor.
    filming : number of frames and frame rate.
    kinds : kinds of distractors to choose from.
    """
    supports = (*make_room(rng, wall_chance=0.2), make_table(rng))
    table = supports[-1]
    spread = rng.uniform(0.07, 0.2)
    drops, items = [], [make_item(category, rng, kinds) for category in categories]
    for item in items:
        place = np.clip(rng.normal(0, spread, 2), -0.4, 0.4)
        drops.append(Drop(item.mesh, _dropped_rotation(rng), place))
    objects = settled(items, drops, supports, table)
    target = np.array([0, 0, table.height + 0.05])
    path = arc_orbit(
        rng,
        target,
        filming,
        distance=log_uniform(rng, 0.6, 1.5),
        elevation=(18, 75),
        sweep=(20, 60),
    )
    return World("pile", supports, objects, path)


def bin_picking(
    rng: Generator, categories: Sequence[str], filming: Filming, *, kinds: Sequence[str] = KINDS
) -> World:
    """Return a scene of objects dropped into a bin, seen from above.

    Objects that are too large for the bin are left out. The parameters are as for `pile`.
    """
    bottom, sides = make_bin(rng)
    half = np.ptp(bottom.outline[:, :2], axis=0) / 2
    items = [make_item(category, rng, kinds) for category in categories]
    items = [item for item in items if item.mesh.extents.max() < 1.6 * half.min()]
    drops = _drops_within(rng, items, half)
    supports = (*make_room(rng, wall_chance=0.2), bottom, *sides)
    target = np.array([0, 0, bottom.height + 0.05])
    path = arc_orbit(rng, target, filming, distance=(0.6, 1.2), elevation=(60, 84), sweep=(10, 40))
    objects = settled(items, drops, supports, bottom)
    return World("bin", supports, objects, path)


def shelf_bin(
    rng: Generator, categories: Sequence[str], filming: Filming, *, kinds: Sequence[str] = KINDS
) -> World:
    """Return a scene of objects dropped into a shelf compartment, seen from the front.

    Objects that are too large for it are left out. The parameters are as for `pile`.
    """
    board, walls, top = make_compartment(rng)
    half = np.ptp(board.outline[:, :2], axis=0) / 2
    room_m = top.mesh.vertices[:, 2].min() - board.height
    items = [make_item(category, rng, kinds) for category in categories]
    items = [i for i in items if (i.mesh.extents[:2] < 1.6 * half.min()).all()]
    drops = _drops_within(rng, items, half)
    supports = (*make_room(rng, wall_chance=0.0), board, *walls)
    objects = settled(items, drops, supports, board, highest_m=float(room_m))
    target = np.array([0, 0, board.height + room_m / 3])
    path = arc_orbit(rng, target, filming, distance=(0.5, 0.9), elevation=(5, 25), sweep=(5, 20))
    return World("shelf_bin", (*supports, top), objects, path)


def make_item(category: str, rng: Generator, kinds: Sequence[str]) -> Item:
    """Make an object of a category; for ``unknown``, a distractor of one of the kinds."""
    if category == UNKNOWN:
        return Item(category, *make_distractor(rng, kinds))
    return Item(category, category, make_object(category, rng))


def _drops_within(rng: Generator, items: Sequence[Item], half: F8) -> list[Drop]:
    """Return drops of items with random rotations and positions.

    ``half`` (2,) is half the length and width of the area that they fall on, metres.
    """
    drops = []
    for item in items:
        room = np.maximum(half - float(item.mesh.extents.max()) / 2 - 0.01, 0)
        drops.append(Drop(item.mesh, _dropped_rotation(rng), rng.uniform(-room, room)))
    return drops


def _dropped_rotation(rng: Generator) -> F8:
    """Draw a rotation (3, 3): nearly upright with probability `_UPRIGHT`, else uniformly random."""
    if rng.random() >= _UPRIGHT:
        return random_rotation(rng)
    tilt, half_yaw = rng.normal(0, np.radians(_TILT_DEG) / 2, 2), rng.uniform(0, np.pi)
    quaternion = np.array([*tilt, np.sin(half_yaw), np.cos(half_yaw)])
    return rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))


def settled(
    items: Sequence[Item],
    drops: Sequence[Drop],
    supports: Sequence[Support],
    below: Support,
    *,
    highest_m: float = np.inf,
) -> tuple[PlacedObject, ...]:
    """Drop items onto supports; return the objects that come to rest on the support ``below``.

    The objects are numbered from 0 in the order of ``items``; ``drops`` has one drop per item.
    Objects that reach ``highest_m`` metres or more above the surface of ``below`` are left out, and
    so is everything that rests on them.
    """
    settled_poses = settle([support.mesh for support in supports], drops)
    stays = [
        _rests_on(k.mesh, landed, below, highest_m)
        for k, landed in zip(items, settled_poses, strict=True)
    ]
    for _ in stays:  # an object may come before the one that carries it
        stays = [
            stay and (landed.supported_by is None or stays[landed.supported_by])
            for stay, landed in zip(stays, settled_poses, strict=True)
        ]
    tracks = np.cumsum(stays) - 1
    return tuple(
        _placed_object(int(tracks[k]), item, landed, below, tracks)
        for k, (item, landed) in enumerate(zip(items, settled_poses, strict=True))
        if stays[k]
    )


def _rests_on(mesh: Mesh, landed: SettledPose, below: Support, highest_m: float) -> bool:
    """Return whether an object came to rest on a support, directly or on top of others.

    Its top must be less than ``highest_m`` metres above the support.
    """
    points = transform(landed.pose, mesh.vertices)
    low, high = points.min(axis=0), points.max(axis=0)
    edge = below.outline[:, :2]
    middle = (low + high)[:2] / 2
    inside = ((edge.min(axis=0) < middle) & (middle < edge.max(axis=0))).all()
    return bool(inside and low[2] > below.height - _FALLEN_M and high[2] < below.height + highest_m)


def _placed_object(
    track: int,
    item: Item,
    landed: SettledPose,
    below: Support,
    tracks: F8,
) -> PlacedObject:
    """Return an item with the number ``track`` in its settled pose ``landed``.

    ``tracks`` (n,) are the numbers of all items, meaningless for those that are left out.
    """
    supported_by = landed.supported_by
    axes = landed.pose.rotation[2]  # world z component of each axis of the object
    return PlacedObject(
        track,
        item.category,
        item.kind,
        item.mesh,
        landed.pose,
        below.name if supported_by is None else None,
        None if supported_by is None else int(tracks[supported_by]),
        lying=bool(item.category != "box" and abs(axes[2]) < _LYING_COS),
        upside_down=bool(axes[2] < -_UPRIGHT_COS),
        tilted=bool(np.abs(axes).max() < _UPRIGHT_COS),
    )
