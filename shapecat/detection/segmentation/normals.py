"""Normals: least-squares planes around the object cells, many cells at a time.

Numba vectorises over 16 cells only if it knows that arrays do not overlap, which requires few
arrays at constant distances. The windows of a run (consecutive cells of a row above one plane) are
therefore first copied to a buffer of fixed width, and the sums of each cell stay in registers.
"""

from typing import Any

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel

__all__ = ["fit_local_planes", "padded"]

WINDOW = 3
"""Half the edge of the window to which a local plane is fitted, in cells."""
SIDE = 2 * WINDOW + 1
"""Edge of the window, in cells."""
RUN = 128
"""Maximum number of cells in a run."""
LANES = 8
"""Runs are padded to multiples of this, because a remainder is not vectorised."""
NONE = 1e9
"""Placeholder for the inverse depth of a cell that is not used."""
PITCH = RUN + 2 * WINDOW
"""Width of a row of the buffers."""


@kernel
def fit_local_planes(grid: DepthGrid, plane_id: I4, spans: I4, local_plane: F4, normal: F4) -> None:
    """Fit a plane to the neighbourhood of each object sample; write its coefficients and normal.

    The neighbourhood is up to 25 samples in a checkerboard pattern. Samples above the same
    supporting plane and at similar depth have weight 1, the others 0.

    Parameters
    ----------
    plane_id : (rows, columns) as in `HeightMap`.
    spans : (rows, 2) first column of the object cells of each row, and one past the last.
    local_plane, normal : (rows, 3, columns), written in place; as in `SurfaceGraph`.
    """
    values = np.zeros(SIDE * PITCH, np.float32)
    fits = np.zeros(6 * PITCH, np.float32)
    depths, plane_ids = grid.inverse_depth.reshape(-1), plane_id.reshape(-1)
    planes, normals = local_plane.reshape(-1), normal.reshape(-1)
    shape, wider = plane_id.shape, np.float32(grid.discontinuity / DISCONTINUITY)
    for i in range(shape[0]):
        end, last = np.int64(spans[i, 0]), np.int64(spans[i, 1])
        while end < last:
            start, end = _next_run(plane_ids, i * shape[1], end, last)
            _copy_windows(depths, plane_ids, shape, (i, start, end), values)
            _fit_run(values, grid.intrinsics, wider, i, start, padded(start, end) - start, fits)
            _write(fits, planes, normals, 3 * i * shape[1] + start, shape[1], end - start)


@kernel(inner=True)
def padded(start: int, end: int) -> int:
    """Return the end of a run from ``start`` to ``end``, padded to a multiple of `LANES` cells."""
    return start + (end - start + LANES - 1) // LANES * LANES


@kernel(inline=True)
def _write(fits: F4, planes: F4, normals: F4, start: int, columns: int, n: int) -> None:
    """Copy the fits of a run of ``n`` cells, from `_fit_run`, to the local planes and normals.

    ``planes`` and ``normals`` are as in `fit_local_planes`, flattened; ``start`` is the index of
    the run in them, ``columns`` the width of the grid. Slices and signed indices would be slower.
    """
    for d in range(3):
        target, plane = np.uint64(start + d * columns), np.uint64(d * PITCH)
        unit = np.uint64((3 + d) * PITCH)
        for k in range(np.uint64(n)):
            planes[target + k] = fits[plane + k]
        for k in range(np.uint64(n)):
            normals[target + k] = fits[unit + k]


@kernel(inline=True)
def _next_run(plane_ids: I4, row: int, j: int, last: int) -> tuple[int, int]:
    """Return the first column, and one past the last, of the next run of cells above one plane.

    Gaps narrower than `SegmentationSettings.bridged` are included. The search begins at column
    ``j``. ``plane_ids`` are as in `HeightMap`, flattened. There must be an object cell before
    ``last``; ``row`` is the index of the first cell of the row.
    """
    while plane_ids[row + j] <= 0:
        j += 1
    start = end = j
    plane, last = plane_ids[row + j], min(last, start + RUN)
    while j < min(last, end + SEGMENTATION.bridged) and (
        plane_ids[row + j] <= 0 or plane_ids[row + j] == plane
    ):
        end = j + 1 if plane_ids[row + j] == plane else end
        j += 1
    return start, end


