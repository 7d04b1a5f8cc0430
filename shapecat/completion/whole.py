"""The whole box of an object of which one side is seen."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8
from shapecat.completion.outline import (
    DIRECTIONS,
    QUARTER,
    fit_circle,
    narrowest,
    reach,
    rectangle,
)
from shapecat.geometry import gravity_rotation, quaternion_from_rotation
from shapecat.types import FullBox

__all__ = ["ENOUGH_POINTS", "complete"]

_ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)
ENOUGH_POINTS = 256
"""So many points tell the outline; more cost time."""

_STRAY, _STRAY_CURVED = 0.016, 0.004
"""Share of the points that noise and mixed pixels put beyond the outline, either way: fewer
where a surface curves away than where many points lie at the outline, as those of a wall do."""
_CURVED = ("bowl", "plate", "ball")
_TOP = 0.98
"""Share of the points below the top."""
_HANDLE = 0.15
"""What reaches farther beyond the circle of a cup, as a share of its radius, is a handle."""
_WIDER = 1.1
"""A cup is seen into, to its far rim: a circle that is so much wider than what is seen is wrong."""
_ROUND = 0.1
"""A circle fits if the side that is seen deviates by less than this share of the radius."""
_NOISE_M, _GUESS = 0.006, 0.35
"""Deviation of a length that is seen, and of the part that is guessed, as a share of it."""
_ANGULAR, _HANDLED = "box", "cup"


def complete(
    points: F4, up: ArrayLike, offset: float, posterior: F4, categories: Sequence[str]
) -> FullBox:
    """Estimate the box around all of an object from the points that are seen of it.

    It stands on its support. If it is angular, its footprint is what is seen; else the footprint
    has the circle that is seen the front of, and beyond it what else is seen, such as a handle.
    Where no circle fits, as to a bottle that lies, the footprint is what is seen as well.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame, finite; the sensor is at the origin.
    up : (3,) unit vector, sensor frame.
    offset : metres; ``up @ p`` of the support.
    posterior : (c,) in the order of ``categories``.

    Raises
    ------
    ValueError : there is no point.
    """
    if len(points) == 0:
        msg = "a box needs at least one point"
        raise ValueError(msg)
    level = gravity_rotation(up)
    some = points[:: max(1, -(-len(points) // ENOUGH_POINTS))] @ level.T.astype(np.float32)
    some[:, 2] -= np.float32(offset)
    likely = dict(zip(categories, np.asarray(posterior).tolist(), strict=True))
    category = max(likely, key=likely.__getitem__)
    bounds = _bounds(some[:, 2])
    seen = _reach(some, _STRAY_CURVED if category in _CURVED else _STRAY)
    circle = _circle(seen, some)
    if circle is not None and category == _HANDLED and 2 * circle[2] > _WIDER * _width(seen):
        circle = None  # through the handle
    if circle is None:
        return _box(seen, seen, narrowest(seen), 1.0, bounds, level, offset)
    whole, side = _whole(seen, circle, handled=category == _HANDLED)
    angular = likely.get(_ANGULAR, 0.0)
    side = narrowest(seen) if angular > 0.5 else side
    return _box(seen, whole, side, angular, bounds, level, offset)


def _reach(points: F4, stray: float) -> F8:
    x, y = np.ascontiguousarray(points[:, :2].T)
    return np.asarray(reach(x, y, int(stray * len(points)), _COSINES, _SINES))


def _width(seen: F8) -> float:
    return float(min(rectangle(seen, narrowest(seen))[2:]))


def _bounds(heights: F4) -> tuple[float, float, float]:
    """Return the bottom, the lowest height that is seen, and the top, above the support."""
    ascending, stray = np.sort(heights), int((1 - _TOP) * len(heights))
    lowest, top = float(ascending[stray]), float(ascending[-1 - stray])
    return min(0.0, top), lowest, top


def _whole(seen: F8, circle: F8, *, handled: bool) -> tuple[F8, int]:
    """Return how far a circle reaches, with its handle, and the side that the box goes along."""
    whole = circle[0] * _COSINES + circle[1] * _SINES + circle[2]
    beyond = seen - whole
    way = int(beyond.argmax())
    if not handled or beyond[way] < _HANDLE * circle[2]:
        return whole, 0
    whole[way] = seen[way]
    return whole, way % QUARTER


def _circle(seen: F8, points: F4) -> F8 | None:
    """Return centre and radius (3,) of the footprint of something round; None if it is not."""
    x, y = (points[:, :2].sum(axis=0) / len(points)).tolist()
    distance = max(math.hypot(x, y), 1e-9)
    toward = np.array([-x / distance, -y / distance])
    circle, deviation = fit_circle(seen, _COSINES, _SINES, toward)
    return circle if deviation < _ROUND * circle[2] else None


def _box(
    seen: F8,
    whole: F8,
    side: int,
    angular: float,
    bounds: tuple[float, float, float],
    level: F8,
    offset: float,
) -> FullBox:
    """Return the box of a footprint: of what is seen if it is likely angular, else of the whole."""
    chosen = seen if angular > 0.5 else whole
    bottom, lowest, top = bounds
    x, y, length, width = rectangle(chosen, side)
    _, _, seen_length, seen_width = rectangle(seen, side)
    _, _, whole_length, whole_width = rectangle(whole, side)
    guessed = (length - seen_length, width - seen_width, lowest - bottom)
    unsure = math.sqrt(angular * (1 - angular))
    doubt = (unsure * (whole_length - seen_length), unsure * (whole_width - seen_width), 0.0)
    c, s = _COSINES[side], _SINES[side]
    sensor_from_box = (np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ level).T
    return FullBox(
        sensor_from_box @ (x, y, (bottom + top) / 2 + offset),
        np.array([length, width, top - bottom]),
        quaternion_from_rotation(sensor_from_box),
        np.hypot(_NOISE_M, np.hypot(np.multiply(_GUESS, guessed), doubt)),
    )
