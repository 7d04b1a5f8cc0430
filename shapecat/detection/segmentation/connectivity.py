"""Connectivity: the links between object cells on one surface, and the concavity at each cell.

Source: Stein et al. 2014 (local convexity as a criterion to separate objects).
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, U1
from shapecat.detection.connected_components import DOWN, RIGHT, spans_of
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.normals import fit_local_planes, padded
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.jit import kernel, unset

__all__ = ["SurfaceGraph", "connect_surfaces"]

BENT = 4
"""A link's bit times this is a temporary bit: it marks links that only a local plane supports."""
MIN_CHORD = 3e-4
"""Squared distance between two unit normals at an angle of one degree. Smaller concave angles count
as 0."""

BASE, BASE_DIAGONAL = SEGMENTATION.base, SEGMENTATION.base_diagonal
SLOPE_CELLS = SEGMENTATION.slope_cells


class SurfaceGraph(NamedTuple):
    """The local surface at every object cell, and the links between cells.

    Attributes
    ----------
    local_plane : (rows, 3, columns) float32, inverse depth of the fitted plane at the cell, and its
        change per column and per row; 0 in object cells without a fit. Outside object cells, the
        inverse depth is 0 near them; the rest is uninitialised.
    normal : (rows, 3, columns) float32 unit normal towards the camera, sensor frame; 0 in object
        cells without a fit, uninitialised elsewhere.
    links : (rows, columns) uint8, `RIGHT` and `DOWN` where the surface continues to that neighbour.
    concavity : (rows, columns) uint8, the largest concave angle across the cell, degrees.
    spans : (rows, 2) int32, the first column of the object cells of each row, and one after the
        last; 0, 0 if there is none.
    """

    local_plane: F4
    normal: F4
    links: U1
    concavity: U1
    spans: I4


def connect_surfaces(grid: DepthGrid, heights: HeightMap) -> SurfaceGraph:
    """Fit local planes to the object cells, link them and measure concave angles."""
    inv_depth, plane_id = grid.inverse_depth, heights.plane_id
    spans = spans_of(plane_id)
    columns = inv_depth.shape[1]
    local_plane, normal = _blank(spans, columns)
    fit_local_planes(grid, plane_id, spans, local_plane, normal)
    links = np.zeros(inv_depth.shape, np.uint8)
    _link(grid, plane_id, spans, local_plane, links)
    graph = SurfaceGraph(local_plane, normal, links, np.zeros(inv_depth.shape, np.uint8), spans)
    _measure_concavity(grid, graph)
    return graph


@kernel
def _blank(spans: I4, columns: int) -> F4:
    """Return arrays (2, rows, 3, columns) for local planes and normals.

    The inverse depth of the local planes is 0 in and near object cells; the rest is uninitialised.
    ``spans`` (rows, 2) are as in `SurfaceGraph`.
    """
    rows = len(spans)
    fits: F4 = unset((2, rows, 3, columns), np.float32)
    for i in range(rows):
        start, end = columns, 0
        for y in range(max(i - BASE, 0), min(i + BASE + 1, rows)):
            if spans[y, 0] < spans[y, 1]:
                start, end = min(start, spans[y, 0]), max(end, spans[y, 1])
        for j in range(max(start - BASE, 0), min(padded(start, end) + BASE, columns)):
            fits[0, i, 0, j] = 0
    return fits


@kernel
def _link(grid: DepthGrid, plane_id: I4, spans: I4, local_plane: F4, links: U1) -> None:
    """Link neighbours of similar depth, or of which one lies on the local plane of the other.

    Both must be above the same supporting plane. ``plane_id`` is as in `HeightMap`; ``spans``,
    ``local_plane`` and ``links``, which is written, are as in `SurfaceGraph`.
    """
    inv_depth, jump = grid.inverse_depth, np.float32(grid.discontinuity)
    rows, columns = inv_depth.shape
    depths, plane_ids = inv_depth.reshape(-1), plane_id.reshape(-1)
    planes, bits = local_plane.reshape(-1), links.reshape(-1)
    for i in range(rows):
        start, end = spans[i, 0], spans[i, 1]
        if start == end:
            continue
        cell, fit = i * columns + start, 3 * i * columns + start
        run, right = (cell, fit, end - 1 - start), (1, 1, columns)
        _link_run(plane_ids, depths, planes, jump, run, right, RIGHT, bits)
        if i + 1 < rows:
            run, below = (cell, fit, end - start), (columns, 3 * columns, 2 * columns)
            _link_run(plane_ids, depths, planes, jump, run, below, DOWN, bits)
        _part_steps(grid, plane_id, i, start, end, links)


