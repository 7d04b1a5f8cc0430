"""Planes in inverse depth: depth samples, inliers, normals, level planes, and least squares."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import PinholeIntrinsics
from shapecat.jit import kernel

__all__ = ["DepthSamples", "dot", "horizontal_plane", "plane_normal", "refine", "select_inliers"]


class DepthSamples(NamedTuple):
    """A list of depth samples.

    Attributes
    ----------
    j, i : (n,) float32 columns and rows.
    inverse_depth : (n,) float32, 1/m.
    cells_per_sample : the number of cells that each sample represents.
    """

    j: F4
    i: F4
    inverse_depth: F4
    cells_per_sample: int


@kernel
def select_inliers(samples: DepthSamples, plane: F8, tolerance: float) -> DepthSamples:
    """Return the samples whose inverse depth differs by less than ``tolerance``, 1/m, from a plane.

    The inverse depth of the plane (a, b, c) at column j and row i is ``a * j + b * i + c``, 1/m;
    where this is not positive, the plane is not visible and has no inliers.
    """
    inliers = np.zeros((3, samples.inverse_depth.size), np.float32)
    n = 0
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        level = plane[0] * j + plane[1] * i + plane[2]
        inliers[0, n], inliers[1, n], inliers[2, n] = j, i, v
        n += (level > 0) & (abs(v - level) < tolerance)
    return DepthSamples(inliers[0][:n], inliers[1][:n], inliers[2][:n], samples.cells_per_sample)


@kernel(inner=True)
def plane_normal(plane: F8, intrinsics: PinholeIntrinsics) -> F8:
    """Return the unit normal (3,) of a plane, sensor frame, pointing towards the camera.

    The inverse depth of the plane (a, b, c) at column j and row i is ``a * j + b * i + c``, 1/m.
    """
    a, b, c = plane
    x, y, z = -a * intrinsics.fx, -b * intrinsics.fy, -(a * intrinsics.cx + b * intrinsics.cy + c)
    norm = math.sqrt(x * x + y * y + z * z)
    return np.array([x / norm, y / norm, z / norm])


@kernel(inner=True)
def dot(a: F8, b: F8) -> float:
    """Return the dot product of two vectors ``a`` and ``b`` (3,)."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@kernel
def horizontal_plane(intrinsics: PinholeIntrinsics, up: F8, offset: float) -> F8:
    """Return the inverse depth of the plane ``up @ p == offset`` (metres, sensor frame).

    The result (a, b, c) means ``a * j + b * i + c``, 1/m, at column j and row i.
    """
    a, b = up[0] / intrinsics.fx, up[1] / intrinsics.fy
    return np.array(
        [a / offset, b / offset, (up[2] - a * intrinsics.cx - b * intrinsics.cy) / offset]
    )


@kernel(fast=True, inner=True)
def refine(samples: DepthSamples, tolerance: float, plane: F8) -> int:
    """Fit a plane (a, b, c) to its inliers by least squares, in place; return their number.

    The plane does not change if the inliers do not determine it. ``tolerance`` is in 1/m.
    """
    j, i, inv_depth = samples.j, samples.i, samples.inverse_depth
    if inv_depth.size == 0:
        return 0
    a, b, c = plane[0], plane[1], plane[2]
    j0, i0, w0 = float(j[0]), float(i[0]), float(inv_depth[0])
    n = mx = my = mw = xx = xy = yy = xw = yw = 0.0
    for k in range(inv_depth.size):
        # A sum of products with 0 or 1 vectorises.
        weight = 1.0 if abs(inv_depth[k] - (a * j[k] + b * i[k] + c)) < tolerance else 0.0
        x, y, v = weight * (j[k] - j0), weight * (i[k] - i0), weight * (inv_depth[k] - w0)
        n += weight
        mx += x
        my += y
        mw += v
        xx += x * x
        xy += x * y
        yy += y * y
        xw += x * v
        yw += y * v
    if n < 3:
        return int(n)
    mx, my, mw = mx / n, my / n, mw / n
    xx, xy, yy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    xw, yw = xw / n - mx * mw, yw / n - my * mw
    determinant = xx * yy - xy * xy
    if determinant > 1e-6 * (xx + yy) ** 2:
        plane[0] = (xw * yy - yw * xy) / determinant
        plane[1] = (yw * xx - xw * xy) / determinant
        plane[2] = w0 + mw - plane[0] * (mx + j0) - plane[1] * (my + i0)
    return int(n)
