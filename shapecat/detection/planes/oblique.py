"""Oblique plane: a board just below the camera, of which a few rows of the image are seen.

Its inverse depth changes so much from row to row that the readings on it cannot be told to be
level within a few degrees, but by height they lie within millimetres: where the up of the other
planes is known, height alone is left to be found.
"""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import ARM, LEAST_AREA_M2, SupportingPlane, measure_plane
from shapecat.detection.planes.horizontal import by_height, fullest
from shapecat.detection.planes.ransac import (
    INLIER_TOLERANCE,
    DepthSamples,
    cosine,
    horizontal_plane,
    median_of,
    plane_normal,
    refine,
    select,
)
from shapecat.jit import kernel

__all__ = ["add_oblique_plane"]

BIN_M = 0.01
LEAST_READINGS = 25
"""On every fourth column: as many cells as other planes need."""
APART_M = 0.06
"""What is nearer to the height of a known plane is part of it or of what lies on it."""
STEEP = 2 * INLIER_TOLERANCE
"""Change of inverse depth from row to row, 1/m, that tells a level surface from an upright one
by two readings."""
STEADY_COS = 0.9998
"""Cosine of the largest angle, 1.1 degrees, to the other planes."""


@kernel
def add_oblique_plane(
    grid: DepthGrid, found: list[tuple[SupportingPlane, DepthSamples]], up: F8
) -> None:
    """Append the board seen at a grazing angle, if there is one at another height than others."""
    known = np.zeros(len(found))
    for k, (support, _) in enumerate(found):
        known[k] = support.offset
    deepest = abs(up[1]) / (grid.intrinsics.fy * STEEP)
    samples, height = _oblique_samples(grid.inverse_depth, grid.intrinsics, up, deepest, known)
    if height.size < LEAST_READINGS:
        return
    near, plane, count = _fit(grid.intrinsics, up, samples, height, deepest)
    if count < LEAST_READINGS:
        return
    board = measure_plane(grid, near, plane)
    if board.area_m2 >= LEAST_AREA_M2:
        found.append((board, near))


@kernel
def _fit(
    intrinsics: PinholeIntrinsics, up: F8, found: DepthSamples, height: F4, deepest: float
) -> tuple[DepthSamples, F8, int]:
    """Return the readings at one height, a plane (a, b, c), and how many of them lie in it.

    These are 0 if the plane is not level.
    """
    order, starts = by_height(height, -deepest, int(deepest / BIN_M) + 1)
    bins = starts.size - 1
    peak = fullest(starts, np.zeros(bins, np.bool_))
    chosen = order[starts[max(peak - 1, 0)] : starts[min(peak + 2, bins)]]
    near = select(found, chosen)
    plane = horizontal_plane(intrinsics, up, median_of(height, chosen))
    # The less the plane is known, the wider the gate: at first half the way to the next row.
    gate = abs(plane[1]) / 2
    count = 0
    for _ in range(4):
        count = refine(near.j, near.i, near.inverse_depth, gate, plane)
        gate = max(gate / 2, 1.5 * INLIER_TOLERANCE)
    return near, plane, count if cosine(plane_normal(plane, intrinsics), up) >= STEADY_COS else 0


@kernel
def _oblique_samples(
    inv_depth: F4, intrinsics: PinholeIntrinsics, up: F8, deepest: float, known: F8
) -> tuple[DepthSamples, F4]:
    """Return the cells on every fourth column that are nearer to level than to upright.

    Only those less than ``deepest`` below the camera, and off the ``known`` heights, come with
    their heights.
    """
    rows, columns = inv_depth.shape
    across, down = up[0] / intrinsics.fx, up[1] / intrinsics.fy
    found = np.zeros((4, inv_depth.size // 4 + rows), np.float32)
    n = 0
    for i in range(1, rows - 1):
        start = across * -intrinsics.cx + down * (i - intrinsics.cy) + up[2]
        some, here = False, inv_depth[i]
        for j in range(columns):  # few rows have any; this vectorises
            rise = start + across * j
            some |= (rise < 0) & (rise > -deepest * here[j])
        if not some:
            continue
        for j in range(ARM, columns - ARM, 4):
            center, rise = inv_depth[i, j], start + across * j
            if rise >= 0 or rise <= -deepest * center:
                continue
            # On a level surface w / rise is the same everywhere; one row on this is w * down.
            limit = 0.5 * abs(down) * center
            above = abs(inv_depth[i - 1, j] * rise - center * (rise - down)) < limit
            below = abs(inv_depth[i + 1, j] * rise - center * (rise + down)) < limit
            left = abs(inv_depth[i, j - ARM] * rise - center * (rise - ARM * across)) < limit
            right = abs(inv_depth[i, j + ARM] * rise - center * (rise + ARM * across)) < limit
            if not ((above | below) & left & right):
                continue
            h = rise / center
            taken = False
            for k in range(known.size):
                taken |= abs(h - known[k]) < APART_M
            if not taken:
                found[0, n], found[1, n], found[2, n], found[3, n] = j, i, center, h
                n += 1
    return DepthSamples(found[0, :n], found[1, :n], found[2, :n], 4), found[3, :n]
