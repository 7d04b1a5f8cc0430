"""Plane extent: the outline and the area of a horizontal plane."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, U1
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.ransac import INLIER_TOLERANCE, DepthSamples, plane_normal
from shapecat.geometry import level_axes
from shapecat.jit import kernel

__all__ = [
    "ARM",
    "COS",
    "DIRECTIONS",
    "LEAST_AREA_M2",
    "MARGIN_M",
    "SIN",
    "SupportingPlane",
    "measure_plane",
    "outline_corners",
    "sort_by_height",
]

DIRECTIONS = 16
"""Sides of the convex outline of a plane."""
ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COS, SIN = np.cos(ANGLES), np.sin(ANGLES)
MARGIN_M = 0.01
"""An outline reaches this far beyond the readings."""
LEAST_AREA_M2 = 0.02
"""Visible area of the smallest plane."""
ARM = 3
"""Cells to each side over which a surface is seen to be level; odd."""


class SupportingPlane(NamedTuple):
    """A horizontal plane that objects may stand on, in units of cells.

    ``a * j + b * i + c`` is its inverse depth at cell (i, j); ``up`` (3,) its unit normal in the
    sensor frame and ``offset`` its height along ``up``; ``extent`` (DIRECTIONS,) how far it extends
    along evenly spaced directions of the level frame, metres; ``area_m2`` its visible area.
    """

    a: float
    b: float
    c: float
    up: F8
    offset: float
    extent: F8
    area_m2: float


@kernel
def measure_plane(grid: DepthGrid, samples: DepthSamples, plane: F8) -> SupportingPlane:
    """Measure a plane (a, b, c) on readings near it."""
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    normal = plane_normal(plane, intrinsics)
    x, y = plane[0] * intrinsics.fx, plane[1] * intrinsics.fy
    z = plane[0] * intrinsics.cx + plane[1] * intrinsics.cy + plane[2]
    distance = 1 / math.sqrt(x * x + y * y + z * z)
    area = _area_of(samples, plane, distance) / (intrinsics.fx * intrinsics.fy)
    axes = np.array(level_axes(normal[0], normal[1], normal[2]))
    beside = _beside_inliers(samples, plane, inv_depth.shape[0], inv_depth.shape[1])
    extent = _extent_of(inv_depth, intrinsics, plane, axes, beside)
    return SupportingPlane(plane[0], plane[1], plane[2], normal, -distance, extent, area)


@kernel(fast=True)
def _area_of(samples: DepthSamples, plane: F8, distance: float) -> float:
    """Return the visible area of a plane by that of a pixel at 1 m, from its distance."""
    j, i, inv_depth = samples.j, samples.i, samples.inverse_depth
    total = 0.0
    for k in range(inv_depth.size):
        level = plane[0] * j[k] + plane[1] * i[k] + plane[2]
        near = (level > 0) & (abs(inv_depth[k] - level) < INLIER_TOLERANCE)
        facing = level * distance  # the cosine between the normal and the ray
        area = 1 / (level * level * (facing if facing > 0.05 else 0.05))
        total += area if near else 0.0
    return float(samples.share * total)


@kernel(fast=True)
def _beside_inliers(samples: DepthSamples, plane: F8, rows: int, columns: int) -> U1:
    """Mark the cells (rows, columns) to which the surface was seen to go on from an inlier."""
    j, i, inv_depth = samples.j, samples.i, samples.inverse_depth
    top, width = np.int32(ARM), np.int32(columns)
    place = np.zeros(inv_depth.size, np.int32)
    for k in range(inv_depth.size):
        level = plane[0] * j[k] + plane[1] * i[k] + plane[2]
        near = (level > 0) & (abs(inv_depth[k] - level) < INLIER_TOLERANCE)
        here = np.int32(j[k]) + (np.int32(i[k]) + top) * width
        place[k] = here if near else np.int32(0)
    # There are margins above and below; those at the sides are cells that never are inliers.
    n, margin = rows * columns, ARM * columns
    inliers = np.zeros(n + 2 * margin, np.uint8)
    for p in place:
        inliers[p] = 1
    inliers[0] = 0
    above, below = inliers[:n], inliers[2 * margin :]
    left, right = inliers[margin - ARM :], inliers[margin + ARM :]
    beside = np.zeros(n, np.uint8)
    for k in range(n):
        beside[k] = above[k] | below[k] | left[k] | right[k]
    return beside.reshape(rows, columns)


@kernel
def _extent_of(inv_depth: F4, intrinsics: PinholeIntrinsics, plane: F8, axes: F8, beside: U1) -> F8:
    """Return how far the plane reaches along `DIRECTIONS`, metres, with a margin."""
    across, along = axes[0], axes[1]
    extent = np.full(DIRECTIONS, -np.inf)
    for i in range(inv_depth.shape[0]):
        # The outline is convex in the image too: the first and last cell of each row tell it.
        first, last = _ends(inv_depth, plane, i, beside[i])
        if first > last:
            continue
        for j in (first, last):
            z = 1 / (plane[0] * j + plane[1] * i + plane[2])
            x, y = (j - intrinsics.cx) / intrinsics.fx * z, (i - intrinsics.cy) / intrinsics.fy * z
            u = across[0] * x + across[1] * y + across[2] * z
            v = along[0] * x + along[1] * y + along[2] * z
            for k in range(DIRECTIONS):
                there = COS[k] * u + SIN[k] * v
                extent[k] = there if there > extent[k] else extent[k]
    return extent + MARGIN_M


@kernel
def _ends(inv_depth: F4, plane: F8, i: int, beside: U1) -> tuple[int, int]:
    """Return the first and the last marked cell of a row in the plane; none: first > last."""
    none = np.int32(beside.size)
    first, last = none, np.int32(-1)
    for k in range(beside.size):  # no more than 32 bits, and this vectorises
        low = np.int32(k) if beside[k] else none
        high = np.int32(k) if beside[k] else np.int32(-1)
        first, last = (low if low < first else first), (high if high > last else last)
    while first <= last and not (beside[first] and _is_in(inv_depth, plane, i, first)):
        first += 1
    while first < last and not (beside[last] and _is_in(inv_depth, plane, i, last)):
        last -= 1
    return int(first), int(last)


@kernel
def _is_in(inv_depth: F4, plane: F8, i: int, j: int) -> bool:
    level = plane[0] * j + plane[1] * i + plane[2]
    return bool(level > 0 and abs(inv_depth[i, j] - level) < INLIER_TOLERANCE)


@kernel
def outline_corners(support: SupportingPlane) -> F8:
    """Return the corners (k, 3) of the convex outline, sensor frame, in order, without repeats."""
    up, extent = support.up, support.extent
    axes = level_axes(up[0], up[1], up[2])
    corners = np.zeros((DIRECTIONS, 3))
    for k in range(DIRECTIONS):
        # Neighbouring sides x cos + y sin = reach meet at a corner.
        along = (extent[(k + 1) % DIRECTIONS] - extent[k] * COS[1]) / SIN[1]
        x, y = extent[k] * COS[k] - along * SIN[k], extent[k] * SIN[k] + along * COS[k]
        for d in range(3):
            corners[k, d] = x * axes[0][d] + y * axes[1][d] + support.offset * axes[2][d]
    return corners


@kernel
def sort_by_height(found: list[tuple[SupportingPlane, DepthSamples]]) -> None:
    """Put the lowest plane first, in place."""
    for k in range(1, len(found)):
        one, m = found[k], k
        while m > 0 and found[m - 1][0].offset > one[0].offset:
            found[m] = found[m - 1]
            m -= 1
        found[m] = one
