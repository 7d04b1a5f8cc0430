"""Plane extent: the outline and the visible area of a horizontal plane."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.plane_fit import DepthSamples, plane_normal, select_inliers
from shapecat.detection.planes.settings import PLANES
from shapecat.geometry import gravity_rotation, level_axes
from shapecat.jit import kernel

__all__ = [
    "COS",
    "DIRECTIONS",
    "SIN",
    "PlaneCandidate",
    "SupportingPlane",
    "area_of",
    "level_coordinates",
    "measure_candidate",
    "outline_corners",
]

DIRECTIONS = 16
"""Number of sides of the convex outline of a plane."""
ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COS, SIN = np.cos(ANGLES), np.sin(ANGLES)
"""Components along x and y of the directions of `SupportingPlane.extent`, level frame."""
APART = 3
"""Distance, in cells, from the first or last inlier of a row to neighbours that extend the outline
if they lie on the plane."""


class SupportingPlane(NamedTuple):
    """A horizontal plane that objects may stand on.

    Attributes
    ----------
    a, b, c : the inverse depth at column j and row i of the grid is ``a * j + b * i + c``, 1/m.
    up : (3,) unit normal, sensor frame.
    offset : metres, ``up @ p`` for the points p of the plane.
    extent : (DIRECTIONS,) metres, the support function of the outline: its extent from the sensor
        in evenly spaced directions of the level frame (`gravity_rotation`).
    area_m2 : visible area, m².
    """

    a: float
    b: float
    c: float
    up: F8
    offset: float
    extent: F8
    area_m2: float


class PlaneCandidate(NamedTuple):
    """A plane that may support objects.

    Attributes
    ----------
    plane : the plane, with its outline and visible area.
    inliers : its samples.
    covered_m2 : area that counts as visible although objects cover it, m²; see `add_strip_planes`.
    """

    plane: SupportingPlane
    inliers: DepthSamples
    covered_m2: float = 0.0


def measure_candidate(grid: DepthGrid, samples: DepthSamples, plane: F8) -> PlaneCandidate:
    """Measure the outline and the area of a plane (a, b, c) on its inliers among samples."""
    inliers: DepthSamples = select_inliers(samples, plane, PLANES.tolerance)
    return PlaneCandidate(_measure(grid, inliers, plane), inliers)


@kernel
def _measure(grid: DepthGrid, inliers: DepthSamples, plane: F8) -> SupportingPlane:
    """Measure the height, extent and area of a plane (a, b, c) on its ``inliers``."""
    normal = plane_normal(plane, grid.intrinsics)
    x, y = plane[0] * grid.intrinsics.fx, plane[1] * grid.intrinsics.fy
    z = plane[0] * grid.intrinsics.cx + plane[1] * grid.intrinsics.cy + plane[2]
    offset = -1 / math.sqrt(x * x + y * y + z * z)
    area = area_of(inliers, plane, -offset) / (grid.intrinsics.fx * grid.intrinsics.fy)
    ends = _ends(inliers, grid.inverse_depth.shape[0], grid.inverse_depth.shape[1])
    extent = _extent_of(grid, plane, normal, ends)
    return SupportingPlane(plane[0], plane[1], plane[2], normal, offset, extent, area)


@kernel(fast=True, inner=True)
def area_of(inliers: DepthSamples, plane: F8, distance: float) -> float:
    """Return the visible area of a plane, relative to the area of a cell at 1 m.

    ``plane`` (3,) is a, b, c of its inverse depth; ``distance`` is its distance from the sensor,
    metres.
    """
    total = 0.0
    for k in range(inliers.inverse_depth.size):
        inverse_depth = plane[0] * inliers.j[k] + plane[1] * inliers.i[k] + plane[2]
        facing = inverse_depth * distance  # minus the dot product of normal and ray
        total += 1 / (inverse_depth * inverse_depth * (facing if facing > 0.05 else 0.05))
    return float(inliers.cells_per_sample * total)


@kernel(inline=True)
def _ends(inliers: DepthSamples, rows: int, columns: int) -> I4:
    """Return the first and last inlier column of each row, (2, rows); the last is -1 if none."""
    ends = np.zeros((2, rows), np.int32)
    for i in range(rows):
        ends[0, i], ends[1, i] = columns, -1
    for k in range(inliers.inverse_depth.size):
        i, j = int(inliers.i[k]), int(inliers.j[k])
        ends[0, i], ends[1, i] = min(ends[0, i], j), max(ends[1, i], j)
    return ends


@kernel(inline=True)
def _extent_of(grid: DepthGrid, plane: F8, normal: F8, ends: I4) -> F8:
    """Return the `SupportingPlane.extent` of a plane, enlarged by `PLANES.margin_m`.

    Without inliers, it is -inf.

    Perspective keeps a convex outline convex, so only the ends of each row are used, with those of
    their neighbours at the distance `APART` that lie on the plane. ``plane`` (3,) is a, b, c of its
    inverse depth; ``normal`` (3,) is in the sensor frame; ``ends`` (2, rows) are from `_ends`.
    """
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    rows, columns = inv_depth.shape
    across, along, _ = level_axes(normal[0], normal[1], normal[2])
    extent = np.full(DIRECTIONS, -np.inf)
    for i in range(rows):
        for side in range(2 if ends[1, i] >= 0 else 0):
            j = ends[side, i]
            for di, dj in ((0, 0), (0, -APART), (0, APART), (-APART, 0), (APART, 0)):
                v, u = i + di, j + dj
                if v < 0 or u < 0 or v >= rows or u >= columns:
                    continue
                of_plane = plane[0] * u + plane[1] * v + plane[2]
                if of_plane <= 0 or abs(inv_depth[v, u] - of_plane) >= PLANES.tolerance:
                    continue
                x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
                p = (across[0] * x + across[1] * y + across[2]) / of_plane
                q = (along[0] * x + along[1] * y + along[2]) / of_plane
                for k in range(DIRECTIONS):
                    support = COS[k] * p + SIN[k] * q + PLANES.margin_m
                    extent[k] = support if support > extent[k] else extent[k]
    return extent


def level_coordinates(grid: DepthGrid, mask: Bool, up: F8) -> F8:
    """Return samples as points (3, n) in the level frame of ``up``, metres.

    ``mask`` (rows, columns) is True at these samples.
    """
    i, j = np.nonzero(mask)
    z = 1 / grid.inverse_depth[i, j].astype(np.float64)
    k = grid.intrinsics
    points = np.stack([(j - k.cx) / k.fx * z, (i - k.cy) / k.fy * z, z])
    return np.asarray(gravity_rotation(up) @ points)


def outline_corners(up: F8, offset: float, extent: F8) -> F8:
    """Return the corners (DIRECTIONS, 3) of the convex outline in order, metres, sensor frame.

    The parameters are as in `SupportingPlane`.
    """
    # Neighbouring sides x cos + y sin = extent meet at a corner.
    along = (np.roll(extent, -1) - extent * COS[1]) / SIN[1]
    level = np.full((DIRECTIONS, 3), offset)
    level[:, 0] = extent * COS - along * SIN
    level[:, 1] = extent * SIN + along * COS
    return np.asarray(level @ gravity_rotation(up))
