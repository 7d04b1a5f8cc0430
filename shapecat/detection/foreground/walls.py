"""Walls: vertical planes that are too large for an object."""

import math

import numpy as np

from shapecat.arrays import F8, I4, U1
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.foreground.settings import WALLS
from shapecat.detection.planes.plane_fit import DepthSamples, plane_normal
from shapecat.detection.planes.ransac import ransac_plane, sample_grid, select_outliers
from shapecat.detection.planes.settings import PLANES
from shapecat.geometry import cross
from shapecat.jit import kernel, unset

__all__ = ["CLEARED", "ON_WALL", "remove_walls"]

ON_WALL, CLEARED = 1, 2
"""Marks of cells on a wall: `ON_WALL` in a small or free-standing part, which may be an object in
the plane of the wall; `CLEARED` in any other part, which is removed from the objects."""
UNMEASURED = 3
"""Mark of cells on a wall, in a connected part that is not measured yet."""

STRIPS = 400
"""Number of strips of `WallSettings.strip_m`, half on each side of the sensor."""


@kernel
def remove_walls(grid: DepthGrid, plane_id: I4, up: F8, max_size_m: float, trials: F8) -> U1:
    """Remove the cells on walls from the objects, in place.

    Vertical planes are tested one after the other, always the plane with the most remaining
    samples.

    Parameters
    ----------
    plane_id : (rows, columns) as in `HeightMap`; cleared cells become 0.
    up : (3,) unit vector, sensor frame.
    max_size_m : size of the largest object, metres.
    trials : (n, 3) random numbers from `draw_trials`.

    Returns
    -------
    (rows, columns) uint8: `CLEARED` where cells were removed, `ON_WALL` in the other parts of such
    a wall, 0 elsewhere. A plane with less than `WALLS.cleared_m2` to clear, such as one through the
    fronts of many objects, gets no marks.
    """
    walls = np.zeros(plane_id.shape, np.uint8)
    samples = sample_grid(grid.inverse_depth, plane_id)
    bounds = (-WALLS.vertical_cos, WALLS.vertical_cos)
    for _ in range(WALLS.max_planes):
        plane, count = ransac_plane(samples, trials, grid.intrinsics, up, bounds, PLANES.tolerance)
        if count < WALLS.min_samples:
            break
        normal = plane_normal(plane, grid.intrinsics)
        if _is_wall(grid.intrinsics, samples, plane, normal, up, max_size_m):
            axes = np.stack((normal, cross(normal, up), up))
            _clear(grid, plane_id, plane, axes, max_size_m, walls)
        samples = select_outliers(samples, plane, 2 * PLANES.tolerance)
    return walls


@kernel(inline=True)
def _is_wall(
    intrinsics: PinholeIntrinsics,
    samples: DepthSamples,
    plane: F8,
    normal: F8,
    up: F8,
    max_size_m: float,
) -> bool:
    """Return whether the inliers of a plane fill an area that is too large for an object.

    ``plane`` (3,) is a, b, c of its inverse depth; ``normal`` and ``up`` (3,) are unit vectors,
    sensor frame; ``max_size_m`` is the size of the largest object.
    """
    strips = np.zeros((2, STRIPS))
    area = _measure(intrinsics, samples, plane, normal, up, strips)
    across = along = 0.0
    for k in range(STRIPS):  # a strip counts if the wall in it is longer than the strip is wide
        across += WALLS.strip_m * (strips[0, k] > WALLS.strip_m**2)
        along += WALLS.strip_m * (strips[1, k] > WALLS.strip_m**2)
    if area <= WALLS.min_area_m2 or area <= WALLS.filled * across * along:
        return False
    return bool(max(across, along) > max_size_m)


@kernel(inline=True)
def _measure(
    intrinsics: PinholeIntrinsics, samples: DepthSamples, plane: F8, normal: F8, up: F8, strips: F8
) -> float:
    """Return the area of the inliers of a plane, m²; add each inlier's area to its strips.

    ``strips`` (2, STRIPS) are the areas in vertical and in level strips; the other parameters are
    as in `_is_wall`.
    """
    total, side = 0.0, cross(normal, up)
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        if abs(v - (plane[0] * j + plane[1] * i + plane[2])) >= PLANES.tolerance:
            continue
        x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
        facing = max(-(x * normal[0] + y * normal[1] + normal[2]), 0.1)
        area = samples.cells_per_sample / (v * v * intrinsics.fx * intrinsics.fy * facing)
        total += area
        for d in range(2):
            axis = up if d else side
            along = (axis[0] * x + axis[1] * y + axis[2]) / v
            strip = math.floor(along / WALLS.strip_m) + STRIPS // 2
            strips[d, min(max(strip, 0), STRIPS - 1)] += area
    return total


