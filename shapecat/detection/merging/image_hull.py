"""Convex hulls of segments in the image, as support functions.

The support function of the hull around two hulls is the maximum of theirs.
"""

import math

import numpy as np

from shapecat.arrays import F4
from shapecat.detection.planes.extent import COS, DIRECTIONS, SIN
from shapecat.jit import kernel

__all__ = ["extend_hull", "hull_area"]

_COS, _SIN = COS.astype(np.float32), SIN.astype(np.float32)


@kernel(inline=True)
def extend_hull(hull: F4, row: int, first: int, last: int) -> None:
    """Extend a hull (`DIRECTIONS`,), in place, to cells of a row, from ``first`` up to ``last``."""
    for d in range(DIRECTIONS):
        column = np.float32(first if _COS[d] < 0 else last)
        hull[d] = max(hull[d], column * _COS[d] + row * _SIN[d])


@kernel(inner=True)
def hull_area(a: F4, b: F4) -> float:
    """Return the area of the convex hull around hulls ``a`` and ``b`` (`DIRECTIONS`,), in cells.

    The area includes half a cell around the centres of the outermost cells. It is half the sum,
    over the sides of the polygon, of length times distance from the origin. The length of a side
    follows from its neighbours.
    """
    turn, half = 2 * math.pi / DIRECTIONS, np.float32(0.5)  # cells are squares, not points
    twice, total = 2 * math.cos(turn), 0.0
    before = max(a[DIRECTIONS - 2], b[DIRECTIONS - 2]) + half
    extent = max(a[DIRECTIONS - 1], b[DIRECTIONS - 1]) + half
    for d in range(DIRECTIONS):
        after = max(a[d], b[d]) + half
        total += extent * (before + after - twice * extent)
        before, extent = extent, after
    return float(total / (2 * math.sin(turn)))