@kernel(inline=True)
def _part_steps(grid: DepthGrid, plane_id: I4, i: int, start: int, end: int, links: U1) -> None:
    """Remove links that cross a step and are supported by a local plane only.

    At a step the depths change more from one cell to the next than before and after it. A plane
    fitted to a window that spans the step treats it as a slope, so that a plate would be linked
    with the can it stands on. A link stays if one side has that slope too, as at the edge of a
    surface seen at a grazing angle. The object cells of row ``i`` are in columns ``start`` to
    ``end - 1``; ``plane_id`` is as in `HeightMap`, ``links`` as in `SurfaceGraph`, but with the
    bits of `BENT`, which are cleared.
    """
    inv_depth, jump = grid.inverse_depth, grid.discontinuity
    any_bent = False
    for j in range(np.uint64(start), np.uint64(end)):
        any_bent |= links[i, j] > (RIGHT | DOWN)  # few rows have any; this vectorises
    if not any_bent:
        return
    for j in range(start, end):
        for bit in (RIGHT, DOWN):
            if not links[i, j] & BENT * bit:
                continue
            di, dj = (0, 1) if bit == RIGHT else (1, 0)
            i0, j0, i1, j1 = (i - SLOPE_CELLS * di, j - SLOPE_CELLS * dj, i + di, j + dj)
            i2, j2 = i1 + SLOPE_CELLS * di, j1 + SLOPE_CELLS * dj
            if i0 < 0 or j0 < 0 or i2 >= inv_depth.shape[0] or j2 >= inv_depth.shape[1]:
                continue
            if plane_id[i0, j0] != plane_id[i, j] or plane_id[i2, j2] != plane_id[i, j]:
                continue
            step = inv_depth[i1, j1] - inv_depth[i, j]
            before = abs(step - (inv_depth[i, j] - inv_depth[i0, j0]) / SLOPE_CELLS)
            after = abs(step - (inv_depth[i2, j2] - inv_depth[i1, j1]) / SLOPE_CELLS)
            smaller, larger = min(before, after), max(before, after)
            if smaller >= SEGMENTATION.step_share * jump and larger >= jump:
                links[i, j] &= ~bit
        links[i, j] &= RIGHT | DOWN


@kernel(fast=True, inner=True)
def _link_run(
    plane_id: I4,
    inv_depth: F4,
    planes: F4,
    jump: float,
    run: tuple[int, int, int],
    steps: tuple[int, int, int],
    bit: int,
    links: U1,
) -> None:
    """Link a run of cells with their neighbours on one side. The loop vectorises.

    Parameters
    ----------
    plane_id, inv_depth, planes, links : the arrays of `_link`, flattened.
    jump : step in inverse depth that separates two surfaces, 1/m.
    run : the index of the first cell, the index of that cell's local plane, and the number of
        cells.
    steps : index offsets from a cell to its neighbour, from its local plane to the neighbour's, and
        from the inverse depth of a local plane to its slope in that direction.
    bit : `RIGHT` or `DOWN`; ``links`` also gets the bits of `BENT`.
    """
    zero = np.float32(0)
    cell, fit, step = np.uint64(run[0]), np.uint64(run[1]), np.uint64(steps[0])
    along, slope = np.uint64(steps[1]), np.uint64(steps[2])
    for k in range(np.uint64(max(run[2], 0))):
        p, a = cell + k, fit + k
        q, b = p + step, a + along
        v, v1, t, t1 = inv_depth[p], inv_depth[q], planes[a], planes[b]
        level_on = abs(v - v1) < jump
        bent = (t > zero) & (abs(t + planes[a + slope] - v1) < jump)
        bent |= (t1 > zero) & (abs(t1 - planes[b + slope] - v) < jump)
        same_plane = (plane_id[p] > 0) & (plane_id[p] == plane_id[q])
        link = np.uint8(bit) if level_on else np.uint8(bit + BENT * bit) if bent else np.uint8(0)
        links[p] |= link if same_plane else np.uint8(0)


@kernel
def _measure_concavity(grid: DepthGrid, graph: SurfaceGraph) -> None:
    """Write ``graph.concavity``: compare the local planes on opposite sides of each object cell."""
    inv_depth, gate = grid.inverse_depth, np.float32(2 * grid.discontinuity)
    rows, columns = inv_depth.shape
    local_plane, concavity = graph.local_plane, graph.concavity
    flat = (inv_depth.reshape(-1), local_plane.reshape(-1), graph.normal.reshape(-1))
    gaps, chords = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    worst = np.zeros(columns, np.float32)
    for i in range(rows):
        start, end = graph.spans[i]
        if start == end:
            continue
        worst[start:end] = MIN_CHORD
        for d in range(4):
            r = BASE if d < 2 else BASE_DIAGONAL
            di = 0 if d == 0 else r
            dj = r if d == 0 else (0 if d == 1 else (r if d == 2 else -r))
            first, last = max(start, abs(dj)), min(end, columns - abs(dj))
            last = min(padded(first, last), columns - abs(dj))
            if i - di >= 0 and i + di < rows and first < last:
                cells, shift = (i, first, last, columns), (di, dj)
                _raise_concavity(flat, grid.intrinsics, gate, cells, shift, gaps, chords, worst)
        _write_angles(local_plane[i, 0, start:end], worst[start:end], concavity[i, start:end])


