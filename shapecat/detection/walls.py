"""Walls: vertical planes that are too large for an object."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import JUMP, Cells, Lens
from shapecat.detection.consensus import (
    TOLERANCE,
    Readings,
    best_plane,
    normal_of,
    readings_of,
    without,
)
from shapecat.jit import kernel

__all__ = ["clear_walls"]

MOST_WALLS = 5
LEAST_READINGS = 50
VERTICAL_COS = 0.2
LEAST_AREA_M2 = 0.05
FILLED = 0.3
"""Share of its extent that a wall fills: the front edges of a shelf lie in a plane too."""
STRIP_M, STRIPS = 0.05, 400


def clear_walls(
    cells: Cells, owner: I4, up: F8, *, largest_m: float, rng: np.random.Generator
) -> None:
    """Take the cells on walls from the object cells of ``owner`` (rows, columns), in place."""
    readings = readings_of(cells, np.where(owner > 0, cells.w, np.float32(0)))
    for _ in range(MOST_WALLS):
        vertical = (-VERTICAL_COS, VERTICAL_COS)
        plane, count = best_plane(readings, cells.lens, up, vertical, rng)
        if count < LEAST_READINGS:
            break
        if _is_wall(readings, cells, plane, up, largest_m):
            _clear(cells.w, owner, plane)
        readings = without(readings, plane, 2 * TOLERANCE)


def _is_wall(readings: Readings, cells: Cells, plane: F8, up: F8, largest_m: float) -> bool:
    normal = normal_of(plane, cells.lens)
    across = np.cross(normal, up)
    strips = np.zeros((2, STRIPS))
    area = readings.share * _measure(readings, cells.lens, plane, normal, across, up, strips)
    # A strip of 5 cm counts that holds 5 cm of wall.
    reach = STRIP_M * np.count_nonzero(readings.share * strips > STRIP_M**2, axis=1)
    dense = area > FILLED * reach[0] * reach[1]
    return bool(area > LEAST_AREA_M2 and dense and reach.max() > largest_m)


@kernel
def _measure(
    readings: Readings, lens: Lens, plane: F8, normal: F8, across: F8, up: F8, strips: F8
) -> float:
    """Return the area of the inliers of a plane; add it to the strips they lie in."""
    total = 0.0
    for k in range(readings.w.size):
        j, i, v = readings.j[k], readings.i[k], readings.w[k]
        if abs(v - (plane[0] * j + plane[1] * i + plane[2])) >= TOLERANCE:
            continue
        z = 1.0 / v
        x, y = (j - lens.cx) / lens.fx, (i - lens.cy) / lens.fy
        facing = -(x * normal[0] + y * normal[1] + normal[2])
        area = z * z / (lens.fx * lens.fy) / max(facing, 0.1)
        total += area
        for d, axis in enumerate((across, up)):
            along = (axis[0] * x + axis[1] * y + axis[2]) * z
            strip = math.floor(along / STRIP_M) + STRIPS // 2
            strips[d, min(max(strip, 0), STRIPS - 1)] += area
    return total


@kernel
def _clear(w: F4, owner: I4, plane: F8) -> None:
    for i in range(w.shape[0]):
        for j in range(w.shape[1]):
            level = plane[0] * j + plane[1] * i + plane[2]
            if owner[i, j] > 0 and abs(w[i, j] - level) < JUMP:
                owner[i, j] = 0
