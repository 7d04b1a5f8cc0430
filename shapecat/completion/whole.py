"""The full box of an object that is seen from one side."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8, Bool
from shapecat.completion.outline import (
    COSINES,
    SINES,
    fit_oval,
    rectangle,
    smallest_rectangle_side,
    support_function,
)
from shapecat.geometry import levelled, quaternion_from_rotation
from shapecat.types import FullBox

__all__ = ["ENOUGH_POINTS", "Footprint", "complete", "faced", "footprint"]

ENOUGH_POINTS = 256
"""Maximum number of points used for the outline; more only cost time."""

_TOP = 0.98
"""Fraction of the points below the top; the others count as noise, and as many of the lowest."""
_NOISY_M = 0.004
"""Largest height by which noise lifts points of a flat top, metres."""
_FLAT = 1 / 3
"""A face with at least this fraction of the points counts as flat, one with fewer in proportion."""
_HANDLE = 0.06
"""Minimum length by which a handle sticks out of a cup's oval, as a fraction of the radius."""
_EDGEWISE = -0.2
"""Minimum cosine between the direction to the sensor and a direction in which the outline is
visible: just past edge-on."""
_THINNEST_M = 0.005
"""Minimum length of a box: a face that the sensor sees straight on shows no thickness."""
_NOISE_M = 0.006
"""Standard deviation of a visible length, metres."""
_GUESS = 0.35
"""Standard deviation of the guessed part of a length, as a fraction of this part."""
_ANGULAR, _HANDLED = "box", "cup"
"""The category whose footprint has corners, and the one with a handle."""
_CIRCULAR = 1e3
"""A value of ``roundness`` that leaves only circles."""


class _OutlinePrior(NamedTuple):
    """Prior knowledge about the outlines of a category.

    Attributes
    ----------
    stray : fraction of the points that noise and mixed pixels put outside the outline. It is
        smaller if the surface curves away than if many points lie on the outline, as on a wall.
    noise : metres, the spread of the depths on a flat side.
    roundness : weight of the prior for a circle, as a number of directions. A prior is needed
        since the visible side says little about how deep the object is.
    fits : largest root mean square deviation of the visible side from an accepted oval, as a
        fraction of its radius.
    """

    stray: float = 0.016
    noise: float = 0.0
    roundness: float = 5.0
    fits: float = 0.07


_PRIORS = {
    # A handle would be mistaken for the long side of an oval.
    "cup": _OutlinePrior(roundness=_CIRCULAR),
    "box": _OutlinePrior(noise=0.006),
    "bottle": _OutlinePrior(roundness=1.0, fits=0.1),  # many are oval
    "bowl": _OutlinePrior(stray=0.004),
    "plate": _OutlinePrior(stray=0.004),
    "ball": _OutlinePrior(stray=0.004, roundness=_CIRCULAR, fits=math.inf),
}


class Footprint(NamedTuple):
    """The rectangle around a footprint.

    Attributes
    ----------
    center : (2,) metres, along the directions 0 and `QUARTER` of the outline.
    size, std : (2,) metres, length and width, and their standard deviations.
    side : index of the direction of the length.
    oval : whether the footprint is an oval, not the visible outline.
    """

    center: F8
    size: F8
    std: F8
    side: int
    oval: bool