@kernel(inline=True)
def _clear(
    grid: DepthGrid, plane_id: I4, plane: F8, axes: F8, max_size_m: float, walls: U1
) -> None:
    """Clear the large connected parts of a wall; other parts may be objects in its plane.

    ``axes`` (3, 3) are the normal of the wall, the horizontal direction along it, and up. ``plane``
    (3,) is a, b, c of the wall's inverse depth. ``walls`` and, in cleared cells, ``plane_id`` are
    changed in place, as `remove_walls` says.
    """
    inv_depth = grid.inverse_depth
    rows, columns = inv_depth.shape
    cells, state = unset(inv_depth.size, np.int32), unset(inv_depth.shape, np.uint8)
    _mark(grid, plane_id, plane, state)
    total = 0.0
    for i in range(rows):
        for j in range(columns):
            if state[i, j] == UNMEASURED:
                count, area = _flood(grid, axes[0], i, j, state, cells)
                large = area >= WALLS.part_m2
                if large and not _is_free_standing(grid, axes, max_size_m, state, cells[:count]):
                    total += area
                    for p in cells[:count]:
                        state[p // columns, p % columns] = CLEARED
    for i in range(rows if total >= WALLS.cleared_m2 else 0):
        states, marks, plane_ids = state[i], walls[i], plane_id[i]
        for j in range(columns):
            marks[j] = max(marks[j], states[j])
            plane_ids[j] = 0 if states[j] == CLEARED else plane_ids[j]


@kernel(inline=True)
def _is_free_standing(grid: DepthGrid, axes: F8, max_size_m: float, state: U1, cells: I4) -> bool:
    """Return whether a connected part of a wall is the front of one of several objects in a row.

    Such a front is no larger than ``max_size_m``, metres, and ends to the left and right in front
    of a farther surface. A wall ends behind a nearer surface or in a corner. ``axes`` are as in
    `_clear`, ``state`` (rows, columns) holds the marks of cells, ``cells`` (n,) are the flat
    indices of the part's cells.
    """
    inv_depth, k = grid.inverse_depth, grid.intrinsics
    (rows, columns), (_, side, up) = inv_depth.shape, axes
    farther = nearer = ends = 0
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for p in cells:
        i, j = p // columns, p % columns
        w = inv_depth[i, j]
        x, y = (j - k.cx) / k.fx, (i - k.cy) / k.fy
        for d in range(2):
            along = (axes[1 + d, 0] * x + axes[1 + d, 1] * y + axes[1 + d, 2]) / w
            low[d], high[d] = min(low[d], along), max(high[d], along)
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            v, u = i + di, j + dj
            if v < 0 or u < 0 or v >= rows or u >= columns or state[v, u] != 0:
                continue
            if abs(di * side[1] + dj * side[0]) < abs(di * up[1] + dj * up[0]):
                continue  # above or below
            ends += 1
            farther += 0 < inv_depth[v, u] < w - grid.discontinuity
            nearer += inv_depth[v, u] > w + grid.discontinuity
    fits = max(high[0] - low[0], high[1] - low[1]) <= max_size_m
    return bool(fits and farther > nearer and farther > WALLS.free_share * ends)


@kernel(inline=True)
def _flood(grid: DepthGrid, normal: F8, i: int, j: int, state: U1, cells: I4) -> tuple[int, float]:
    """Mark the connected part of a wall at cell (i, j) as `ON_WALL`; list its cells in ``cells``.

    Returns the number of cells and their area, m². ``normal`` (3,) is that of the wall, sensor
    frame; ``state`` (rows, columns) holds the marks, `UNMEASURED` in cells to visit.
    """
    inv_depth, k = grid.inverse_depth, grid.intrinsics
    rows, columns = inv_depth.shape
    cells[0], state[i, j] = i * columns + j, ON_WALL
    head, tail, area = 0, 1, 0.0
    while head < tail:
        i, j = cells[head] // columns, cells[head] % columns
        head += 1
        x, y, w = (j - k.cx) / k.fx, (i - k.cy) / k.fy, inv_depth[i, j]
        facing = max(-(x * normal[0] + y * normal[1] + normal[2]), 0.1)
        area += 1 / (w * w * k.fx * k.fy * facing)
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):  # a different order rounds differently
            v, u = i + di, j + dj
            if v < 0 or u < 0 or v >= rows or u >= columns or state[v, u] != UNMEASURED:
                continue
            cells[tail], state[v, u] = v * columns + u, ON_WALL
            tail += 1
    return tail, area


@kernel(inline=True)
def _mark(grid: DepthGrid, plane_id: I4, plane: F8, state: U1) -> None:
    """Mark cells on a wall as `UNMEASURED`, unless they are on a level plane; write 0 elsewhere.

    ``plane`` (3,) is a, b, c of the wall's inverse depth; marks go to ``state`` (rows, columns).
    """
    a, inv_depth = np.float32(plane[0]), grid.inverse_depth
    jump = np.float32(grid.discontinuity)
    for i in range(inv_depth.shape[0]):
        values, plane_ids, states = inv_depth[i], plane_id[i], state[i]
        at_row = np.float32(plane[1] * i + plane[2])
        for j in range(inv_depth.shape[1]):
            distance = abs(values[j] - (a * np.float32(j) + at_row))
            on_wall = (plane_ids[j] >= 0) & (values[j] > 0) & (distance < jump)
            states[j] = UNMEASURED if on_wall else 0