@kernel(fast=True, inner=True)
def _raise_concavity(
    flat: tuple[F4, F4, F4],
    intrinsics: PinholeIntrinsics,
    gate: float,
    cells: tuple[int, int, int, int],
    shift: tuple[int, int],
    gaps: F4,
    chords: F4,
    worst: F4,
) -> None:
    """In concave cells, raise ``worst`` to the squared distance of the unit normals on both sides.

    This distance is the chord of the angle between the two normals.

    Parameters
    ----------
    flat : inverse depth, local planes and normals of all cells, flattened.
    gate : largest distance of either local plane from the sample of the cell, 1/m.
    cells : the row, the first column, one past the last, and the number of columns of the grid.
    shift : offset, in rows and columns, from a cell to one of the two normals that are compared;
        the other is at the opposite offset.
    gaps, chords : (columns,) work space.
    worst : (columns,) squared chords of the row.

    Notes
    -----
    There are three loops, because the compiler vectorises only loops over few arrays. There are no
    slices, because numba counts references to each. Indices are unsigned, because signed ones
    are checked for negative values.
    """
    i, first, last, columns = cells
    di, dj = shift
    zero, one = np.float32(0), np.float32(1)
    per_x, per_y = np.float32(1 / intrinsics.fx), np.float32(1 / intrinsics.fy)
    y1, y2 = np.float32(i - di - intrinsics.cy) * per_y, np.float32(i + di - intrinsics.cy) * per_y
    x1 = np.float32(first - dj - intrinsics.cx) * per_x
    x2 = np.float32(first + dj - intrinsics.cx) * per_x
    x, y = np.float32(dj), np.float32(di)
    inv_depth, plane, normal = flat
    n, cell, out = np.uint64(last - first), np.uint64(i * columns + first), np.uint64(first)
    # the indices of the inverse depth, and of its slopes per column and per row, on both sides
    a0 = np.uint64(3 * (i - di) * columns + first - dj)
    b0 = np.uint64(3 * (i + di) * columns + first + dj)
    row = np.uint64(columns)
    a1, a2, b1, b2 = a0 + row, a0 + row + row, b0 + row, b0 + row + row
    # (1) the distances of both planes from the cell
    for k in range(n):
        v1, v2, v = plane[a0 + k], plane[b0 + k], inv_depth[cell + k]
        gap1 = abs(v1 + plane[a1 + k] * x + plane[a2 + k] * y - v)
        gap2 = abs(v2 - plane[b1 + k] * x - plane[b2 + k] * y - v)
        gap = gap1 if gap1 > gap2 else gap2
        gaps[k] = gap if (v1 > zero) & (v2 > zero) else one
    # (2) the angle, 0 where convex
    for k in range(n):
        nx, ny = normal[a0 + k] - normal[b0 + k], normal[a1 + k] - normal[b1 + k]
        nz = normal[a2 + k] - normal[b2 + k]
        v1, v2 = plane[a0 + k], plane[b0 + k]
        # The vector from one point to the other, times both inverse depths to avoid divisions.
        step = np.float32(np.int32(k)) * per_x
        along = ((x1 + step) * v2 - (x2 + step) * v1) * nx + (v2 - v1) * nz
        along += (y1 * v2 - y2 * v1) * ny
        chords[k] = nx * nx + ny * ny + nz * nz if along < zero else zero
    # (3) the largest
    for k in range(n):
        chord = chords[k] if gaps[k] <= gate else zero
        worst[out + k] = chord if chord > worst[out + k] else worst[out + k]


@kernel(fast=True, inner=True)
def _write_angles(plane_w: F4, worst: F4, concavity: U1) -> None:
    """Write the angles of squared chords, degrees, up to 120; 0 for cells without a local plane.

    All arrays are of the object cells of a row (n,): ``plane_w``, the inverse depth of the local
    planes; ``worst``, the squared chords from `_raise_concavity`; ``concavity``, which is written.
    """
    degrees, max_angle = np.float32(180 / math.pi), np.float32(120)
    for k in range(concavity.size):
        half = np.sqrt(worst[k]) * np.float32(0.5)
        # arcsin by its series: 2 degrees off at a right angle
        angle = 2 * degrees * (half + half * half * half * np.float32(0.18))
        angle = angle if angle < max_angle else max_angle
        concavity[k] = np.uint8(angle) if plane_w[k] > np.float32(0) else np.uint8(0)