def complete(
    points: F4, up: ArrayLike, offset: float, posterior: F4, categories: Sequence[str]
) -> FullBox:
    """Estimate the box around a whole object from its visible points.

    The box stands on the support; its base is the rectangle of `footprint`.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame, finite; the sensor is at the origin. If there are more
        than `ENOUGH_POINTS`, every k-th point is used.
    up : (3,) unit vector, sensor frame.
    offset : metres, ``up @ p`` for the points p of the support.
    posterior : (c,) probabilities, in the order of ``categories``.

    Raises
    ------
    ValueError : ``points`` is empty.
    """
    levelled_points, level = levelled(points[:: max(1, -(-len(points) // ENOUGH_POINTS))], up)
    levelled_points[:, 2] -= np.float32(offset)
    facing = faced(-levelled_points[:, :2].mean(axis=0, dtype=np.float64))
    outline = _visible_outline(levelled_points, facing, categories[int(np.argmax(posterior))])
    plan = footprint(outline, facing.astype(np.float64), posterior, categories)
    bottom, lowest, top = _bounds(levelled_points[:, 2])
    c, s = COSINES[plan.side], SINES[plan.side]
    sensor_from_box = (np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ level).T
    x, y = plan.center
    around = outline - x * COSINES - y * SINES
    return FullBox(
        level.T @ (x, y, (bottom + top) / 2 + offset),
        np.array([*plan.size, max(top - bottom, _THINNEST_M)]),
        quaternion_from_rotation(sensor_from_box),
        np.array([*plan.std, math.hypot(_NOISE_M, _GUESS * (lowest - bottom))]),
        np.roll(around, -plan.side),
    )


def faced(toward: F8) -> Bool:
    """Return whether each direction of an outline faces a sensor: (..., `DIRECTIONS`) bool.

    ``toward`` (..., 2) are horizontal vectors from the object to the sensors.
    """
    x, y = toward[..., :1], toward[..., 1:]
    return np.asarray(x * COSINES + y * SINES > _EDGEWISE * np.maximum(np.hypot(x, y), 1e-9))


def footprint(outline: F8, facing: F8, posterior: F8, categories: Sequence[str]) -> Footprint:
    """Estimate the footprint of an object from its visible outline.

    For a box, the footprint is the visible outline. For other categories, it is the oval fitted to
    the visible side; a cup's handle is added. If no oval fits, as for a bottle that lies down, the
    visible outline is used instead. The result is the smallest rectangle around the footprint.

    Parameters
    ----------
    outline : (96,) metres, the support function of the visible points.
    facing : (96,) weight of each direction, 0 for those that face no sensor.
    posterior : (c,) probabilities, in the order of ``categories``.
    """
    likely = dict(zip(categories, np.asarray(posterior).tolist(), strict=True))
    category, angular = max(likely, key=likely.__getitem__), likely.get(_ANGULAR, 0.0)
    prior = _PRIORS.get(category, _OutlinePrior())
    oval, radius, deviation = fit_oval(outline, facing, prior.roundness)
    if category == _HANDLED and (outline - oval)[facing > 0].max() > _HANDLE * radius:
        oval = np.maximum(oval, np.where(facing > 0, outline, oval))
    full_outline = oval if deviation < prior.fits * radius else outline
    chosen = outline if category == _ANGULAR else full_outline
    side = smallest_rectangle_side(chosen)
    along, across, *size = rectangle(chosen, side)
    guessed = np.subtract(size, rectangle(outline, side)[2:])
    doubt = math.sqrt(angular * (1 - angular)) * np.subtract(
        rectangle(full_outline, side)[2:], rectangle(outline, side)[2:]
    )
    c, s = COSINES[side], SINES[side]
    return Footprint(
        np.array([c * along - s * across, s * along + c * across]),
        np.maximum(size, _THINNEST_M),
        np.hypot(_NOISE_M, np.hypot(_GUESS * guessed, doubt)),
        side,
        chosen is not outline,
    )


def _visible_outline(points: F4, facing: Bool, category: str) -> F8:
    """Return the outline (96,), metres, of the visible points of an object, without outliers.

    ``points`` (n, 3) are in the level frame, metres; ``facing`` (96,) says which directions face
    the sensor. The prior of ``category`` tells how many points are outliers.
    """
    x, y = np.ascontiguousarray(points[:, :2].T)
    prior = _PRIORS.get(category, _OutlinePrior())
    # Noise is along the rays: less of it lies beyond edges that face no sensor.
    strays = (np.where(facing, 1.0, 0.5) * prior.stray * len(points)).astype(np.int64)
    return np.asarray(support_function(x, y, strays, prior.noise, _FLAT, COSINES, SINES))


def _bounds(heights: F4) -> tuple[float, float, float]:
    """Return bottom, lowest visible height and top of an object, metres, without outliers.

    ``heights`` (n,) are those of its points above the support. The bottom is at 0, or at the top if
    that is lower.
    """
    ascending, stray = np.sort(heights), int((1 - _TOP) * len(heights))
    lowest, top = float(ascending[stray]), float(ascending[-1 - stray])
    near_top = ascending[np.searchsorted(ascending, top - _NOISY_M) :]
    flat = min(1.0, len(near_top) / (_FLAT * len(ascending)))
    top -= flat * (top - float(near_top[len(near_top) // 2]))
    return min(0.0, top), lowest, top
