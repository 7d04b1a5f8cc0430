"""Covered planes: a table that is seen in strips between the things on it.

The strips are too narrow for their tilt to be told, but by height their samples lie within
millimetres: where the up direction is known, from the tops of the things, height alone is left to
be found. A table is what has nothing below and much level surface just above it.
"""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import (
    COS,
    DIRECTIONS,
    SIN,
    SupportingPlane,
    measure_plane,
    outline_corners,
)
from shapecat.detection.planes.ransac import INLIER_TOLERANCE, DepthSamples, horizontal_plane
from shapecat.geometry import level_axes
from shapecat.jit import kernel

__all__ = ["add_covered_planes"]

ARM = 2
"""Cells to each side over which a strip is seen to be level."""
APART = 2
"""Columns between the cells that are looked at."""
LEAST_DEPTH_M, LEAST_RISE = 0.03, 0.05
"""What is less far below the camera is not searched; slope of a ray, down over forward, below which
the surface of a cell is no larger."""
BIN_M, BINS = 0.005, 600
BELOW = 10
"""Bins below a plane in which there is next to nothing."""
CONTRAST, DIP = 2.0, 0.6
"""A plane has so many times the surface of what is below; above it, the surface falls to this."""
LEAST_AREA_M2, LEAST_CELLS = 0.002, 60
"""What is seen of a covered plane at least."""
SAME_M = 0.012
"""Planes whose heights differ by less are one."""
TALLEST_M = 0.15
"""Height of the tallest things that cover a plane."""
MOST_SEEN = 0.45
"""Share of its outline that is seen of a covered plane at most: a lid is seen whole."""
LEAST_BORNE_M2 = 0.02
"""Level surface of the things on it."""

Found = list[tuple[SupportingPlane, DepthSamples]]


def add_covered_planes(grid: DepthGrid, found: Found) -> tuple[Found, F8]:
    """Add the planes that are seen in strips between flat things.

    Parameters
    ----------
    found : parallel planes with their samples, lowest first, at least one.

    Returns
    -------
    The planes, lowest first; one that was known may reach farther. And, for each, the area (n,)
    that lies under things, m²; 0 for planes that are not covered.
    """
    up = max(found, key=lambda each: each[0].area_m2)[0].up
    area = np.zeros(BINS)
    strips = _level_strips(grid.inverse_depth, grid.intrinsics, up, area)
    planes = {support.offset: (support, samples, 0.0) for support, samples in found}
    for height in _lowest_levels(area):
        if not any(SAME_M < plane.offset - height < TALLEST_M for plane, _ in found):
            continue
        support, samples, covered_m2 = _covered_plane(grid, strips, up, height)
        if covered_m2 > 0:
            known = [plane for plane, _ in found if abs(plane.offset - support.offset) < SAME_M]
            if known:
                support, samples = _widened(known[0], support), planes[known[0].offset][1]
            planes[support.offset] = (support, samples, covered_m2)
    order = sorted(planes)
    return [planes[k][:2] for k in order], np.array([planes[k][2] for k in order])


def _covered_plane(
    grid: DepthGrid, strips: F4, up: F8, height: float
) -> tuple[SupportingPlane, DepthSamples, float]:
    """Measure the plane of the strips at a height, and what of it is covered; 0 if it is none."""
    near = np.ascontiguousarray(strips[:, abs(strips[3] - height) < 1.5 * BIN_M])
    samples = DepthSamples(near[0], near[1], near[2], APART)
    offset = float(np.median(near[3])) if near.size else height
    support = measure_plane(grid, samples, horizontal_plane(grid.intrinsics, up, offset))
    outline_m2 = _outline_area(support)
    covers = near.shape[1] >= LEAST_CELLS and support.area_m2 < MOST_SEEN * outline_m2
    if not covers:
        return support, samples, 0.0
    axes = np.array(level_axes(*up))
    heights = np.array([offset + SAME_M, offset + TALLEST_M])
    borne_m2 = _area_above(strips, grid.intrinsics, axes, support.extent, heights)
    covered = borne_m2 >= max(LEAST_BORNE_M2, support.area_m2)
    return support, samples, borne_m2 + outline_m2 if covered else 0.0


def _widened(plane: SupportingPlane, strips: SupportingPlane) -> SupportingPlane:
    return plane._replace(extent=np.maximum(plane.extent, strips.extent))


def _outline_area(plane: SupportingPlane) -> float:
    corners = outline_corners(plane)
    return abs(float(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0) @ plane.up)) / 2


