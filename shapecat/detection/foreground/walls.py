"""Walls: vertical planes that are too large for an object."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.detection.depth_grid import BORDER_SHARE, DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.ransac import (
    DepthSamples,
    off_plane,
    plane_normal,
    ransac_plane,
    sample_grid,
)
from shapecat.detection.planes.settings import PLANES
from shapecat.geometry import DISCONTINUITY, cross
from shapecat.jit import kernel, unset

__all__ = ["CLEARED", "ON_WALL", "remove_walls"]

ON_WALL, CLEARED = 1, 2
"""Cells on a wall; the former are of a small part, which may be an object the wall goes through."""
UNSEEN = 3
"""Cells on a wall whose part is not known yet."""

MOST_WALLS, MOST_BEYOND, LEAST_READINGS = 5, 1, 50
"""So many walls are looked for where objects may be, and beyond, as long as so many readings are
left; this bounds the time."""
VERTICAL_COS = 0.2
"""Largest cosine between up and the normal of a wall."""
LEAST_AREA_M2, LEAST_PART_M2, LEAST_WALL_M2 = 0.05, 0.04, 0.1
"""Least area of a wall, of a connected part of it that is cleared, and of these parts together."""
LEAST_PATCH_M2, EXACT = 0.008, 0.0045
"""Smaller parts are cleared that lie in the wall as exactly as its readings do: standard deviation
in inverse depth."""
CUT_OFF = 0.75
"""Diagonal of a wall that two sides of the image cut off, as a share of the width of the largest
object."""
FILLED = 0.3
"""Share of its extent that a wall fills: the front edges of a shelf lie in a plane too."""
STRIP_M, STRIPS = 0.05, 400
"""Width of the strips whose area is summed to find the extent of a wall, and their number."""


@kernel
def remove_walls(grid: DepthGrid, plane_id: I4, up: F8, largest_m: float, trials: F8) -> U1:
    """Take the cells on walls from the object cells of ``plane_id`` (rows, columns), in place.

    ``trials`` are of `draw_trials`.

    Returns
    -------
    (rows, columns) uint8 `CLEARED` or `ON_WALL` on walls, 0 elsewhere. A plane through the fronts
    of many objects looks like a wall too, but all its parts are small.
    """
    walls = np.zeros(plane_id.shape, np.uint8)
    _take(
        grid,
        plane_id,
        sample_grid(grid.inverse_depth, plane_id),
        MOST_WALLS,
        up,
        largest_m,
        trials,
        walls,
    )
    # Of a wall behind a table most may be out of the reach of objects, and a corner in it.
    beyond = sample_grid(grid.inverse_depth, (plane_id == 0) & (walls == 0))
    _take(grid, plane_id, beyond, MOST_BEYOND, up, largest_m, trials, walls)
    return walls


@kernel
def _take(
    grid: DepthGrid,
    plane_id: I4,
    samples: DepthSamples,
    most: int,
    up: F8,
    largest_m: float,
    trials: F8,
    walls: U1,
) -> None:
    """Take the vertical plane with most readings, if it is a wall, then that with most others."""
    intrinsics, vertical = grid.intrinsics, (-VERTICAL_COS, VERTICAL_COS)
    for _ in range(most):
        plane, count = ransac_plane(samples, trials, intrinsics, up, vertical, PLANES.tolerance)
        if count < LEAST_READINGS:
            return
        normal = plane_normal(plane, intrinsics)
        if _is_wall(grid, samples, plane, normal, up, largest_m):
            _clear(grid.inverse_depth, intrinsics, plane_id, plane, normal, walls)
        samples = off_plane(samples, plane, 2 * PLANES.tolerance)


@kernel
def _is_wall(
    grid: DepthGrid, samples: DepthSamples, plane: F8, normal: F8, up: F8, largest_m: float
) -> bool:
    """Whether the inliers of a plane are more than the face of an object."""
    across = cross(normal, up)
    strips = np.zeros((2, STRIPS))
    area = samples.share * _measure(samples, grid.intrinsics, plane, normal, across, up, strips)
    # A strip of 5 cm counts that holds 5 cm of wall.
    full = samples.share * strips > STRIP_M**2
    width, height = STRIP_M * np.sum(full[0]), STRIP_M * np.sum(full[1])
    if area <= LEAST_AREA_M2 or area <= FILLED * width * height:
        return False
    if math.hypot(width, height) > CUT_OFF * largest_m and _is_cut_off(
        grid.inverse_depth, samples, plane
    ):
        return True
    return bool(max(width, height) > largest_m)


@kernel
def _is_cut_off(inv_depth: F4, samples: DepthSamples, plane: F8) -> bool:
    """Whether the inliers of a plane reach two sides of the image, or of its readings near them."""
    off = samples.inverse_depth - (plane[0] * samples.j + plane[1] * samples.i + plane[2])
    near, everything = np.abs(off) < PLANES.tolerance, sample_grid(inv_depth, inv_depth)
    across = (samples.j[near], everything.j, inv_depth.shape[1])
    down = (samples.i[near], everything.i, inv_depth.shape[0])
    sides, margin = 0, 1.5 * math.sqrt(samples.share)
    for own, seen, lines in (across, down):
        sides += np.min(own) < min(np.min(seen) + margin, BORDER_SHARE * lines)
        sides += np.max(own) > max(np.max(seen) - margin, (1 - BORDER_SHARE) * lines)
    return sides >= 2


@kernel
def _measure(
    samples: DepthSamples,
    intrinsics: PinholeIntrinsics,
    plane: F8,
    normal: F8,
    across: F8,
    up: F8,
    strips: F8,
) -> float:
    """Return the area of the inliers of a plane; add it to the strips they lie in."""
    total = 0.0
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        if abs(v - (plane[0] * j + plane[1] * i + plane[2])) >= PLANES.tolerance:
            continue
        z = 1.0 / v
        x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
        facing = -(x * normal[0] + y * normal[1] + normal[2])
        area = z * z / (intrinsics.fx * intrinsics.fy) / max(facing, 0.1)
        total += area
        for d, axis in enumerate((across, up)):
            along = (axis[0] * x + axis[1] * y + axis[2]) * z
            strip = math.floor(along / STRIP_M) + STRIPS // 2
            strips[d, min(max(strip, 0), STRIPS - 1)] += area
    return total


@kernel
def _clear(
    inv_depth: F4, intrinsics: PinholeIntrinsics, plane_id: I4, plane: F8, normal: F8, walls: U1
) -> None:
    """Take the connected parts of a wall that are large; others may be objects before it."""
    rows, columns = inv_depth.shape
    stack = unset(inv_depth.size, np.int32)
    found = unset(inv_depth.shape, np.uint8)
    _mark(inv_depth, plane_id, plane, found)
    total = 0.0
    for si in range(rows):
        for sj in range(columns):
            if found[si, sj] != UNSEEN:
                continue
            stack[0] = si * columns + sj
            found[si, sj] = ON_WALL
            done, top, area, off = 0, 1, 0.0, 0.0
            while done < top:
                i, j = stack[done] // columns, stack[done] % columns
                done += 1
                x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
                facing = -(x * normal[0] + y * normal[1] + normal[2])
                area += 1 / (
                    inv_depth[i, j]
                    * inv_depth[i, j]
                    * intrinsics.fx
                    * intrinsics.fy
                    * max(facing, 0.1)
                )
                off += (inv_depth[i, j] - (plane[0] * j + plane[1] * i + plane[2])) ** 2
                for d in range(4):
                    v = i + (1 if d == 0 else -1 if d == 1 else 0)
                    u = j + (1 if d == 2 else -1 if d == 3 else 0)
                    if v < 0 or u < 0 or v >= rows or u >= columns or found[v, u] != UNSEEN:
                        continue
                    found[v, u] = ON_WALL
                    stack[top] = v * columns + u
                    top += 1
            if area >= LEAST_PART_M2 or (area >= LEAST_PATCH_M2 and off < top * EXACT**2):
                total += area
                for t in range(top):
                    found[stack[t] // columns, stack[t] % columns] = CLEARED
    if total < LEAST_WALL_M2:
        return
    np.maximum(walls, found, walls)
    for i in range(rows):
        plane_ids, states = plane_id[i], found[i]
        for j in range(columns):
            plane_ids[j] = 0 if states[j] == CLEARED else plane_ids[j]


@kernel
def _mark(inv_depth: F4, plane_id: I4, plane: F8, found: U1) -> None:
    """Mark as unseen the cells on a wall that are no part of a level plane, as 0 the others."""
    a = np.float32(plane[0])
    for i in range(inv_depth.shape[0]):
        values, plane_ids, states = inv_depth[i], plane_id[i], found[i]
        at_row = np.float32(plane[1] * i + plane[2])
        for j in range(inv_depth.shape[1]):
            off = abs(values[j] - (a * np.float32(j) + at_row))
            on = (plane_ids[j] >= 0) & (values[j] > 0) & (off < np.float32(DISCONTINUITY))
            states[j] = UNSEEN if on else 0
