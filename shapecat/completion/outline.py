"""Outlines of footprints as support functions.

The support function of a convex outline in the direction t is the largest ``x . t`` over its points
x: the extent of the outline in that direction. For a circle it is ``center . t + radius``. An oval
adds ``p cos 2a + q sin 2a``, to first order, where a is the angle of t. Both formulas are linear in
their unknowns. The support function of a union of outlines is the maximum of their support
functions.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.jit import kernel

__all__ = [
    "COSINES",
    "DIRECTIONS",
    "QUARTER",
    "SINES",
    "fit_oval",
    "rectangle",
    "smallest_rectangle_side",
    "support_function",
]

DIRECTIONS = 96
"""Number of directions of an outline, 3.75 degrees apart; divisible by 4."""
_ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COSINES, SINES = np.cos(_ANGLES), np.sin(_ANGLES)
QUARTER, _HALF = DIRECTIONS // 4, DIRECTIONS // 2
_ROUNDS = 5
"""Number of iterations of `fit_oval`."""
_OUTLIER = 0.03
"""Huber threshold of the fit, as a fraction of the radius: handles deviate more."""


@kernel
def support_function(
    x: F4, y: F4, strays: I4, noise: float, flat: float, cosines: F8, sines: F8
) -> F8:
    """Return the support function (k,) of points in k directions, ignoring outliers.

    The value of a flat side is the mean over its points, since noise would make their maximum too
    large.

    Parameters
    ----------
    x, y : (n,) the points, metres.
    strays : (k,) number of farthest points to ignore in each direction.
    noise : metres; points within this distance of the farthest one form its side; 0 turns off the
        correction for flat sides.
    flat : fraction of the points that a side needs for the full correction; a side with fewer is
        corrected in proportion.
    cosines, sines : (k,) the directions.
    """
    max_skipped = 0
    for count in strays:
        max_skipped = max(max_skipped, count)
    result, highest = np.zeros(cosines.size), np.zeros(max_skipped + 1, np.float32)
    for k in range(cosines.size):
        a, b = np.float32(cosines[k]), np.float32(sines[k])
        first = highest.size - 1 - strays[k]
        highest[first:] = -np.inf
        threshold = highest[first]
        for i in range(x.size):
            value = a * x[i] + b * y[i]
            if value > threshold:
                _replace_smallest(highest, first, value)
                threshold = highest[first]
        result[k] = threshold
        if noise > 0:
            result[k] -= _overshoot(x, y, a, b, threshold, noise, flat)
    return result


@kernel(inline=True)
def _overshoot(x: F4, y: F4, a: float, b: float, top: float, noise: float, flat: float) -> float:
    """Return how far ``top`` is beyond the mean of its side, metres; less if the side is not flat.

    ``top`` is the support function in the direction (``a``, ``b``); the side consists of the points
    less than ``noise`` below it. The other parameters are as in `support_function`.
    """
    count, total = 0, 0.0
    for i in range(x.size):
        below = top - (a * x[i] + b * y[i])
        if below < noise:
            count, total = count + 1, total + below
    return min(1.0, count / (flat * x.size)) * total / count


@kernel(inline=True)
def _replace_smallest(ascending: F4, first: int, value: float) -> None:
    """Insert a value into a list that is sorted from ``first``; the smallest value drops out.

    ``ascending`` (n,) is the list, ``first`` the index of its smallest value.
    """
    at = first + 1
    while at < ascending.size and ascending[at] < value:
        ascending[at - 1] = ascending[at]
        at += 1
    ascending[at - 1] = value


def fit_oval(outline: F8, facing_weights: F8, roundness: float) -> tuple[F8, float, float]:
    """Fit an oval to an outline that is seen from one side, by robust least squares.

    A direction that faces no sensor counts only if the outline reaches the oval there, as the far
    rim of a bowl does.

    Parameters
    ----------
    outline : (`DIRECTIONS`,) metres, from `support_function`.
    facing_weights : (`DIRECTIONS`,) weight of each direction, 0 for those that face no sensor.
    roundness : weight of the prior for a circle, as a number of directions.

    Returns
    -------
    The support function (`DIRECTIONS`,) of the oval, its mean radius, and the root mean square
    deviation of the outline from it, in the directions that face a sensor; metres.
    """
    rows = np.ones((5, outline.size))
    rows[0], rows[1] = COSINES, SINES
    rows[3], rows[4] = COSINES**2 - SINES**2, 2 * COSINES * SINES
    weights = facing_weights.copy()
    oval: F8 = np.zeros(outline.size)
    x: F8 = np.zeros(5)
    for _ in range(_ROUNDS):
        A = (rows * weights) @ rows.T
        A[3, 3] += roundness
        A[4, 4] += roundness
        x = np.linalg.solve(A, (rows * weights) @ outline)
        oval = x @ rows
        limit = _OUTLIER * abs(x[2]) + 1e-9
        off = outline - oval
        reached = np.where(facing_weights > 0, facing_weights, off > -limit)
        weights = reached * np.minimum(1.0, limit / np.maximum(np.abs(off), 1e-12))
    facing = facing_weights > 0
    off = (outline - oval)[facing]
    return oval, float(x[2]), float(np.sqrt((off * off).mean()))


@kernel
def smallest_rectangle_side(reached: F8) -> int:
    """Return the direction of the smallest rectangle around an outline: an index below `QUARTER`.

    ``reached`` (`DIRECTIONS`,) is the support function, metres.
    """
    best, smallest_area = 0, np.inf
    for k in range(QUARTER):
        length = reached[k] + reached[k + _HALF]
        width = reached[k + QUARTER] + reached[(k + 3 * QUARTER) % DIRECTIONS]
        if length * width < smallest_area - 1e-9:
            best, smallest_area = k, length * width
    return best


def rectangle(reached: F8, side: int) -> tuple[float, float, float, float]:
    """Return the rectangle around an outline with its length along a given direction.

    Parameters
    ----------
    reached : (`DIRECTIONS`,) metres, the support function.
    side : index of the direction, from `smallest_rectangle_side`.

    Returns
    -------
    Its centre along and across the direction, its length, and its width; metres.
    """
    ahead, left = reached[side], reached[side + QUARTER]
    back, right = reached[side + _HALF], reached[side + QUARTER + _HALF]
    return 0.5 * (ahead - back), 0.5 * (left - right), ahead + back, left + right
