"""Grazing: a board just below the camera, of which a few rows of the image are seen.

Its inverse depth changes so much from row to row that the readings on it cannot be told to be
level within a few degrees, but by height they lie within millimetres: where the up of the other
planes is known, height alone is left to be found.
"""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import Cells, Lens
from shapecat.detection.planes.extent import ARM, LEAST_AREA_M2, Support, support_of
from shapecat.detection.planes.horizontal import by_height, fullest
from shapecat.detection.planes.ransac import (
    TOLERANCE,
    Readings,
    among,
    cosine,
    level_plane,
    middle_of,
    normal_of,
    refit,
)
from shapecat.jit import kernel

__all__ = ["add_grazing"]

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


@kernel
def add_grazing(cells: Cells, found: list[tuple[Support, Readings]], up: F8) -> None:
    """Append the board seen at a grazing angle, if there is one at another height than others."""
    known = np.zeros(len(found))
    for k, (support, _) in enumerate(found):
        known[k] = support.offset
    deepest = abs(up[1]) / (cells.lens.fy * STEEP)
    readings, height = _grazing_readings(cells.w, cells.lens, up, deepest, known)
    if height.size < LEAST_READINGS:
        return
    near, plane, count = _fit(cells.lens, up, readings, height, deepest)
    if count < LEAST_READINGS:
        return
    board = support_of(cells, near, plane)
    if board.area_m2 >= LEAST_AREA_M2:
        found.append((board, near))


@kernel
def _fit(
    lens: Lens, up: F8, found: Readings, height: F4, deepest: float
) -> tuple[Readings, F8, int]:
    """Return the readings at one height, a plane (a, b, c), and how many of them lie in it.

    These are 0 if the plane is not level.
    """
    order, starts = by_height(height, -deepest, int(deepest / BIN_M) + 1)
    bins = starts.size - 1
    peak = fullest(starts, np.zeros(bins, np.bool_))
    chosen = order[starts[max(peak - 1, 0)] : starts[min(peak + 2, bins)]]
    near = among(found, chosen)
    plane = level_plane(lens, up, middle_of(height, chosen))
    # The less the plane is known, the wider the gate: at first half the way to the next row.
    gate = abs(plane[1]) / 2
    count = 0
    for _ in range(4):
        count = refit(near.j, near.i, near.w, gate, plane)
        gate = max(gate / 2, 1.5 * TOLERANCE)
    return near, plane, count if cosine(normal_of(plane, lens), up) >= STEADY_COS else 0


@kernel
def _grazing_readings(w: F4, lens: Lens, up: F8, deepest: float, known: F8) -> tuple[Readings, F4]:
    """Return the cells on every fourth column that are nearer to level than to upright.

    Only those less than ``deepest`` below the camera, and off the ``known`` heights, come with
    their heights.
    """
    rows, columns = w.shape
    across, down = up[0] / lens.fx, up[1] / lens.fy
    found = np.zeros((4, w.size // 4 + rows), np.float32)
    n = 0
    for i in range(1, rows - 1):
        start = across * -lens.cx + down * (i - lens.cy) + up[2]
        some, here = False, w[i]
        for j in range(columns):  # few rows have any; this vectorises
            rise = start + across * j
            some |= (rise < 0) & (rise > -deepest * here[j])
        if not some:
            continue
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
                found[0, n], found[1, n], found[2, n], found[3, n] = j, i, center, h
                n += 1
    return Readings(found[0, :n], found[1, :n], found[2, :n], 4), found[3, :n]
