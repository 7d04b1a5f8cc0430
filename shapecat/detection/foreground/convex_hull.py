"""Filled convex hull of a connected part of the grid."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.depth_grid import row_and_column
from shapecat.jit import kernel

__all__ = ["fill_hull"]


@kernel(inline=True)
def fill_hull(residual: F4, part: I4, cells: I4, count: int) -> int:
    """Add to a part the low cells within its convex hull; return its new number of cells.

    Parameters
    ----------
    residual : (rows, columns) not 0 in low cells.
    part : (rows, columns) numbers of the parts, changed in place.
    cells, count : the first ``count`` elements of ``cells`` are the flat indices of the part's
        cells; those of the added cells are appended.
    """
    rows, columns = residual.shape
    parts = part.reshape(-1)
    label = parts[cells[0]]
    left, right = np.full(rows, float(columns)), np.full(rows, -1.0)
    for t in range(count):
        i, j = row_and_column(cells[t], columns)
        left[i], right[i] = min(left[i], j), max(right[i], j)
    first, last = 0, rows - 1
    while right[first] < 0:
        first += 1
    while right[last] < 0:
        last -= 1
    for i in range(rows):
        right[i] = -right[i]
    _straighten(left, first, last)
    _straighten(right, first, last)
    top = count
    for i in range(first, last + 1):
        for j in range(math.ceil(left[i] - 1e-6), math.floor(1e-6 - right[i]) + 1):
            if part[i, j] != label and residual[i, j] != 0:
                cells[top] = i * columns + j
                part[i, j] = label
                top += 1
    return top


@kernel(inner=True)
def _straighten(side: F8, first: int, last: int) -> None:
    """Replace one side of an outline with the same side of its convex hull, in place.

    ``side`` (rows,) is the column of the outline in each row from ``first`` to ``last``, negated if
    it is the right side.
    """
    corners = np.zeros(side.size, np.int32)
    n = 0
    for i in range(first, last + 1):
        while n > 1:
            a, b = corners[n - 2], corners[n - 1]
            if (side[b] - side[a]) * (i - a) < (side[i] - side[a]) * (b - a):
                break
            n -= 1
        corners[n] = i
        n += 1
    for k in range(1, n):
        a, b = corners[k - 1], corners[k]
        for i in range(a + 1, b):
            side[i] = side[a] + (side[b] - side[a]) * (i - a) / (b - a)