def _lowest_levels(area: F8) -> list[float]:
    """Return the heights, ascending, of level surface with next to nothing below.

    Parameters
    ----------
    area : (BINS,) level surface by height, the lowest first, m².
    """
    here, above = area[BELOW:-3], np.stack([area[BELOW + k : BINS - 3 + k] for k in (1, 2, 3)])
    own = here + area[BELOW - 1 : -4] + above[0]
    total = np.cumsum(np.append(0, area))
    below = 3 / (BELOW - 2) * (total[BELOW - 2 : BINS - 5] - total[: BINS - 3 - BELOW])
    peak = (here >= area[BELOW - 1 : -4]) & (here >= above[0]) & (above.min(axis=0) < DIP * here)
    found = BELOW + np.flatnonzero(peak & (own > LEAST_AREA_M2) & (own > CONTRAST * below))
    return [(float(k) + 0.5 - BINS) * BIN_M for k in found]


@kernel
def _level_strips(inv_depth: F4, intrinsics: PinholeIntrinsics, up: F8, area: F8) -> F4:
    """Return the columns, rows, inverse depths and heights (4, n) of cells on level surface.

    Compared with cells ``ARM`` beside, most of these are nearer to level than to upright. Their
    surface is added to ``area``, by height, m².
    """
    rows, columns = inv_depth.shape
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    across, down = np.float32(up[0] / fx), np.float32(up[1] / fy)
    slope = np.float32(0.5 * ARM) * np.sqrt(across * across + down * down)
    side, along = np.float32(ARM) * across, np.float32(ARM) * down
    least, deepest = np.float32(-LEAST_DEPTH_M), np.float32((1 - BINS) * BIN_M)
    gate = np.float32(-INLIER_TOLERANCE / 2)
    level = np.zeros(columns, np.uint8)
    found = np.zeros((4, inv_depth.size // APART + rows), np.float32)
    n = 0
    for i in range(ARM, rows - ARM):
        here, above, below = inv_depth[i], inv_depth[i - ARM], inv_depth[i + ARM]
        start = np.float32(up[2] + (i - cy) * up[1] / fy - cx * up[0] / fx)
        some = np.uint8(0)
        for j in range(ARM, columns - ARM):
            # On a level surface w / rise is the same everywhere. This vectorises.
            w, rise = here[j], start + across * np.float32(j)
            a, b, c, d = above[j], below[j], here[j - ARM], here[j + ARM]
            straight, flat = slope * w, gate * rise
            limit = straight if straight > flat else flat
            product = w * rise
            near = np.uint8(abs(a * rise - (product - w * along)) < limit)
            near += np.uint8(abs(b * rise - (product + w * along)) < limit)
            near += np.uint8(abs(c * rise - (product - w * side)) < limit)
            near += np.uint8(abs(d * rise - (product + w * side)) < limit)
            level[j] = (near >= 3) & (w > 0) & (rise < least) & (rise > deepest * w)
            some |= level[j]
        if not some:
            continue
        for j in range(ARM, columns - ARM, APART):
            if level[j]:
                w, rise = here[j], start + across * np.float32(j)
                found[0, n], found[1, n], found[2, n], found[3, n] = j, i, w, rise / w
                area[BINS - 1 - int(-rise / w / BIN_M)] += _cell_area(intrinsics, w, rise)
                n += 1
    return found[:, :n].copy()


@kernel
def _cell_area(intrinsics: PinholeIntrinsics, inv_depth: float, rise: float) -> float:
    """Return the level surface that a cell, and those left out beside it, shows, m²."""
    steep = max(-rise, LEAST_RISE) * inv_depth * inv_depth
    return APART / (intrinsics.fx * intrinsics.fy * steep)


@kernel
def _area_above(
    strips: F4, intrinsics: PinholeIntrinsics, axes: F8, extent: F8, heights: F8
) -> float:
    """Return how much level surface between two heights lies over an outline, m²."""
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    total = 0.0
    for k in range(strips.shape[1]):
        height = float(strips[3, k])
        if height <= heights[0] or height >= heights[1]:
            continue
        z = 1 / float(strips[2, k])
        x, y = (strips[0, k] - cx) / fx * z, (strips[1, k] - cy) / fy * z
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        over = True
        for d in range(DIRECTIONS):
            over &= COS[d] * u + SIN[d] * v < extent[d]
        if over:
            total += _cell_area(intrinsics, 1 / z, height / z)
    return total
