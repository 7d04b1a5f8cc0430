"""Which object of a frame looks as it did in an earlier one, and what is then used again.

An object is compared with the view that was described, never with one that repeats it: so it
cannot drift away from its description step by step.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.geometry import (
    IDENTITY,
    compose,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from shapecat.reuse.agreement import agreement
from shapecat.types import Candidate, Detection, Frame, FullBox, NeuralGas, Pose

__all__ = ["KeyView", "Sight", "find_key_views", "looks_the_same", "reused", "update"]

_PLACE_M = 0.015
"""The centre of what is seen of a still object strays less while the view changes little."""
_TURN_DEG, _FARTHER = 4.0, 0.05
"""A view from a direction and a distance that differ by less shows the same shape."""
_SIZE_M, _HEIGHT_M, _UP_DEG = 0.02, 0.01, 2.0
"""Larger differences of the box, of its height above the support, and of up are no noise."""
_AREA = 0.25
"""As is a larger share of pixels more or less, at the same distance."""
_AGREE, _BIAS = 0.95, 0.002
"""Share of the points that must be where they were, either way; how much nearer they may be in
the mean, in 1/m: 2 mm at 1 m."""


class Sight(NamedTuple):
    """An object in a frame, before it is described.

    Attributes
    ----------
    pose : ``fixed_from_sensor``; None where there is no fixed frame.
    up : (3,) unit vector, sensor frame.
    height_m : from what the object stands on to the centre of its box.
    place : (3,) that centre in the fixed frame, or else in that of the sensor.
    """

    frame: Frame
    pose: Pose | None
    up: F4
    candidate: Candidate
    height_m: float
    place: F8


class KeyView(NamedTuple):
    """A sight and its description, to be used again in later frames."""

    sight: Sight
    detection: Detection


def find_key_views(sights: Sequence[Sight], keys: Sequence[KeyView]) -> list[KeyView | None]:
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
    gaps = _gaps(sights, [key.sight for key in keys])
    nearest = gaps.argmin(axis=1).tolist()
    near = (gaps.min(axis=1) <= _PLACE_M).tolist()
    return [
        keys[k] if is_near and looks_the_same(sight, keys[k].sight) else None
        for sight, k, is_near in zip(sights, nearest, near, strict=True)
    ]


def update(keys: tuple[KeyView, ...], new: Sequence[KeyView]) -> tuple[KeyView, ...]:
    """Return the key views after a frame: new ones take the place of those where they are."""
    if not keys or not new:
        return (*keys, *new)
    gaps = _gaps([key.sight for key in keys], [key.sight for key in new])
    kept = (gaps.min(axis=1) > 2 * _PLACE_M).tolist()
    return (*(key for key, keep in zip(keys, kept, strict=True) if keep), *new)


def _gaps(some: Sequence[Sight], others: Sequence[Sight]) -> F8:
    """Return the distances (m, n) between places."""
    places, far = (np.array([sight.place for sight in each]) for each in (some, others))
    return np.asarray(np.sqrt(((places[:, None] - far[None]) ** 2).sum(axis=2)))


def reused(key: KeyView, sight: Sight) -> Detection:
    """Return the detection of an object that repeats a view: what was learned moves with it."""
    first, move = key.detection, _between(key.sight, sight)
    return replace(
        first,
        candidate=sight.candidate,
        gas=first.gas if move is IDENTITY else _moved_gas(move, first.gas),
        full=first.full if move is IDENTITY else _moved_box(move, first.full),
        seconds=0.0,
        reused_from=key.sight.frame.index,
    )


def _moved_gas(move: Pose, gas: NeuralGas) -> NeuralGas:
    return NeuralGas(transform(move, gas.neurons), gas.edges)


def _moved_box(move: Pose, box: FullBox | None) -> FullBox | None:
    if box is None:
        return None
    turned = move.rotation @ rotation_from_quaternion(box.orientation)
    return replace(
        box,
        center=transform(move, box.center),
        orientation=quaternion_from_rotation(turned),
    )


def looks_the_same(now: Sight, then: Sight) -> bool:
    """Tell whether an object looks in two frames the same, the cheap questions first."""
    if (now.pose is None) != (then.pose is None):
        return False
    if not (_alike(now, then) and _seen_alike(now, then)):
        return False
    move = _between(then, now)
    return _agree(then, now, move) and _agree(now, then, inverse(move))


def _alike(now: Sight, then: Sight) -> bool:
    """Compare what was found out about the candidates."""
    a, b = now.candidate, then.candidate
    if (a.touches_border, a.occluded) != (b.touches_border, b.occluded):
        return False
    if abs(now.height_m - then.height_m) > _HEIGHT_M:
        return False
    sizes = [(*sorted(box.size[:2]), box.size[2]) for box in (a.box, b.box)]  # yaw may flip
    return bool(np.abs(np.subtract(*sizes)).max() <= _SIZE_M)


def _seen_alike(now: Sight, then: Sight) -> bool:
    """Compare from where the object is seen, and how large it is in the image."""
    rays = [_rotation(s) @ s.candidate.box.center for s in (now, then)]
    ups = [_rotation(s) @ s.up for s in (now, then)]
    far, before = (float(np.linalg.norm(ray)) for ray in rays)
    area = len(now.candidate.indices) * far**2 / (len(then.candidate.indices) * before**2)
    return (
        rays[0] @ rays[1] >= np.cos(np.radians(_TURN_DEG)) * far * before
        and ups[0] @ ups[1] >= np.cos(np.radians(_UP_DEG))
        and abs(far / before - 1) <= _FARTHER
        and abs(area - 1) <= _AREA
    )


def _agree(one: Sight, other: Sight, move: Pose) -> bool:
    """Tell whether the points of an object are where another frame sees something."""
    a, b = one.frame, other.frame
    if a.depth is None or a.camera is None or b.depth is None or b.camera is None:
        return False
    share, bias = agreement(one.candidate.indices, a.depth, a.camera, b.depth, b.camera, move)
    return share >= _AGREE and abs(bias) <= _BIAS


def _rotation(sight: Sight) -> F8:
    return (sight.pose or IDENTITY).rotation


def _between(one: Sight, other: Sight) -> Pose:
    """Return ``other_from_one``, of the sensor in two frames."""
    if one.pose is None or other.pose is None or _same_pose(one.pose, other.pose):
        return IDENTITY
    return compose(inverse(other.pose), one.pose)


def _same_pose(a: Pose, b: Pose | None) -> bool:
    return (
        b is not None
        and np.array_equal(a.rotation, b.rotation)
        and np.array_equal(a.translation, b.translation)
    )
