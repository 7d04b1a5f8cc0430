"""Which object of a frame looks as it did in an earlier one, and what is then used again.

An object is compared with the view that was described, never with one that repeats it: so it
cannot drift away from its description step by step.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, Bool
from shapecat.geometry import (
    IDENTITY,
    compose,
    inverse,
    quaternion_from_rotation,
    transform,
)
from shapecat.reuse.agreement import agreement
from shapecat.types import Candidate, Detection, Frame, FullBox, NeuralGas, Pose

__all__ = ["KeyView", "Repeat", "Sight", "find_repeats", "reused", "sight_of"]

_PLACE_M = 0.015
"""The centre of what is seen of a still object strays less while the view changes little."""
_TURN_DEG, _FARTHER = 6.0, 0.05
"""A view from a direction and a distance that differ by less shows the same shape."""
_SIZE_M, _HEIGHT_M, _UP_DEG = 0.02, 0.01, 2.0
"""Larger differences of the box, of its height above the support, and of up are no noise."""
_AREA = 0.25
"""As is a larger share of pixels more or less, at the same distance."""
_AGREE, _BIAS = 0.95, 0.002
"""Share of the points that must be where they were, either way; how much nearer they may be in
the mean, in 1/m: 2 mm at 1 m."""


_TRIES = 3
"""Views of an object that are compared point by point, the newest first: masks may flicker."""


class Sight(NamedTuple):
    """An object in a frame, before it is described.

    Attributes
    ----------
    pose : ``fixed_from_sensor``; None where there is no fixed frame.
    numbers : (15,) what is compared first; see `sight_of`.
    """

    frame: Frame
    pose: Pose | None
    candidate: Candidate
    numbers: F8


_PLACE, _RAY, _UP, _SIZE = slice(3), slice(3, 6), slice(6, 9), slice(9, 12)
_HEIGHT, _PIXELS, _KIND = 12, 13, 14
"""Where in the numbers of a sight they are; all directions in the fixed frame, if there is one."""


def sight_of(
    frame: Frame, pose: Pose | None, candidate: Candidate, up: F4, height_m: float
) -> Sight:
    """Note what tells whether a candidate was seen alike before.

    Parameters
    ----------
    up : (3,) unit vector, sensor frame.
    height_m : from what the object stands on to the centre of its box.
    """
    turn, shift = (pose or IDENTITY).rotation, (pose or IDENTITY).translation
    ray = turn @ candidate.box.center
    length, width, height = candidate.box.size.tolist()
    size = (max(length, width), min(length, width), height)  # the yaw of a box may flip
    kind = candidate.touches_border + 2 * candidate.occluded + 4 * (pose is None)
    pixels = len(candidate.indices)
    numbers = np.array([*(ray + shift), *ray, *(turn @ up), *size, height_m, pixels, kind])
    return Sight(frame, pose, candidate, numbers)


class KeyView(NamedTuple):
    """A sight and its description, to be used again in later frames."""

    sight: Sight
    detection: Detection


class Move(NamedTuple):
    """How the sensor frame of an earlier view lies in that of a later one.

    ``pose`` is ``later_from_earlier``, ``back`` its inverse, ``quaternion`` (4,) x, y, z, w.
    """

    pose: Pose
    back: Pose
    quaternion: F8


class Repeat(NamedTuple):
    """A view that an object repeats, and how the sensor has moved since."""

    key: KeyView
    move: Move


def find_repeats(sights: Sequence[Sight], keys: Sequence[KeyView]) -> list[Repeat | None]:
    """Find, for each object of a frame, the earlier view that it repeats; None where it is new.

    Parameters
    ----------
    keys : described views of earlier frames of the same topic.

    Notes
    -----
    Only depth images are compared: loose points do not tell what hides what.
    """
    if not keys or not sights:
        return [None] * len(sights)
    now, then = (np.array([each.numbers for each in some]) for some in (sights, _sights(keys)))
    alike, moves = _alike(now[:, None], then[None]), dict[int, Move]()
    found: list[Repeat | None] = []
    for sight, row in zip(sights, alike, strict=True):
        newest_first = np.flatnonzero(row)[::-1].tolist()
        tries = (_repeat(sight, keys[k], moves) for k in newest_first[:_TRIES])
        found.append(next((repeat for repeat in tries if repeat is not None), None))
    return found


def _repeat(sight: Sight, key: KeyView, moves: dict[int, Move]) -> Repeat | None:
    """Return the view as repeated if the points of the object agree as well."""
    earlier = key.sight.frame.index
    if earlier not in moves:
        moves[earlier] = _between(key.sight, sight)
    move = moves[earlier]
    same = _agree(key.sight, sight, move.pose) and _agree(sight, key.sight, move.back)
    return Repeat(key, move) if same else None


def reused(repeat: Repeat, sight: Sight) -> Detection:
    """Return the detection of an object that repeats a view: what was learned moves with it."""
    (key, move), first = repeat, repeat.key.detection
    return Detection(
        candidate=sight.candidate,
        gas=first.gas if move is _REST else _moved_gas(move, first.gas),
        descriptor=first.descriptor,
        posterior=first.posterior,
        novelty=first.novelty,
        seconds=0.0,
        full=first.full if move is _REST else _moved_box(move, first.full),
        reused_from=key.sight.frame.index,
    )


def _moved_gas(move: Move, gas: NeuralGas) -> NeuralGas:
    return NeuralGas(transform(move.pose, gas.neurons), gas.edges)


def _moved_box(move: Move, box: FullBox | None) -> FullBox | None:
    if box is None:
        return None
    x, y, z, w = move.quaternion.tolist()
    product = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
    turned = product @ box.orientation
    return replace(box, center=transform(move.pose, box.center), orientation=turned)


def _sights(keys: Sequence[KeyView]) -> list[Sight]:
    return [key.sight for key in keys]


def _alike(now: F8, then: F8) -> Bool:
    """Tell which sights (..., 15) were seen alike, before their points are compared."""
    far, before = (np.linalg.norm(each[..., _RAY], axis=-1) for each in (now, then))
    area = now[..., _PIXELS] * far**2 / (then[..., _PIXELS] * before**2)
    turned = (now[..., _RAY] * then[..., _RAY]).sum(axis=-1) / (far * before)
    tilted = (now[..., _UP] * then[..., _UP]).sum(axis=-1)
    return np.asarray(
        (now[..., _KIND] == then[..., _KIND])
        & (((now - then)[..., _PLACE] ** 2).sum(axis=-1) <= _PLACE_M**2)
        & (turned >= np.cos(np.radians(_TURN_DEG)))
        & (tilted >= np.cos(np.radians(_UP_DEG)))
        & (np.abs(far / before - 1) <= _FARTHER)
        & (np.abs(area - 1) <= _AREA)
        & (np.abs(now - then)[..., _SIZE].max(axis=-1) <= _SIZE_M)
        & (np.abs(now - then)[..., _HEIGHT] <= _HEIGHT_M)
    )


def _agree(one: Sight, other: Sight, move: Pose) -> bool:
    """Tell whether the points of an object are where another frame sees something."""
    a, b = one.frame, other.frame
    if a.depth is None or a.camera is None or b.depth is None or b.camera is None:
        return False
    share, bias = agreement(one.candidate.indices, a.depth, a.camera, b.depth, b.camera, move)
    return share >= _AGREE and abs(bias) <= _BIAS


_REST = Move(IDENTITY, IDENTITY, np.array([0.0, 0.0, 0.0, 1.0]))


def _between(one: Sight, other: Sight) -> Move:
    """Return how the sensor has moved from one sight to another."""
    a, b = one.pose, other.pose
    if a is None or b is None:
        return _REST
    if np.array_equal(a.rotation, b.rotation) and np.array_equal(a.translation, b.translation):
        return _REST
    pose = compose(inverse(b), a)
    return Move(pose, inverse(pose), quaternion_from_rotation(pose.rotation))
