"""Oriented points: position and normal of the surface at every third row and column."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.plane_fit import DepthSamples
from shapecat.detection.planes.settings import PLANES
from shapecat.jit import kernel

__all__ = ["OrientedPoints", "level_samples", "orient_points"]

STRIDE = 3
"""Distance between points, and from a point to the neighbours that give its normal, in cells. If it
is shorter, noise disturbs the normals; if it is longer, narrow boards have no point."""
FIRST = STRIDE // 2
"""First row and column of points."""


class OrientedPoints(NamedTuple):
    """Every third row and column of a depth grid, with normals.

    The n = rows * columns points are listed row by row. Those at the edge of the grid have neither
    a normal nor a position: both are 0.

    Attributes
    ----------
    inverse_depth : (rows, columns) float32, 1/m.
    normals : (3, n) float32 unit vectors towards the camera, sensor frame; 0 where the surface is
        not smooth.
    positions : (3, n) float32, metres, sensor frame; 0 where depth is missing.
    smooth : the number of points with a normal.
    """

    inverse_depth: F4
    normals: F4
    positions: F4
    smooth: int


def orient_points(grid: DepthGrid) -> OrientedPoints:
    """Return every third row and column, with normals where neighbours lie on a plane."""
    coarse = np.ascontiguousarray(grid.inverse_depth[FIRST::STRIDE, FIRST::STRIDE])
    normals, positions = np.zeros((2, 3, coarse.size), np.float32)
    smooth = _orient(coarse, grid.intrinsics, grid.discontinuity, normals, positions)
    return OrientedPoints(coarse, normals, positions, smooth)


@kernel
def _orient(
    coarse: F4, intrinsics: PinholeIntrinsics, jump: float, normals: F4, positions: F4
) -> int:
    """Write the normals and positions; return the number of points on smooth surface.

    ``coarse`` is every third row and column of the inverse depth; ``jump`` separates two surfaces,
    1/m. ``normals`` and ``positions`` (3, n) are as in `OrientedPoints`.
    """
    rows, columns = coarse.shape
    x = np.zeros(columns, np.float32)
    for c in range(columns):
        x[c] = (c * STRIDE + FIRST - intrinsics.cx) / intrinsics.fx
    smooth = 0
    for r in range(1, rows - 1):
        y = np.float32((r * STRIDE + FIRST - intrinsics.cy) / intrinsics.fy)
        focal = (intrinsics.fx, intrinsics.fy)
        smooth += _orient_row(coarse, r, y, x, focal, np.float32(2 * jump), normals, positions)
    return smooth


@kernel(fast=True, inner=True)
def _orient_row(
    coarse: F4,
    r: int,
    y: float,
    x: F4,
    focal: tuple[float, float],
    bend: float,
    normals: F4,
    positions: F4,
) -> int:
    """Write the points of a row; return the number on smooth surface. The loop vectorises.

    ``bend`` is the largest second difference of the inverse depth on a smooth surface, 1/m. The row
    has the index ``r`` in ``coarse``; the rays of its points are (x, y, 1), where ``y`` is the same
    for all and ``x`` is (columns,); ``focal`` is fx and fy.
    ``normals`` and ``positions`` are as in `_orient`.
    """
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    count = np.int32(0)
    across, down = np.float32(focal[0] / (2 * STRIDE)), np.float32(focal[1] / (2 * STRIDE))
    row_above, row, row_below = coarse[r - 1], coarse[r], coarse[r + 1]
    cells = slice(r * row.size, (r + 1) * row.size)
    nx, ny, nz = normals[0][cells], normals[1][cells], normals[2][cells]
    px, py, pz = positions[0][cells], positions[1][cells], positions[2][cells]
    for c in range(1, row.size - 1):
        center, left, right = row[c], row[c - 1], row[c + 1]
        top, bottom = row_above[c], row_below[c]
        smooth = (center > 0) & (left > 0) & (right > 0) & (top > 0) & (bottom > 0)
        smooth &= abs(left + right - two * center) <= bend
        smooth &= abs(top + bottom - two * center) <= bend
        count += np.int32(smooth)
        a, b = across * (left - right), down * (top - bottom)
        d = -a * x[c] - b * y - center
        scale, z = one / np.sqrt(a * a + b * b + d * d), one / center
        scale = scale if smooth else zero
        nx[c], ny[c], nz[c] = scale * a, scale * b, scale * d
        z = z if center > 0 else zero
        px[c], py[c], pz[c] = x[c] * z, y * z, z
    return int(count)


@kernel
def level_samples(points: OrientedPoints, up: F8) -> tuple[DepthSamples, F4]:
    """Return the samples whose normals are within 25 degrees of up, and their heights.

    ``up`` is a unit vector (3,), sensor frame; the heights (n,) are in metres above the sensor.
    """
    coarse, normals, positions = points.inverse_depth, points.normals, points.positions
    rows, columns = coarse.shape
    x, y, z = np.float32(up[0]), np.float32(up[1]), np.float32(up[2])
    values = np.zeros((4, points.smooth + 1), np.float32)
    min_cos, n = np.float32(PLANES.level_cos), 0
    for r in range(rows):
        for c in range(columns):
            k = r * columns + c
            if normals[0, k] * x + normals[1, k] * y + normals[2, k] * z > min_cos:
                values[0, n], values[1, n] = c * STRIDE + FIRST, r * STRIDE + FIRST
                values[2, n] = coarse[r, c]
                values[3, n] = positions[0, k] * x + positions[1, k] * y + positions[2, k] * z
                n += 1
    samples = DepthSamples(values[0][:n], values[1][:n], values[2][:n], STRIDE * STRIDE)
    return samples, values[3][:n]
