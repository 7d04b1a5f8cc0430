"""Horizontal planes: one for each accumulation of level surface in height (thesis 4.3, Alg. 1)."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import (
    ARM,
    LEAST_AREA_M2,
    MARGIN_M,
    SupportingPlane,
    measure_plane,
    sort_by_height,
)
from shapecat.detection.planes.ransac import (
    INLIER_TOLERANCE,
    DepthSamples,
    cosine,
    count_inliers,
    horizontal_plane,
    median_of,
    plane_normal,
    ransac_plane,
    refine,
    select,
)
from shapecat.jit import kernel

__all__ = ["by_height", "find_horizontal_planes", "fullest"]

BIN_M = 0.01
MOST_LEVELS = 10
LEAST_CELLS = 100
MOST_HEIGHTS = 500
"""About as many readings tell the height of a level to begin with."""
LEVEL_COS2 = 0.82
"""Squared cosine of the largest angle, 25 degrees, of a level reading to the horizontal."""
STEADY_COS = math.cos(math.radians(6))
CLOSE, CLOSE_SHARE = 0.5, 0.75
"""Of the readings near a plane, less than this share is so close to one that is tilted between
two: a table and the plates on it."""
BEND = 0.024
GRAZING_SIN2 = 0.04
"""Squared sine of the angle, 11.5 degrees, below which a surface is seen at a grazing angle."""


@kernel
def find_horizontal_planes(
    grid: DepthGrid, up: F8, trials: F8
) -> list[tuple[SupportingPlane, DepthSamples]]:
    """Return the horizontal planes of the scene, lowest first, each with its readings."""
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    # (1), (2) readings whose surface is level
    level, height, order, starts = _level_readings(inv_depth, intrinsics, up)
    # (3) one plane candidate for each accumulation in height
    done = np.zeros(starts.size - 1, np.bool_)
    found: list[tuple[SupportingPlane, DepthSamples]] = []
    for _ in range(MOST_LEVELS):
        near, plane, count, close = _next_level(intrinsics, up, level, height, order, starts, done)
        if near.inverse_depth.size < LEAST_CELLS:
            break
        if count < LEAST_CELLS:
            continue
        # (4) refine, and keep what lies in the plane
        if close < CLOSE_SHARE * count:
            plane = _voted(intrinsics, near, up, trials, plane, close)
        support = measure_plane(grid, near, plane)
        if support.area_m2 >= LEAST_AREA_M2:
            found.append((support, near))
            _keep_off(plane, level, order, starts)
    # (5) ascending
    sort_by_height(found)
    return found


@kernel
def _level_readings(
    inv_depth: F4, intrinsics: PinholeIntrinsics, up: F8
) -> tuple[DepthSamples, F4, I4, I4]:
    """Find every second cell whose surface is level within 25 degrees.

    Returns
    -------
    These readings, their heights, and what `by_height` says of these.
    """
    rows, columns = inv_depth.shape
    even, odd = _halves(inv_depth)
    width = max((columns - 2 * ARM + 1) // 2, 0)
    x = (ARM + 2 * np.arange(width) - intrinsics.cx) / intrinsics.fx
    row = np.zeros(width, np.float32)
    found = np.zeros((4, width * (rows // 2) + 1), np.float32)
    j_of, i_of, w_of, height_of = found[0], found[1], found[2], found[3]
    lowest, highest = np.float32(np.inf), np.float32(-np.inf)
    n = np.uint32(0)  # a place without a sign is not asked whether it counts from the end
    for i in range(ARM, rows - ARM, 2):
        _find_level(even, odd, intrinsics, up, i, x, row)
        values = odd[i]
        for k in range(width):
            j_of[n], i_of[n], w_of[n], height_of[n] = ARM + 2 * k, i, values[ARM // 2 + k], row[k]
            level = row[k] < np.inf
            h = row[k] if level else highest
            lowest, highest = (row[k] if row[k] < lowest else lowest), max(h, highest)
            n += np.uint32(level)
    base = float(lowest) if n > 0 else 0.0
    bins = int((float(highest) - base) / BIN_M) + 1 if n > 0 else 1
    order, starts = by_height(height_of[:n], base, bins)
    return DepthSamples(j_of[:n], i_of[:n], w_of[:n], 4), height_of[:n], order, starts


@kernel
def _halves(inv_depth: F4) -> tuple[F4, F4]:
    """Return the even and the odd columns of an image: loops over these vectorise."""
    rows, columns = inv_depth.shape
    even = np.zeros((rows, (columns + 1) // 2), np.float32)
    odd = np.zeros((rows, columns // 2), np.float32)
    for i in range(rows):
        row, evens, odds = inv_depth[i], even[i], odd[i]
        for k in range(odds.size):
            evens[k], odds[k] = row[2 * k], row[2 * k + 1]
        evens[-1] = row[(columns - 1) // 2 * 2]
    return even, odd


@kernel(fast=True)
def _find_level(
    even: F4, odd: F4, intrinsics: PinholeIntrinsics, up: F8, i: int, x: F8, height: F4
) -> None:
    """Write the heights of the cells of a row on odd columns, infinity where it is not level."""
    bend, two = np.float32(BEND), np.float32(2)
    sides, middle, above, below = even[i], odd[i], odd[i - ARM], odd[i + ARM]
    close_above, close_below = odd[i - 1], odd[i + 1]
    y = (i - intrinsics.cy) / intrinsics.fy
    for k in range(x.size):
        m = k + ARM // 2
        center, left, right = middle[m], sides[k], sides[k + ARM]
        rise = x[k] * up[0] + y * up[1] + up[2]
        # A level surface near the height of the camera is narrow in the image.
        narrow = rise * rise < GRAZING_SIN2 * (x[k] * x[k] + y * y + 1)
        # All are read before some are chosen, or this would not vectorise.
        far, near, far_below, near_below = above[m], close_above[m], below[m], close_below[m]
        top, bottom = (near if narrow else far), (near_below if narrow else far_below)
        seen = (center > 0) & (left > 0) & (right > 0) & (top > 0) & (bottom > 0)
        smooth = abs(left + right - two * center) <= bend
        smooth &= abs(top + bottom - two * center) <= bend
        across, down = right - left, (bottom - top) * np.float32(ARM if narrow else 1)
        nx, ny = across * (intrinsics.fx / (2 * ARM)), down * (intrinsics.fy / (2 * ARM))
        nz = center - nx * x[k] - ny * y
        along = -(nx * up[0] + ny * up[1] + nz * up[2])
        upwards = along > 0
        upwards &= along * along > LEVEL_COS2 * (nx * nx + ny * ny + nz * nz)
        height[k] = rise / center if seen & smooth & upwards else np.inf


@kernel
def by_height(height: F4, base: float, bins: int) -> tuple[I4, I4]:
    """Return the order of heights by bins, and where each bin starts."""
    n = height.size
    bin_of = np.zeros(n, np.uint32)
    for k in range(n):
        bin_of[k] = min(int((height[k] - base) / BIN_M), bins - 1)
    starts = np.zeros(bins + 1, np.uint32)
    for k in range(n):
        starts[bin_of[k] + np.uint32(1)] += np.uint32(1)
    for b in range(bins):
        starts[b + 1] += starts[b]
    place = starts.copy()
    order = np.zeros(n, np.uint32)
    for k in range(n):
        order[place[bin_of[k]]] = k
        place[bin_of[k]] += np.uint32(1)
    return order, starts


@kernel
def fullest(starts: I4, done: Bool) -> int:
    """Return the bin that with its neighbours holds most readings; those done count as empty."""
    count = np.zeros(done.size + 2, np.int64)
    for k in range(done.size):
        count[k + 1] = 0 if done[k] else starts[k + 1] - starts[k]
    return int(np.argmax(count[:-2] + 2 * count[1:-1] + count[2:]))


@kernel
def _next_level(
    intrinsics: PinholeIntrinsics,
    up: F8,
    level: DepthSamples,
    height: F4,
    order: I4,
    starts: I4,
    done: Bool,
) -> tuple[DepthSamples, F8, int, int]:
    """Fit a plane to the fullest bins that are not done.

    Returns
    -------
    The readings in these bins; the plane (a, b, c); how many of them lie in it, 0 if it is not
    seen from above; and how many are close to it.
    """
    peak = fullest(starts, done)
    low, high = max(peak - 2, 0), min(peak + 3, done.size)
    chosen = order[starts[low] : starts[high]]
    near = select(level, chosen)
    if chosen.size < LEAST_CELLS:
        return near, np.zeros(3), 0, 0
    done[low:high] = True
    offset = median_of(height, chosen[:: 1 + chosen.size // MOST_HEIGHTS])
    if offset > -MARGIN_M:
        return near, np.zeros(3), 0, 0
    plane = horizontal_plane(intrinsics, up, offset)
    count = 0
    for _ in range(3):
        count = refine(near.j, near.i, near.inverse_depth, 1.5 * INLIER_TOLERANCE, plane)
        if count < LEAST_CELLS:
            break
        if cosine(plane_normal(plane, intrinsics), up) < STEADY_COS:
            plane = horizontal_plane(intrinsics, up, offset)
            break
    return (
        near,
        plane,
        count,
        count_inliers(near, plane[0], plane[1], plane[2], CLOSE * INLIER_TOLERANCE),
    )


@kernel
def _voted(
    intrinsics: PinholeIntrinsics, near: DepthSamples, up: F8, trials: F8, plane: F8, close: int
) -> F8:
    """Return the plane most readings are close to, or ``plane``, to which ``close`` are."""
    other, inliers = ransac_plane(
        near, trials, intrinsics, up, (STEADY_COS, 1.0), CLOSE * INLIER_TOLERANCE
    )
    return other if inliers > close else plane


@kernel
def _keep_off(plane: F8, level: DepthSamples, order: I4, starts: I4) -> None:
    """Take the readings near a plane from their order `by_height`, in place."""
    j, i, inv_depth = level.j, level.i, level.inverse_depth
    off = np.zeros(inv_depth.size, np.uint8)
    for k in range(inv_depth.size):
        off[k] = (
            abs(inv_depth[k] - (plane[0] * j[k] + plane[1] * i[k] + plane[2]))
            > 3 * INLIER_TOLERANCE
        )
    left = np.zeros(order.size + 1, np.uint32)  # of those before each
    n = np.uint32(0)
    for k in range(starts[-1]):
        order[n] = order[k]
        n += np.uint32(off[order[k]])
        left[k + 1] = n
    for b in range(starts.size):
        starts[b] = left[starts[b]]
