"""Outlines of footprints as support functions: how far points, a circle, both reach each way.

The reach h of a convex outline in the direction t is the largest ``p . t`` of its points. That of a
circle is ``center . t + radius``, linear in what is sought; that of a union is the larger one.
"""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.jit import kernel

__all__ = ["DIRECTIONS", "QUARTER", "fit_circle", "narrowest", "reach", "rectangle"]

DIRECTIONS = 96
"""Every 3.75 degrees; a quarter turn is a whole number of them."""
QUARTER, _HALF = DIRECTIONS // 4, DIRECTIONS // 2
_ROUNDS = 5
_OUTLIER = 0.05
"""Deviations beyond this share of the radius are of handles, and pull no harder."""
_SEEN = -0.03
"""Where points reach as far as this share of the radius short of the circle, its rim is seen."""


@kernel
def reach(x: F4, y: F4, stray: int, cosines: F8, sines: F8) -> F8:
    """Return (k,) how far points reach in each of k directions, but for ``stray`` points each."""
    result, highest = np.zeros(cosines.size), np.zeros(stray + 1, np.float32)
    for k in range(cosines.size):
        a, b = np.float32(cosines[k]), np.float32(sines[k])
        highest[:] = -np.inf
        least = highest[0]
        for i in range(x.size):
            value = a * x[i] + b * y[i]
            if value > least:
                _insert(highest, value)
                least = highest[0]
        result[k] = least
    return result


@kernel
def _insert(ascending: F4, value: float) -> None:
    """Put a value in its place in a list, whose least one is lost."""
    at = 1
    while at < ascending.size and ascending[at] < value:
        ascending[at - 1] = ascending[at]
        at += 1
    ascending[at - 1] = value


@kernel
def fit_circle(reached: F8, cosines: F8, sines: F8, toward: F8) -> tuple[F8, float]:
    """Fit a circle to what a sensor sees of its outline, by weighted least squares.

    The half that faces the sensor is seen wherever it looks from; of the other half, what turns out
    to reach as far as the circle, as the far rim of a bowl does.

    Parameters
    ----------
    reached : (k,) of `reach`.
    toward : (2,) unit vector to the sensor.

    Returns
    -------
    (3,) the centre and the radius; the root mean square deviation of the half that faces the
    sensor, in metres.
    """
    circle: F8 = np.zeros(3)
    for step in range(_ROUNDS):
        A, b = np.zeros((3, 3)), np.zeros(3)
        for k in range(reached.size):
            row = (cosines[k], sines[k], 1.0)
            off = reached[k] - (circle[0] * row[0] + circle[1] * row[1] + circle[2])
            facing = row[0] * toward[0] + row[1] * toward[1] > -1e-6
            limit = _OUTLIER * circle[2]
            if not facing and (step == 0 or off < _SEEN * circle[2]):
                continue
            weight = 1.0 if step == 0 or abs(off) < limit else limit / abs(off)
            for i in range(3):
                b[i] += weight * row[i] * reached[k]
                for j in range(3):
                    A[i, j] += weight * row[i] * row[j]
        circle = np.linalg.solve(A, b)
    total = count = 0.0
    for k in range(reached.size):
        if cosines[k] * toward[0] + sines[k] * toward[1] > -1e-6:
            off = reached[k] - (circle[0] * cosines[k] + circle[1] * sines[k] + circle[2])
            total, count = total + off * off, count + 1.0
    return circle, np.sqrt(total / count)


@kernel
def narrowest(reached: F8) -> int:
    """Return which of the first quarter of directions a rectangle of the least area has."""
    best, least = 0, np.inf
    for k in range(QUARTER):
        length = reached[k] + reached[k + _HALF]
        width = reached[k + QUARTER] + reached[(k + 3 * QUARTER) % DIRECTIONS]
        if length * width < least - 1e-9:
            best, least = k, length * width
    return best


@kernel
def rectangle(reached: F8, side: int) -> tuple[float, float, float, float]:
    """Return the centre of an outline along a direction and across it, its length and its width."""
    ahead, left = reached[side], reached[side + QUARTER]
    back, right = reached[side + _HALF], reached[side + QUARTER + _HALF]
    return 0.5 * (ahead - back), 0.5 * (left - right), ahead + back, left + right