@kernel(inline=True)
def _copy_windows(
    depths: F4, plane_ids: I4, shape: tuple[int, int], run: tuple[int, int, int], values: F4
) -> None:
    """Copy the rows around a run, and `WINDOW` cells beyond its ends, to ``values``.

    Writes inverse depth, or `NONE` for cells that are not above the plane of the run. ``run`` is
    the row of the run, its first column, and one past its last. ``depths`` and ``plane_ids`` (rows
    * columns,) are inverse depth and `HeightMap.plane_id`, flattened from ``shape``; ``values``
    (SIDE * PITCH,) holds one row after the other.
    """
    rows, columns = shape
    i, start, end = run
    plane, none = plane_ids[i * columns + start], np.float32(NONE)
    left, right = max(start - WINDOW, 0), min(end + WINDOW, columns)
    for d in range(SIDE):
        y, first = i + d - WINDOW, np.uint64(d * PITCH)
        for k in range(np.uint64(end - start + 2 * WINDOW)):
            values[first + k] = none
        if 0 <= y < rows:
            target = np.uint64(d * PITCH + left - start + WINDOW)
            source = np.uint64(y * columns + left)
            for k in range(np.uint64(right - left)):
                values[target + k] = depths[source + k] if plane_ids[source + k] == plane else none


@kernel(fast=True, inner=True)
def _fit_run(
    values: F4, intrinsics: PinholeIntrinsics, wider: float, i: int, start: int, n: int, fits: F4
) -> None:
    """Fit a plane to the window around each of ``n`` cells of row i, from column ``start``.

    ``wider`` multiplies the gates of `SEGMENTATION`. ``values`` (SIDE * PITCH,) are from
    `_copy_windows`. ``fits`` (6 * PITCH,), written in place, holds blocks of `PITCH`: inverse
    depth, its change per column and per row, and the normal x, y, z; 0 where there is no fit.
    """
    zero, one = np.float32(0), np.float32(1)
    g0, slope = wider * np.float32(SEGMENTATION.gate), wider * np.float32(SEGMENTATION.gate_slope)
    g1, g2, g3 = g0 + slope, g0 + np.float32(2) * slope, g0 + np.float32(3) * slope
    min_count = np.float32(SEGMENTATION.min_samples)
    min_spread = np.float32(SEGMENTATION.min_spread)
    fx, fy, y = np.float32(intrinsics.fx), np.float32(intrinsics.fy), np.float32(i - intrinsics.cy)
    for k in range(n):
        p = k + WINDOW
        center = values[WINDOW * PITCH + p]
        # (1) sums over the rows of the window: 1, x, x², v, x v
        n0, x0, xx0, v0, xv0 = _four(values, p, center, g3, g3)
        n1, x1, xx1, v1, xv1 = _three(values, PITCH + p, center, g2, g2)
        n2, x2, xx2, v2, xv2 = _four(values, 2 * PITCH + p, center, g3, g1)
        n3, x3, xx3, v3, xv3 = _three(values, 3 * PITCH + p, center, g2, g0)
        n4, x4, xx4, v4, xv4 = _four(values, 4 * PITCH + p, center, g3, g1)
        n5, x5, xx5, v5, xv5 = _three(values, 5 * PITCH + p, center, g2, g2)
        n6, x6, xx6, v6, xv6 = _four(values, 6 * PITCH + p, center, g3, g3)
        # (2) means and moments over the window
        count = n0 + n1 + n2 + n3 + n4 + n5 + n6
        share = one / max(count, one)
        mx = (x0 + x1 + x2 + x3 + x4 + x5 + x6) * share
        my = _times_row(n0, n1, n2, n4, n5, n6) * share
        mv = (v0 + v1 + v2 + v3 + v4 + v5 + v6) * share
        xx = (xx0 + xx1 + xx2 + xx3 + xx4 + xx5 + xx6) * share - mx * mx
        xy = _times_row(x0, x1, x2, x4, x5, x6) * share - mx * my
        yy = (np.float32(9) * (n0 + n6) + np.float32(4) * (n1 + n5) + n2 + n4) * share - my * my
        xv = (xv0 + xv1 + xv2 + xv3 + xv4 + xv5 + xv6) * share - mx * mv
        yv = _times_row(v0, v1, v2, v4, v5, v6) * share - my * mv
        # (3) the plane, and its normal in the sensor frame
        determinant = xx * yy - xy * xy
        valid = (center < np.float32(NONE)) & (count >= min_count) & (determinant >= min_spread)
        scale = one / (determinant if valid else one)
        gx, gy = (xv * yy - yv * xy) * scale, (yv * xx - xv * xy) * scale
        level = center + mv - gx * mx - gy * my
        nx, ny = -fx * gx, -fy * gy
        nz = gx * np.float32(start + k - intrinsics.cx) + gy * y - level
        valid &= level > zero
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        unit = one / (length if length > zero else one)
        fits[k] = level if valid else zero
        fits[PITCH + k], fits[2 * PITCH + k] = gx if valid else zero, gy if valid else zero
        unit = unit if valid else zero
        fits[3 * PITCH + k], fits[4 * PITCH + k] = nx * unit, ny * unit
        fits[5 * PITCH + k] = nz * unit


