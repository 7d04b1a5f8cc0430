"""Virtual camera: the image that a depth camera would take of an unorganized point cloud."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import CELL_M, DepthGrid, PinholeIntrinsics, discontinuity_at
from shapecat.detection.planes.settings import UP
from shapecat.geometry import NEAREST_M, gravity_rotation
from shapecat.jit import kernel
from shapecat.types import Pose

__all__ = ["VirtualImage", "top_view", "virtual_image"]

WIDEST_SLOPE = 1.5
"""Largest slope x / z or y / z of a point in view."""
OUTSIDE = 9.0
"""Placeholder for the slope x / z of a point that is not in view."""
MAX_CELLS = 400_000
"""Approximate upper bound of the number of cells, which bounds the time per frame."""
MAX_ROWS = 2000
"""Approximate upper bound of the number of rows, and of columns."""
MIN_POINTS = 100
"""Minimum number of points in view; there is no image of fewer."""
POINTS_PER_CELL = 1.8
"""Minimum number of points per occupied cell, on average; with fewer, surfaces have holes."""


class VirtualImage(NamedTuple):
    """A point cloud as a virtual camera sees it.

    Attributes
    ----------
    grid : the depth grid of the nearest points.
    points : (n, 3) float32 metres, in the frame of the virtual camera; 0 for points out of view.
    cell : (n,) int32 flat index of each point's cell; -1 for points out of view.
    view_from_sensor : pose of the sensor in the frame of the virtual camera.
    crowded : fraction of the points in view that lie well behind another point in their cell.
    """

    grid: DepthGrid
    points: F4
    cell: I4
    view_from_sensor: Pose
    crowded: float


def virtual_image(points: F4, *, range_m: float, origin: F8 | None = None) -> VirtualImage | None:
    """Return the image of a point cloud; None if the points are too few or surround the viewpoint.

    The optical axis points to the middle of the cloud. Cells are as wide as the spacing of the
    points, but no narrower than those of depth images.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame; rows that are not finite are ignored.
    range_m : points at a greater depth in the image are ignored, metres.
    origin : (3,) the viewpoint, metres, sensor frame; by default the sensor.
    """
    origin = np.zeros(3) if origin is None else origin
    axis, n = _sum_of_directions(points, origin, range_m)
    if n < MIN_POINTS or np.linalg.norm(axis) < 0.3 * n:  # few, or all around the viewpoint
        return None
    rotation = _rotation_to(axis)
    pose = Pose(rotation, -rotation @ origin)
    in_view = np.zeros((len(points), 3), np.float32)
    slopes = np.zeros((len(points), 2), np.float32)
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    n = _to_view(points, pose.rotation, pose.translation, range_m, in_view, slopes, bounds)
    return _render(in_view, slopes, bounds, n, pose) if n >= MIN_POINTS else None


def top_view(
    points: F4, hint: F8 | None, *, range_m: float, rng: np.random.Generator
) -> VirtualImage | None:
    """Return the image of a point cloud from above its dominant plane.

    This is for clouds that were not taken from their origin. The dominant plane is the one with the
    most points within 1 cm, of 200 planes through three random points each. Its upper side is the
    side with more points. The viewpoint is 1 m from the middle of the cloud, in a direction 45
    degrees above the plane.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame; rows that are not finite are ignored.
    hint : (3,) the up direction, sensor frame, or None if unknown. If given, only planes with a
        normal within 15 degrees of it are considered, and it determines their upper side.
    range_m : points farther from the sensor are ignored, metres.
    rng : source of the random points.

    Returns
    -------
    The image; None if no plane is found, or for the reasons of `virtual_image`.
    """
    in_range: Bool = np.asarray((np.abs(points) <= range_m).all(axis=1))  # False for NaN
    in_range[in_range] = np.linalg.norm(points[in_range], axis=1) <= range_m
    valid = points[in_range]
    if len(valid) < MIN_POINTS:
        return None
    sample = valid[rng.choice(len(valid), min(len(valid), 4000), replace=False)].astype(np.float64)
    up = _dominant_plane(sample, hint, rng)
    if up is None:
        return None
    middle = np.median(sample, axis=0)
    side = gravity_rotation(up)[1]
    origin = middle + math.sqrt(0.5) * (up - side)
    cropped = np.where(in_range[:, None], points, np.float32(np.nan))
    return virtual_image(cropped, range_m=max(range_m, 2.0), origin=origin)


def _dominant_plane(sample: F8, hint: F8 | None, rng: np.random.Generator) -> F8 | None:
    """Return the upward normal (3,) of the plane with the most inliers, by RANSAC.

    Return None if there is no plane. ``sample`` (n, 3) are points, metres; `top_view` explains
    ``hint`` and which side of a plane is its upper side.
    """
    a, b, c = sample[rng.integers(0, len(sample), (3, 200))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 1e-9] / length[length > 1e-9, None]
    a = a[length > 1e-9]
    if hint is not None:
        level = abs(normal @ hint) > UP.hint_cos
        normal, a = normal[level], a[level]
    if len(normal) == 0:
        return None
    height = sample @ normal.T - np.einsum("ij,ij->i", a, normal)
    best = int(np.argmax(np.count_nonzero(abs(height) < 0.01, axis=0)))
    up: F8 = normal[best]
    above = height[:, best]
    more_above = np.count_nonzero(above > 0.01) - np.count_nonzero(above < -0.01)
    return -up if (more_above if hint is None else up @ hint) < 0 else up


@kernel
def _sum_of_directions(points: F4, origin: F8, range_m: float) -> tuple[F8, int]:
    """Return the sum (3,) of the unit vectors from ``origin`` to points, and their number.

    Points nearer than `NEAREST_M`, or farther away than twice ``range_m``, are left out. ``origin``
    (3,), ``points`` (n, 3) and ``range_m`` are in metres.
    """
    ax = ay = az = 0.0
    n = 0
    for k in range(points.shape[0]):
        x, y, z = points[k, 0] - origin[0], points[k, 1] - origin[1], points[k, 2] - origin[2]
        distance = math.sqrt(x * x + y * y + z * z)
        if (distance >= NEAREST_M) & (distance <= 2 * range_m):  # False for NaN
            scale = 1 / distance
            ax += x * scale
            ay += y * scale
            az += z * scale
            n += 1
    return np.array([ax, ay, az]), n


@kernel
def _to_view(
    points: F4, rotation: F8, translation: F8, range_m: float, in_view: F4, slopes: F4, bounds: F8
) -> int:
    """Transform the points in view to the frame of the virtual camera; return their number.

    Writes the points to ``in_view`` (n, 3), their slopes x / z and y / z to ``slopes`` (n, 2), and
    the smallest and largest slopes to ``bounds`` (4,): left, top, right, bottom. Points out of
    view, or deeper than ``range_m``, metres, get `OUTSIDE` as x / z. ``rotation`` (3, 3) and
    ``translation`` (3,) map ``points`` (n, 3) to the frame of the virtual camera.
    """
    r, s = rotation, translation
    n = 0
    left = top = np.inf
    right = bottom = -np.inf
    for k in range(points.shape[0]):
        slopes[k, 0] = OUTSIDE
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + s[2]
        if not ((depth >= NEAREST_M) & (depth <= range_m)):
            continue
        across = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + s[0]
        down = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + s[1]
        inverse = 1 / depth
        u, v = across * inverse, down * inverse
        if not ((abs(u) < WIDEST_SLOPE) & (abs(v) < WIDEST_SLOPE)):
            continue
        in_view[k, 0], in_view[k, 1], in_view[k, 2] = across, down, depth
        slopes[k, 0], slopes[k, 1] = u, v
        left, right = min(left, u), max(right, u)
        top, bottom = min(top, v), max(bottom, v)
        n += 1
    bounds[0], bounds[1], bounds[2], bounds[3] = left, top, right, bottom
    return n


def _rotation_to(axis: F8) -> F8:
    """Return a rotation (3, 3) that turns ``axis`` to +z.

    The new +x is close to the old +x or, if ``axis`` is close to the x axis, to the old -y.
    """
    z = axis / np.linalg.norm(axis)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.8 else np.array([0.0, -1.0, 0.0])
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _render(in_view: F4, slopes: F4, bounds: F8, n: int, pose: Pose) -> VirtualImage:
    """Return the image of points; ``pose`` is its ``view_from_sensor``.

    ``in_view``, ``slopes`` and ``bounds`` are from `_to_view`; ``n`` is the number of points in
    view.
    """
    left, top, right, bottom = (float(v) for v in bounds)
    width, height = right - left, bottom - top
    z = in_view[:: max(1, n // 20_000), 2]
    depth = float(np.median(z[z > 0])) if (z > 0).any() else 1.0
    pitch = max(
        CELL_M / depth,
        _spacing(slopes, bounds, n),
        math.sqrt(width * height / MAX_CELLS),
        max(width, height) / MAX_ROWS,
        1e-6,
    )
    intrinsics = PinholeIntrinsics(1 / pitch, 1 / pitch, -left / pitch, -top / pitch)
    inv_depth = np.zeros((int(height / pitch + 1.5), int(width / pitch + 1.5)), np.float32)
    cell = np.full(len(in_view), -1, np.int32)
    jump = discontinuity_at(depth)
    behind = _project(in_view, slopes, intrinsics, jump, inv_depth, cell)
    _close_holes(inv_depth, jump)
    grid = DepthGrid(inv_depth, intrinsics, 1, jump)
    return VirtualImage(grid, in_view, cell, pose, behind / n)


def _spacing(slopes: F4, bounds: F8, n: int) -> float:
    """Return the cell width, in slope, at which nearly every cell of a surface has a point.

    In a fine grid every point has a cell of its own. Coarser grids are tried until an occupied cell
    holds `POINTS_PER_CELL` points on average. The parameters are as in `_render`.
    """
    span = max(bounds[2] - bounds[0], bounds[3] - bounds[1], 1e-6)
    side = 1024
    left, top, *_ = bounds
    while side > 16:
        occupied = _count_occupied(slopes, left, top, side / span * 0.999, side)
        if n >= POINTS_PER_CELL * occupied:
            break
        side = int(side / 1.25)
    return float(span / side)


@kernel
def _count_occupied(slopes: F4, left: float, top: float, scale: float, side: int) -> int:
    """Count the cells of a grid of ``side`` rows and columns that have a point.

    The grid begins at the slopes ``left`` and ``top``, with ``scale`` cells per unit of slope;
    ``slopes`` (n, 2) are from `_to_view`.
    """
    occupied = np.zeros((side, side), np.uint8)
    n = 0
    for k in range(slopes.shape[0]):
        if slopes[k, 0] < OUTSIDE:
            # Single precision may round a slope beyond its bounds, where these are close together.
            j = min(max(int((slopes[k, 0] - left) * scale), 0), side - 1)
            i = min(max(int((slopes[k, 1] - top) * scale), 0), side - 1)
            n += 1 - occupied[i, j]
            occupied[i, j] = 1
    return n


@kernel
def _project(
    points: F4, slopes: F4, intrinsics: PinholeIntrinsics, jump: float, inv_depth: F4, cell: I4
) -> int:
    """Average the inverse depth of each cell's nearest points; count the points well behind them.

    Writes to ``inv_depth`` (rows, columns), zeros on entry, and the flat index of the cell of each
    point to ``cell`` (n,), -1 on entry; returns the count. ``points`` (n, 3) and ``slopes`` (n, 2)
    are from `_to_view`. ``jump`` is the step in inverse depth that separates two surfaces, 1/m.
    """
    rows, columns = inv_depth.shape
    nearest = np.zeros(inv_depth.shape, np.float32)
    count = np.zeros(inv_depth.shape, np.float32)
    for k in range(points.shape[0]):
        if slopes[k, 0] == OUTSIDE:
            continue
        j = int(intrinsics.fx * slopes[k, 0] + intrinsics.cx + 0.5)
        i = int(intrinsics.fy * slopes[k, 1] + intrinsics.cy + 0.5)
        if i < 0 or j < 0 or i >= rows or j >= columns:
            continue
        cell[k] = i * columns + j
        nearest[i, j] = max(nearest[i, j], np.float32(1) / points[k, 2])
    behind = 0
    for k in range(points.shape[0]):
        if cell[k] < 0:
            continue
        i, j = cell[k] // columns, cell[k] % columns
        v = np.float32(1) / points[k, 2]
        if v > nearest[i, j] - jump:
            inv_depth[i, j] += v
            count[i, j] += 1
        elif v < nearest[i, j] - 3 * jump:
            behind += 1
    for i in range(rows):
        for j in range(columns):
            if count[i, j] > 0:
                inv_depth[i, j] /= count[i, j]
    return behind


@kernel
def _close_holes(inv_depth: F4, jump: float) -> None:
    """Set each empty cell between two opposite neighbours on one surface to their mean.

    Two neighbours are on one surface if they differ by less than ``jump``, 1/m. ``inv_depth``
    (rows, columns) is changed in place.
    """
    rows, columns = inv_depth.shape
    source = inv_depth.copy()
    for i in range(1, rows - 1):
        for j in range(1, columns - 1):
            if source[i, j] > 0:
                continue
            total, n = np.float32(0), 0
            for di, dj in ((0, 1), (1, 0)):
                a, b = source[i - di, j - dj], source[i + di, j + dj]
                if (a > 0) & (b > 0) & (abs(a - b) < jump):
                    total += a + b
                    n += 2
            if n > 0:
                inv_depth[i, j] = total / n
