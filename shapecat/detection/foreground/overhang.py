"""Overhang: what stands on a plane and reaches over its outline.

The outline is that of the readings: it ends before the far edge of a table where that is hidden,
and at the front edge, over which things may stick out.
"""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics, row_and_column
from shapecat.detection.foreground.walls import CLEARED
from shapecat.detection.planes.height_map import (
    HEIGHT_NOISE,
    MIN_HEIGHT_M,
    HeightMap,
    is_inside_outline,
)
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel, unset

__all__ = ["extend_overhang"]

REACH_M = 0.15
"""How far objects reach over an outline."""
BEYOND = 5
"""So many times as much of an object may be seen outside as inside."""


class Search(NamedTuple):
    """What is looked at around the outline of a plane.

    Attributes
    ----------
    inv_depth, intrinsics : as in `DepthGrid`.
    plane_id : as in `HeightMap`.
    walls : from `remove_walls`.
    me, plane : the number of the plane in ``plane_id``, and its row of `pack_planes`.
    highest : so high above it an object reaches at most, metres.
    outside : (rows, columns) float32 heights above it, metres, of the cells looked at.
    visited : (rows, columns) int8 its number at these.
    """

    inverse_depth: F4
    intrinsics: PinholeIntrinsics
    plane_id: I4
    walls: U1
    me: int
    plane: F8
    highest: float
    outside: F4
    visited: I4


@kernel
def extend_overhang(
    grid: DepthGrid, heights: HeightMap, planes: F8, walls: U1, highest_m: float
) -> None:
    """Give the parts of objects outside the outline of their plane to it, in place.

    A part is what is connected to object cells inside, and not many times larger than what is
    inside: a wall behind a table does not stand on it.

    Parameters
    ----------
    planes : the rows of `pack_planes`.
    walls : from `remove_walls`; what is cleared stays so.
    """
    inv_depth, intrinsics, plane_id = grid.inverse_depth, grid.intrinsics, heights.plane_id
    outside, visited = unset(plane_id.shape, np.float32), np.zeros(plane_id.shape, np.int8)
    seen, stacks = np.zeros(plane_id.shape, np.int32), unset((2, inv_depth.size), np.int32)
    visits = np.int64(0)  # a literal would be compiled apart
    for me in range(len(planes), 0, -1):
        search = Search(
            inv_depth, intrinsics, plane_id, walls, me, planes[me - 1], highest_m, outside, visited
        )
        visits = _extend(search, heights.height, seen, visits, stacks)


@kernel
def _extend(search: Search, height: F4, seen: I4, visits: int, stacks: I4) -> int:
    """Add the parts outside one plane; return the number of the last part visited."""
    inv_depth, plane_id, me = search.inverse_depth, search.plane_id, search.me
    visited = search.visited
    rows, columns = inv_depth.shape
    border = np.zeros(columns, np.uint8)
    for i in range(rows):
        if not _find_border(plane_id, me, i, border):
            continue
        for j in range(columns):
            if border[j] == 0:
                continue
            for d in range(4):
                y = i + (1 if d == 0 else -1 if d == 1 else 0)
                x = j + (1 if d == 2 else -1 if d == 3 else 0)
                if y < 0 or x < 0 or y >= rows or x >= columns:
                    continue
                if not 0 <= plane_id[y, x] < me or visited[y, x] == me:
                    continue
                n = _part_outside(search, i, j, d, stacks[0])
                if n == 0:
                    continue
                visits += 1
                enough = max(n // BEYOND, 1)
                if (
                    _part_inside(inv_depth, plane_id, me, seen, visits, i, j, enough, stacks[1])
                    < enough
                ):
                    continue
                for t in range(1, n + 1):
                    v, u = row_and_column(stacks[0, t], columns)
                    plane_id[v, u] = me
                    height[v, u] = search.outside[v, u]
    return visits


@kernel
def _find_border(plane_id: I4, me: int, i: int, border: U1) -> bool:
    """Mark the cells of a row above a plane that are beside cells of lower planes or of none.

    Returns
    -------
    Whether there are any.
    """
    rows, columns = plane_id.shape
    above, here, below = plane_id[max(i - 1, 0)], plane_id[i], plane_id[min(i + 1, rows - 1)]
    mine = np.uint8(me)  # without a sign what lies on a surface is larger
    for j in range(columns):
        lower = (np.uint8(above[j]) < mine) | (np.uint8(below[j]) < mine)
        border[j] = lower & (np.uint8(here[j]) == mine)
    for j in range(columns - 1):
        border[j] |= (np.uint8(here[j]) == mine) & (np.uint8(here[j + 1]) < mine)
    for j in range(columns - 1):
        border[j + 1] |= (np.uint8(here[j + 1]) == mine) & (np.uint8(here[j]) < mine)
    some = np.uint8(0)
    for j in range(columns):
        some |= border[j]
    return bool(some > 0)


@kernel
def _part_outside(search: Search, i: int, j: int, way: int, stack: I4) -> int:
    """Collect the connected cells outside, from cell (i, j) inside on in one of four directions.

    They are above a lower plane or none, and not visited before; notes their heights. Returns how
    many there are, in ``stack`` from its second place on.
    """
    inv_depth, intrinsics, plane_id, walls, me, plane, highest, outside, visited = search
    rows, columns = inv_depth.shape
    stack[0] = i * columns + j
    done, top = 0, 1
    while done < top:
        i, j = row_and_column(stack[done], columns)
        done += 1
        here = inv_depth[i, j]
        for d in range(4):
            if done == 1 and d != way:
                continue
            y = i + (1 if d == 0 else -1 if d == 1 else 0)
            x = j + (1 if d == 2 else -1 if d == 3 else 0)
            if y < 0 or x < 0 or y >= rows or x >= columns or not 0 <= plane_id[y, x] < me:
                continue
            w = inv_depth[y, x]
            if abs(w - here) >= DISCONTINUITY or w <= 0 or walls[y, x] == CLEARED:
                continue
            if visited[y, x] == me:
                continue
            z = 1 / w
            h = (w - (plane[0] * x + plane[1] * y + plane[2])) * z * plane[3]
            if not (MIN_HEIGHT_M + HEIGHT_NOISE * z * z < h < highest):
                continue
            across, down = (x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy
            if is_inside_outline(plane, across * z, down * z, z, REACH_M):
                outside[y, x], visited[y, x] = h, me
                stack[top] = y * columns + x
                top += 1
    return top - 1


@kernel
def _part_inside(
    inv_depth: F4, plane_id: I4, me: int, seen: I4, look: int, i: int, j: int, most: int, stack: I4
) -> int:
    """Count the connected object cells inside, up to ``most``."""
    rows, columns = inv_depth.shape
    stack[0] = i * columns + j
    seen[i, j] = look
    done, top = 0, 1
    while done < top < most:
        i, j = row_and_column(stack[done], columns)
        done += 1
        for d in range(4):
            y = i + (1 if d == 0 else -1 if d == 1 else 0)
            x = j + (1 if d == 2 else -1 if d == 3 else 0)
            if y < 0 or x < 0 or y >= rows or x >= columns or plane_id[y, x] != me:
                continue
            if seen[y, x] != look and abs(inv_depth[y, x] - inv_depth[i, j]) < DISCONTINUITY:
                seen[y, x] = look
                stack[top] = y * columns + x
                top += 1
    return top