@kernel(fast=True, inner=True)
def _times_row(a: float, b: float, c: float, e: float, f: float, g: float) -> Any:
    """Return the sum of the values of rows -3, -2, -1, 1, 2 and 3, each times its row number.

    The parameters ``a`` to ``g`` are the values in this order.
    """
    return np.float32(3) * (g - a) + np.float32(2) * (f - b) + (e - c)


@kernel(fast=True, inner=True)
def _four(
    values: F4, p: int, center: float, outer_gate: float, inner_gate: float
) -> tuple[float, float, float, float, float]:
    """Return the sums of 1, x, x², v, x v over the samples at columns -3, -1, 1, 3 from ``p``.

    Here x is the column relative to ``p``, and v the difference from ``center``, 1/m; samples of
    weight 0 do not count. ``values`` are from `_copy_windows`; the
    gates of the outer and the inner samples are as in `_sample`.
    """
    a, va = _sample(values, p - 3, center, outer_gate)
    b, vb = _sample(values, p - 1, center, inner_gate)
    c, vc = _sample(values, p + 1, center, inner_gate)
    d, vd = _sample(values, p + 3, center, outer_gate)
    three, nine = np.float32(3), np.float32(9)
    x, xx = three * (d - a) + (c - b), nine * (a + d) + (b + c)
    return a + b + c + d, x, xx, va + vb + vc + vd, three * (vd - va) + (vc - vb)


@kernel(fast=True, inner=True)
def _three(
    values: F4, p: int, center: float, outer_gate: float, inner_gate: float
) -> tuple[float, float, float, float, float]:
    """Return the sums of 1, x, x², v, x v over the samples at columns -2, 0, 2 from ``p``.

    Sums and parameters are as in `_four`; the inner gate is for column 0.
    """
    a, va = _sample(values, p - 2, center, outer_gate)
    b, vb = _sample(values, p, center, inner_gate)
    c, vc = _sample(values, p + 2, center, outer_gate)
    two = np.float32(2)
    return a + b + c, two * (c - a), two * two * (a + c), va + vb + vc, two * (vc - va)


@kernel(fast=True, inner=True)
def _sample(values: F4, p: int, center: float, gate: float) -> tuple[Any, Any]:
    """Return the weight of a sample, 0 or 1, and its weighted difference from the centre.

    ``values`` are from `_copy_windows`, ``p`` is an index in them; the weight is 1 if the
    difference from ``center`` is below ``gate``, 1/m.
    """
    v = values[p] - center
    weight = np.float32(1) if abs(v) < gate else np.float32(0)
    return weight, weight * v
