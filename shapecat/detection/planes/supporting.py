"""Supporting planes: tables and boards, told from the tops of objects."""

import math

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import COS, DIRECTIONS, SIN, SupportingPlane, outline_corners
from shapecat.detection.planes.ransac import INLIER_TOLERANCE, DepthSamples
from shapecat.geometry import NEAREST_M, level_axes
from shapecat.jit import kernel

__all__ = ["SURE_AREA_M2", "supporting_planes"]

SURE_AREA_M2 = 0.25
"""Planes larger than this are furniture, whatever is under their edge."""
LIKELY_AREA_M2 = 0.1
"""Planes larger than this are furniture if nothing is seen of what is under their edge."""
BOARD_AREA_M2 = 0.03
"""Smaller planes are no furniture but for the lowest one, a floor that the table leaves to see."""
LEAST_DROP_M = 0.06
"""Lower things are objects."""
STEP_M, EDGE_STEPS = 0.01, 5
"""Length of a step, and how many of them from a cell towards the camera its plane may end after."""
FIRST, LAST, WALL_M = 4, 20, 0.03
"""Steps down from the edge between which it is looked for a wall; how far readings lie off one."""
LEAST_DROPS, CLOSED = 20, 0.5
"""Readings below the edge that say enough, and the share of them on a wall that closes a box."""


def supporting_planes(
    grid: DepthGrid,
    found: list[tuple[SupportingPlane, DepthSamples]],
    covered_m2: F8,
    tallest_m: float,
) -> list[SupportingPlane]:
    """Leave out the tops of objects.

    Under the front edge of a table or shelf there is nothing; a box is closed down to what it
    stands on. Things lower than 6 cm are never furniture; planes over a quarter of a square metre
    always are, and what is higher than an object.

    Parameters
    ----------
    found : planes, lowest first, with their readings.
    covered_m2 : (n,) what of each lies under things, and counts as seen.
    tallest_m : height of the tallest object.
    """
    kept: list[SupportingPlane] = []
    for (support, samples), covered in zip(found, covered_m2, strict=True):
        area_m2 = support.area_m2 + covered
        drop = math.inf
        for lower in kept:
            drop = support.offset - lower.offset if _overlaps(lower, support) else drop
        if drop < LEAST_DROP_M or (len(kept) > 0 and area_m2 < BOARD_AREA_M2):
            continue
        if drop <= tallest_m and area_m2 < SURE_AREA_M2:
            plane = np.array([support.a, support.b, support.c])
            on_wall, beyond = _drop(
                grid.inverse_depth, grid.intrinsics, samples, plane, support.up, drop
            )
            if on_wall + beyond >= LEAST_DROPS:
                if on_wall > CLOSED * (on_wall + beyond):
                    continue
            elif area_m2 < LIKELY_AREA_M2:
                continue
        kept.append(support)
    return kept


@kernel
def _overlaps(lower: SupportingPlane, upper: SupportingPlane) -> bool:
    """Whether the middle of ``upper`` lies over the outline of ``lower``."""
    middle = np.sum(outline_corners(upper), axis=0) / DIRECTIONS
    axes = level_axes(lower.up[0], lower.up[1], lower.up[2])
    x = axes[0][0] * middle[0] + axes[0][1] * middle[1] + axes[0][2] * middle[2]
    y = axes[1][0] * middle[0] + axes[1][1] * middle[1] + axes[1][2] * middle[2]
    return bool(np.all(COS * x + SIN * y < lower.extent))


@kernel
def _drop(
    inv_depth: F4,
    intrinsics: PinholeIntrinsics,
    samples: DepthSamples,
    plane: F8,
    up: F8,
    drop: float,
) -> tuple[int, int]:
    """Look below the edge of a plane: count readings on a wall down from it, and beyond it."""
    rows, columns = inv_depth.shape
    on_wall = farther = 0
    for k in range(0, samples.inverse_depth.size, 3):
        i, j = samples.i[k], samples.j[k]
        level = plane[0] * j + plane[1] * i + plane[2]
        if level <= 0 or abs(samples.inverse_depth[k] - level) >= INLIER_TOLERANCE:
            continue
        z = 1 / level
        x, y = (j - intrinsics.cx) / intrinsics.fx * z, (i - intrinsics.cy) / intrinsics.fy * z
        # Towards the camera, along the plane.
        h = x * up[0] + y * up[1] + z * up[2]
        tx, ty, tz = h * up[0] - x, h * up[1] - y, h * up[2] - z
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        if length < 0.1 or z < 0.2:
            continue
        tx, ty, tz = STEP_M * tx / length, STEP_M * ty / length, STEP_M * tz / length
        edge = False
        for _ in range(EDGE_STEPS):
            v = int(intrinsics.cy + intrinsics.fy * (y + ty) / (z + tz) + 0.5)
            u = int(intrinsics.cx + intrinsics.fx * (x + tx) / (z + tz) + 0.5)
            if v < 0 or u < 0 or v >= rows or u >= columns or inv_depth[v, u] <= 0:
                break
            ahead = inv_depth[v, u] - 1 / (z + tz)
            edge = ahead < -2 * INLIER_TOLERANCE
            if edge or ahead > 2 * INLIER_TOLERANCE:  # the end of the plane, or something on it
                break
            x, y, z = x + tx, y + ty, z + tz
        if not edge:
            continue
        for step in range(FIRST, LAST):
            s = STEP_M * step
            if s > drop - STEP_M:
                break
            dx, dy, dz = x - s * up[0], y - s * up[1], z - s * up[2]
            if dz <= NEAREST_M:
                break
            v, u = (
                int(intrinsics.cy + intrinsics.fy * dy / dz + 0.5),
                int(intrinsics.cx + intrinsics.fx * dx / dz + 0.5),
            )
            if v < 0 or u < 0 or v >= rows or u >= columns:
                break
            if inv_depth[v, u] > 0:
                behind = 1 / inv_depth[v, u] - dz
                on_wall += abs(behind) < WALL_M
                farther += behind >= WALL_M
    return on_wall, farther
