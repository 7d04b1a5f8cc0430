"""Grazing: a board just below the camera, of which a few rows of the image are seen.

Its inverse depth changes so much from row to row that the readings on it cannot be told to be
level within a few degrees, but by height they lie within millimetres: where the up of the other
planes is known, height alone is left to be found.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells, Lens, middle_of
from shapecat.detection.consensus import TOLERANCE, level_plane, normal_of, refit
from shapecat.detection.planes import ARM, Support, by_height, fullest, listed, support_of
from shapecat.jit import kernel

__all__ = ["grazing_board"]

BIN_M = 0.01
LEAST_READINGS = 25
"""On every fourth column: as many cells as other planes need."""
APART_M = 0.06
"""What is nearer to the height of a known plane is part of it or of what lies on it."""
STEEP = 2 * TOLERANCE
"""Change of inverse depth from row to row, 1/m, that tells a level surface from an upright one
by two readings."""
STEADY_COS = 0.9998
"""Cosine of the largest angle, 1.1 degrees, to the other planes."""


def grazing_board(cells: Cells, supports: list[Support], up: F8) -> tuple[Support, I4] | None:
    """Return the board seen at a grazing angle that is not among ``supports``, and its cells."""
    lens = cells.lens
    deepest = abs(float(up[1])) / (lens.fy * STEEP)
    known = np.array([support.offset for support in supports])
    index = np.zeros(cells.w.size // 4 + cells.w.shape[0], np.int32)
    height = np.zeros(index.size, np.float32)
    n = _grazing_readings(cells.w, lens, up, deepest, known, index, height)
    if n < LEAST_READINGS:
        return None
    index, height = index[:n], height[:n]
    bins = int(deepest / BIN_M) + 1
    order, starts = by_height(index, height, -deepest, bins)
    peak = fullest(starts, np.zeros(bins, bool))
    near = order[starts[max(peak - 1, 0)] : starts[min(peak + 2, bins)]]
    if near.size < LEAST_READINGS:
        return None
    offset = middle_of(height[near])
    index = index[near]
    plane = level_plane(lens, up, offset)
    # The less the plane is known, the wider the gate: at first half the way to the next row.
    gate = abs(float(plane[1])) / 2
    j, i, w = listed(cells.w, index)
    for _ in range(4):
        count = refit(j, i, w, gate, plane)
        gate = max(gate / 2, 1.5 * TOLERANCE)
    if count < LEAST_READINGS or normal_of(plane, lens) @ up < STEADY_COS:
        return None
    support = support_of(cells, index, plane)
    return None if support is None else (support, index)


@kernel(leaf=True)
def _grazing_readings(
    w: F4, lens: Lens, up: F8, deepest: float, known: F8, index: I4, height: F4
) -> int:
    """Collect the cells on every fourth column that are nearer to level than to upright.

    Only those less than ``deepest`` below the camera, and off the ``known`` heights.
    """
    rows, columns = w.shape
    across, down = up[0] / lens.fx, up[1] / lens.fy
    n = 0
    for i in range(1, rows - 1):
        start = across * -lens.cx + down * (i - lens.cy) + up[2]
        for j in range(ARM, columns - ARM, 4):
            center, rise = w[i, j], start + across * j
            if rise >= 0 or rise <= -deepest * center:
                continue
            # On a level surface w / rise is the same everywhere; one row on this is w * down.
            limit = 0.5 * abs(down) * center
            above = abs(w[i - 1, j] * rise - center * (rise - down)) < limit
            below = abs(w[i + 1, j] * rise - center * (rise + down)) < limit
            left = abs(w[i, j - ARM] * rise - center * (rise - ARM * across)) < limit
            right = abs(w[i, j + ARM] * rise - center * (rise + ARM * across)) < limit
            if not ((above | below) & left & right):
                continue
            h = rise / center
            taken = False
            for k in range(known.size):
                taken |= abs(h - known[k]) < APART_M
            if not taken:
                index[n], height[n] = i * columns + j, h
                n += 1
    return n
