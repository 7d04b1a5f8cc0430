"""Overhang: the parts of objects that extend beyond the outline of their plane.

The outline encloses only visible samples: it ends before a hidden far edge of the table, and at the
front edge, which objects may overhang.
"""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import I4, U1, Records, Row
from shapecat.detection.connected_components import SIDES
from shapecat.detection.depth_grid import DepthGrid, back_project, row_and_column
from shapecat.detection.foreground.settings import OVERHANG
from shapecat.detection.foreground.walls import CLEARED
from shapecat.detection.planes.height_map import (
    HeightMap,
    distance_outside,
    height_above,
    min_height_at,
)
from shapecat.jit import kernel, unset

__all__ = ["extend_overhang"]


class Overhang(NamedTuple):
    """The data for the search around the outline of a plane.

    Attributes
    ----------
    grid, heights, walls : as in `extend_overhang`.
    number : number of the plane, from 1, as in `HeightMap.plane_id`.
    plane : the `PLANE` itself.
    max_height_m : maximum height of an object above the plane, metres.
    visited : (rows, columns) int8, ``number`` in the cells already visited for this plane.
    """

    grid: DepthGrid
    heights: HeightMap
    walls: U1
    number: int
    plane: Row
    max_height_m: float
    visited: I4


@kernel
def extend_overhang(
    grid: DepthGrid, heights: HeightMap, planes: Records, walls: U1, max_height_m: float
) -> None:
    """Assign to each plane, in place, the parts of its objects that lie outside its outline.

    An object that is many times larger outside than inside is not extended: a wall behind a table
    does not stand on it.

    Parameters
    ----------
    heights : changed in place.
    planes : (planes,) records of `PLANE`, from `pack_planes`.
    walls : (rows, columns) from `remove_walls`; `CLEARED` cells are not assigned.
    max_height_m : maximum height of an object above its plane, metres.
    """
    shape = grid.inverse_depth.shape
    visited, cells = np.zeros(shape, np.int8), unset(grid.inverse_depth.size, np.int32)
    border = np.zeros(shape[1], np.uint8)
    for number in range(len(planes), 0, -1):
        over = Overhang(grid, heights, walls, number, planes[number - 1], max_height_m, visited)
        for i in range(shape[0]):
            if not _find_border(heights.plane_id, number, i, border):
                continue
            for j in range(shape[1]):
                if border[j] and visited[i, j] != number and _continues(over, i, j):
                    _extend(over, i, j, cells)


@kernel(inline=True)
def _find_border(plane_id: I4, number: int, i: int, border: U1) -> bool:
    """Mark the cells of row i that are above a plane and at the border of that region.

    At least one neighbour is above a lower plane, or belongs to no plane. Returns whether there are
    any such cells. ``plane_id`` and ``number``, from 1, are as in `HeightMap`; ``border``
    (columns,) is written.
    """
    rows, columns = plane_id.shape
    row_above, row_below, one = max(i - 1, 0), min(i + 1, rows - 1), np.uint64(1)
    plane = np.uint8(number)  # the negative ids of surfaces become large unsigned numbers
    for j in range(np.uint64(columns)):
        lower = (np.uint8(plane_id[row_above, j]) < plane) | (
            np.uint8(plane_id[row_below, j]) < plane
        )
        border[j] = lower & (np.uint8(plane_id[i, j]) == plane)
    for j in range(np.uint64(columns - 1)):
        lower = np.uint8(plane_id[i, j + one]) < plane
        border[j] |= (np.uint8(plane_id[i, j]) == plane) & lower
    for j in range(one, np.uint64(columns)):
        lower = np.uint8(plane_id[i, j - one]) < plane
        border[j] |= (np.uint8(plane_id[i, j]) == plane) & lower
    any_lower = np.uint8(0)
    for j in range(np.uint64(columns)):
        any_lower |= border[j]
    return bool(any_lower > 0)


@kernel(inline=True)
def _continues(over: Overhang, i: int, j: int) -> bool:
    """Return whether the surface at cell (i, j) continues outside the outline of the plane."""
    rows, columns = over.visited.shape
    continues, w = False, over.grid.inverse_depth[i, j]
    for di, dj in SIDES:
        y, x = i + di, j + dj
        if not (
            0 <= y < rows and 0 <= x < columns and 0 <= over.heights.plane_id[y, x] < over.number
        ):
            continue
        if abs(over.grid.inverse_depth[y, x] - w) < over.grid.discontinuity:
            continues |= _height_beside(over, y, x) > 0
    return continues


@kernel(inline=True)
def _extend(over: Overhang, i: int, j: int, cells: I4) -> None:
    """Assign the outside part of the object at cell (i, j) to the plane, unless it is too large.

    ``cells`` (rows * columns,) is work space.
    """
    inv_depth, plane_id, number = over.grid.inverse_depth, over.heights.plane_id, over.number
    rows, columns = inv_depth.shape
    cells[0], over.visited[i, j] = i * columns + j, number
    head, tail, outside = 0, 1, 0
    while head < tail:
        i, j = row_and_column(cells[head], columns)
        head += 1
        for di, dj in SIDES:
            y, x = i + di, j + dj
            if y < 0 or x < 0 or y >= rows or x >= columns or over.visited[y, x] == number:
                continue
            inside = plane_id[y, x] == number
            if abs(inv_depth[y, x] - inv_depth[i, j]) >= over.grid.discontinuity:
                continue
            if inside or (0 <= plane_id[y, x] < number and _height_beside(over, y, x) > 0):
                over.visited[y, x] = number
                outside += not inside
                cells[tail] = y * columns + x
                tail += 1
    if outside <= OVERHANG.outside_ratio * (tail - outside):
        for p in cells[: tail if outside else 0]:
            y, x = row_and_column(p, columns)
            if plane_id[y, x] != number:
                over.heights.height[y, x], plane_id[y, x] = _height_beside(over, y, x), number


@kernel(inner=True)
def _height_beside(over: Overhang, i: int, j: int) -> float:
    """Return the height of a cell above the plane, metres; 0 if no object can extend there."""
    inv_depth, k, plane = over.grid.inverse_depth[i, j], over.grid.intrinsics, over.plane
    if inv_depth <= 0 or over.walls[i, j] == CLEARED:
        return 0.0
    z = 1 / float(inv_depth)
    height = height_above(plane, i, j, z)
    if not (min_height_at(z) < height < over.max_height_m):
        return 0.0
    x, y = back_project(k, i, j, z)
    return height if distance_outside(plane, x, y, z) <= OVERHANG.max_distance_m else 0.0
