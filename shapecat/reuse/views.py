"""Find objects that look the same as in an earlier frame, and reuse their descriptions.

An object is compared with the view that was described, never with one that repeats it, so that
it cannot drift away from its description step by step.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, Bool, Records, Row
from shapecat.geometry import (
    IDENTITY,
    compose,
    inverse,
    quaternion_from_rotation,
    transform,
)
from shapecat.reuse.agreement import agreement
from shapecat.types import Candidate, Detection, Frame, FullBox, NeuralGas, Pose

__all__ = ["KeyView", "ObjectView", "Repeat", "find_repeats", "reused", "view_object"]

_PLACE_M = 0.015
"""Largest shift of the visible centre of an object at rest, between similar views, metres."""
_TURN_DEG = 6.0
"""Largest angle between the directions of similar views, degrees."""
_FARTHER = 0.05
"""Largest difference between the distances of similar views, as a fraction."""
_SIZE_M = 0.02
"""Largest change of the box size due to noise, metres."""
_HEIGHT_M = 0.01
"""Largest change of the height above the support due to noise, metres."""
_UP_DEG = 2.0
"""Largest change of up due to noise, degrees."""
_AREA = 0.25
"""Largest change of the number of pixels due to noise, at the same distance, as a fraction."""
_AGREE = 0.95
"""Minimum fraction of the points of each view that must agree with the other view."""
_BIAS = 0.002
"""Largest mean difference between the inverse depths of two views, 1/m: 2 mm at 1 m."""
_TRIES = 3
"""Maximum number of earlier views to compare point by point, the newest first. The newest may
disagree only because its mask flickered."""
_SUMMARY = np.dtype(
    [
        ("center_m", "f8", 3),  # of the box, in the fixed frame; the sensor frame without one
        ("ray_m", "f8", 3),  # from the sensor to the centre, in the same frame
        ("up", "f8", 3),  # in the same frame
        ("size_m", "f8", 3),  # longer side, shorter side and height of the box
        ("height_m", "f8"),  # of the centre above the support
        ("pixels", "f8"),
        ("kind", "i8"),  # flags that must be equal
    ]
)
"""The summary of a view. Points are compared only between views with similar summaries."""


class ObjectView(NamedTuple):
    """A view of an object, before it is described.

    Attributes
    ----------
    pose : ``fixed_from_sensor``; None where there is no fixed frame.
    summary : a row of `_SUMMARY`.
    """

    frame: Frame
    pose: Pose | None
    candidate: Candidate
    summary: Row


def view_object(
    frame: Frame, pose: Pose | None, candidate: Candidate, up: F4, height_m: float
) -> ObjectView:
    """Return the view of a candidate, with its summary.

    Parameters
    ----------
    pose : ``fixed_from_sensor``; None where there is no fixed frame.
    up : (3,) unit vector, sensor frame.
    height_m : height of the box centre above the surface the object stands on, metres.
    """
    turn, shift = (pose or IDENTITY).rotation, (pose or IDENTITY).translation
    ray = turn @ candidate.box.center
    length, width, height = candidate.box.size.tolist()
    size = (max(length, width), min(length, width), height)  # the yaw of a box may flip
    kind = candidate.touches_border + 2 * candidate.occluded + 4 * (pose is None)
    pixels = len(candidate.indices)
    summary = (ray + shift, ray, turn @ up, size, height_m, pixels, kind)
    return ObjectView(frame, pose, candidate, np.array(summary, _SUMMARY)[()])


class KeyView(NamedTuple):
    """A view and its description, for reuse in later frames."""

    view: ObjectView
    detection: Detection


class Move(NamedTuple):
    """The motion of the sensor between an earlier and a later view.

    ``pose`` is ``later_from_earlier``; ``quaternion`` (4,) x, y, z, w is the rotation of ``pose``,
    and ``back`` its inverse.
    """

    pose: Pose
    back: Pose
    quaternion: F8


class Repeat(NamedTuple):
    """An earlier view that an object repeats, and the motion of the sensor since."""

    key: KeyView
    move: Move


def find_repeats(views: Sequence[ObjectView], keys: Sequence[KeyView]) -> list[Repeat | None]:
    """Find the earlier view that each object of a frame repeats; None for a new object.

    Parameters
    ----------
    views : the objects of the frame.
    keys : described views in earlier frames of the same topic, the oldest first.

    Notes
    -----
    Only depth images are compared: point clouds do not show which surface hides which.
    """
    if not keys or not views:
        return [None] * len(views)
    summaries = np.array([view.summary for view in views], _SUMMARY)
    key_summaries = np.array([key.view.summary for key in keys], _SUMMARY)
    alike, moves = _similar(summaries[:, None], key_summaries[None]), dict[int, Move]()
    repeats: list[Repeat | None] = []
    for view, row in zip(views, alike, strict=True):
        newest_first = np.flatnonzero(row)[::-1].tolist()
        tries = (_repeat(view, keys[k], moves) for k in newest_first[:_TRIES])
        repeats.append(next((repeat for repeat in tries if repeat is not None), None))
    return repeats


def _repeat(view: ObjectView, key: KeyView, moves: dict[int, Move]) -> Repeat | None:
    """Return the repeat of a view if the points of the object agree as well, else None.

    ``moves`` holds the motion since each earlier frame, by its number; a missing one is added.
    """
    earlier = key.view.frame.index
    if earlier not in moves:
        moves[earlier] = _between(key.view, view)
    move = moves[earlier]
    agrees = _agree(key.view, view, move.pose) and _agree(view, key.view, move.back)
    return Repeat(key, move) if agrees else None


def reused(repeat: Repeat, view: ObjectView) -> Detection:
    """Return the detection of the object in ``view``, copied from the earlier view it repeats.

    The surface and the full box are moved to the current sensor frame.
    """
    (key, move), first = repeat, repeat.key.detection
    return Detection(
        candidate=view.candidate,
        gas=first.gas if move is _REST else _moved_gas(move, first.gas),
        descriptor=first.descriptor,
        posterior=first.posterior,
        novelty=first.novelty,
        seconds=0.0,
        full=first.full if move is _REST else _moved_box(move, first.full),
        reused_from=key.view.frame.index,
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


def _similar(views: Records, keys: Records) -> Bool:
    """Return which pairs of summaries, records of `_SUMMARY`, are alike; the arrays broadcast."""
    ray, key_ray = views["ray_m"], keys["ray_m"]
    distance, key_distance = np.linalg.norm(ray, axis=-1), np.linalg.norm(key_ray, axis=-1)
    area = views["pixels"] * distance**2 / (keys["pixels"] * key_distance**2)
    turned = (ray * key_ray).sum(axis=-1) / (distance * key_distance)
    tilted = (views["up"] * keys["up"]).sum(axis=-1)
    return np.asarray(
        (views["kind"] == keys["kind"])
        & (np.linalg.norm(views["center_m"] - keys["center_m"], axis=-1) <= _PLACE_M)
        & (turned >= np.cos(np.radians(_TURN_DEG)))
        & (tilted >= np.cos(np.radians(_UP_DEG)))
        & (np.abs(distance / key_distance - 1) <= _FARTHER)
        & (np.abs(area - 1) <= _AREA)
        & (np.abs(views["size_m"] - keys["size_m"]).max(axis=-1) <= _SIZE_M)
        & (np.abs(views["height_m"] - keys["height_m"]) <= _HEIGHT_M)
    )


def _agree(one: ObjectView, other: ObjectView, move: Pose) -> bool:
    """Return whether the points of an object agree with the depth image of another view.

    ``move`` is ``other_from_one``.
    """
    a, b = one.frame, other.frame
    if a.depth is None or a.camera is None or b.depth is None or b.camera is None:
        return False
    share, bias = agreement(one.candidate.indices, a.depth, a.camera, b.depth, b.camera, move)
    return share >= _AGREE and abs(bias) <= _BIAS


_REST = Move(IDENTITY, IDENTITY, np.array([0.0, 0.0, 0.0, 1.0]))
"""The move of a sensor at rest."""


def _between(one: ObjectView, other: ObjectView) -> Move:
    """Return the motion of the sensor from one view to another; `_REST` without a fixed frame."""
    a, b = one.pose, other.pose
    if a is None or b is None:
        return _REST
    if np.array_equal(a.rotation, b.rotation) and np.array_equal(a.translation, b.translation):
        return _REST
    pose = compose(inverse(b), a)
    return Move(pose, inverse(pose), quaternion_from_rotation(pose.rotation))
