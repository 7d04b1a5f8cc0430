"""Boards: planes that are furniture, told from the tops of objects."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.depth_grid import Cells, Lens
from shapecat.detection.planes.extent import COS, DIRECTIONS, SIN, Support, corners_of
from shapecat.detection.planes.ransac import TOLERANCE, Readings
from shapecat.geometry import NEAREST_M, level_axes
from shapecat.jit import kernel

__all__ = ["boards_of"]

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


@kernel
def boards_of(cells: Cells, found: list[tuple[Support, Readings]]) -> list[Support]:
    """Leave out the tops of objects; ``found`` are planes, lowest first, with their readings.

    Under the front edge of a table or shelf there is nothing; a box is closed down to what it
    stands on. Things lower than 6 cm are never furniture, planes over a quarter of a square metre
    always.
    """
    kept: list[Support] = []
    for support, readings in found:
        drop = math.inf
        for lower in kept:
            drop = support.offset - lower.offset if _overlaps(lower, support) else drop
        if drop < LEAST_DROP_M or (len(kept) > 0 and support.area_m2 < BOARD_AREA_M2):
            continue
        if drop < math.inf and support.area_m2 < SURE_AREA_M2:
            seen = np.zeros(2, np.int64)
            plane = np.array([support.a, support.b, support.c])
            _drop(cells.w, cells.lens, readings, plane, support.up, drop, seen)
            if seen[0] + seen[1] >= LEAST_DROPS:
                if seen[0] > CLOSED * (seen[0] + seen[1]):
                    continue
            elif support.area_m2 < LIKELY_AREA_M2:
                continue
        kept.append(support)
    return kept


@kernel
def _overlaps(lower: Support, upper: Support) -> bool:
    """Whether the middle of ``upper`` lies over the outline of ``lower``."""
    middle = np.sum(corners_of(upper), axis=0) / DIRECTIONS
    axes = level_axes(lower.up[0], lower.up[1], lower.up[2])
    x = axes[0][0] * middle[0] + axes[0][1] * middle[1] + axes[0][2] * middle[2]
    y = axes[1][0] * middle[0] + axes[1][1] * middle[1] + axes[1][2] * middle[2]
    return bool(np.all(COS * x + SIN * y < lower.reach))


@kernel(leaf=True)
def _drop(w: F4, lens: Lens, readings: Readings, plane: F8, up: F8, drop: float, seen: I4) -> None:
    """Look below the edge of a plane: count readings on a wall down from it, and beyond it."""
    rows, columns = w.shape
    for k in range(0, readings.w.size, 3):
        i, j = readings.i[k], readings.j[k]
        level = plane[0] * j + plane[1] * i + plane[2]
        if level <= 0 or abs(readings.w[k] - level) >= TOLERANCE:
            continue
        z = 1 / level
        x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
        # Towards the camera, along the plane.
        h = x * up[0] + y * up[1] + z * up[2]
        tx, ty, tz = h * up[0] - x, h * up[1] - y, h * up[2] - z
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        if length < 0.1 or z < 0.2:
            continue
        tx, ty, tz = STEP_M * tx / length, STEP_M * ty / length, STEP_M * tz / length
        edge = False
        for _ in range(EDGE_STEPS):
            v = int(lens.cy + lens.fy * (y + ty) / (z + tz) + 0.5)
            u = int(lens.cx + lens.fx * (x + tx) / (z + tz) + 0.5)
            if v < 0 or u < 0 or v >= rows or u >= columns or w[v, u] <= 0:
                break
            ahead = w[v, u] - 1 / (z + tz)
            edge = ahead < -2 * TOLERANCE
            if edge or ahead > 2 * TOLERANCE:  # the end of the plane, or something on it
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
            v, u = int(lens.cy + lens.fy * dy / dz + 0.5), int(lens.cx + lens.fx * dx / dz + 0.5)
            if v < 0 or u < 0 or v >= rows or u >= columns:
                break
            if w[v, u] > 0:
                behind = 1 / w[v, u] - dz
                seen[0] += abs(behind) < WALL_M
                seen[1] += behind >= WALL_M
