"""Supporting planes: tables and boards, distinguished from the tops of objects."""

import math

import numpy as np

from shapecat.arrays import F4
from shapecat.detection.connected_components import DOWN, RIGHT, connected_components
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics, back_project, project
from shapecat.detection.planes.extent import (
    COS,
    DIRECTIONS,
    SIN,
    PlaneCandidate,
    SupportingPlane,
    level_coordinates,
)
from shapecat.detection.planes.height_map import min_height_at
from shapecat.detection.planes.plane_fit import DepthSamples
from shapecat.detection.planes.settings import PLANES
from shapecat.geometry import NEAREST_M, level_axes
from shapecat.jit import kernel, unset

__all__ = ["supporting_planes"]

STEPS_TO_EDGE = 5
"""Maximum number of steps from a sample, towards the camera, to the edge of its plane."""
STEPS_DOWN = 20
"""Maximum number of steps down from the edge of a plane."""
EDGE_CELLS = 2
"""Number of cells over which an edge is blurred."""
MIN_EVIDENCE = 20
"""Minimum number of samples below an edge, or around a plane, to decide what is there."""
COUNT_STRIDE = 2
"""Step between the rows and columns of the samples that show whether something is on a plane."""
MIN_ABOVE = 20 // COUNT_STRIDE**2
"""Minimum number of counted samples above a plane that show something on it; a small object has
more."""


def supporting_planes(
    grid: DepthGrid, candidates: list[PlaneCandidate], max_height_m: float
) -> list[SupportingPlane]:
    """Return the planes that are not the tops of objects, lowest first.

    Planes are tested from the lowest up; the height of a plane is measured from the highest kept
    plane under its middle. The first rule that applies decides:

    1. Drop a plane less than 6 cm high.
    2. Keep the lowest plane, or one higher than the tallest object.
    3. Keep a plane of less than 0.25 m2 around which the surface rises, as around the floor of a
       bin, and extend it to the walls.
    4. Drop a plane of less than 0.03 m2.
    5. Keep a plane with no other below it.
    6. Drop a plane with a wall below its front edge, as below the top of a box; but keep one of at
       least 0.25 m2 with something on it. With nothing on it, such a plane consists of the tops of
       boxes with narrow gaps between them.
    7. Keep any other plane of at least 0.25 m2.
    8. If little is visible below its front edge, drop a plane of less than 0.1 m2, or one right
       below the camera with nothing on it, such as the top of a carton.
    9. Keep all others.

    The area of a plane above another is that of its largest connected part, since the tops of equal
    boxes form a plane of many small parts.

    Parameters
    ----------
    candidates : planes, lowest first; their covered area counts as visible.
    max_height_m : height of the tallest object, metres.
    """
    supports: list[SupportingPlane] = []
    for plane, inliers, covered_m2 in candidates:
        area_m2 = plane.area_m2 + covered_m2
        drops = [
            plane.offset - lower.offset for lower in supports if _contains_centre(lower, plane)
        ]
        drop = drops[-1] if drops else math.inf
        high = max_height_m < drop < math.inf
        if drop < PLANES.min_drop_m:
            continue
        if supports and not high and area_m2 >= PLANES.board_m2:
            area_m2 = _largest_part(grid, inliers, plane) + covered_m2
        if supports and not high and area_m2 < PLANES.furniture_m2:
            if _is_enclosed(grid, inliers, plane):
                supports.append(_extend_to_walls(grid, plane))
                continue
            if area_m2 < PLANES.board_m2:
                continue
        if drop > max_height_m or not _is_top(grid, inliers, plane, drop, area_m2):
            supports.append(plane)
    return supports


def _is_top(
    grid: DepthGrid, inliers: DepthSamples, plane: SupportingPlane, drop: float, area_m2: float
) -> bool:
    """Return whether a plane is the top of one or more objects: rules 6 to 9.

    ``inliers`` are the samples of the plane, ``drop`` is its height above the next plane below,
    metres, and ``area_m2`` counts the covered area too.
    """
    furniture = area_m2 >= PLANES.furniture_m2
    on_wall, beyond = _count_below_edge(grid, inliers, plane, drop)
    if on_wall + beyond >= MIN_EVIDENCE:
        walled = on_wall > PLANES.wall_share * (on_wall + beyond)
        return walled and not (furniture and _count_above(grid, plane)[0] >= MIN_ABOVE)
    below_camera = plane.extent.min() > 0  # the camera cannot see the sides of the object
    if furniture or area_m2 < PLANES.likely_m2 or not below_camera:
        return area_m2 < PLANES.likely_m2
    above, inside = _count_above(grid, plane)
    return bool(above < PLANES.bare_share * inside)


def _contains_centre(lower: SupportingPlane, upper: SupportingPlane) -> bool:
    """Return whether the middle (Steiner point) of ``upper`` is over the inside of ``lower``."""
    x, y = upper.extent @ COS * 2 / DIRECTIONS, upper.extent @ SIN * 2 / DIRECTIONS
    return bool(np.all(COS * x + SIN * y < lower.extent))


def _extend_to_walls(grid: DepthGrid, plane: SupportingPlane) -> SupportingPlane:
    """Extend the floor of a bin to the walls, since objects hide parts of it.

    The extent grows to the samples up to 0.4 m above the floor and within 0.2 m of its visible
    part.
    """
    across, along, height = level_coordinates(grid, grid.inverse_depth > 0, plane.up)
    above = height - plane.offset
    near = np.flatnonzero((above > PLANES.margin_m) & (above < PLANES.max_object_m))
    for k in range(DIRECTIONS):
        side = COS[k] * across[near] + SIN[k] * along[near]
        near = near[side < plane.extent[k] + PLANES.hidden_m]
    sides = COS[:, None] * across[near] + SIN[:, None] * along[near]
    extent = sides.max(axis=1, initial=-np.inf)
    return plane._replace(extent=np.maximum(plane.extent, extent))


@kernel
def _count_above(grid: DepthGrid, plane: SupportingPlane) -> tuple[int, int]:
    """Count the samples of objects inside the outline of a plane, and all samples inside it.

    Samples of objects are more than twice the minimum height, and less than
    `PlaneSettings.max_object_m`, above the plane. Only samples of every second row and column are
    counted.
    """
    inv_depth, up, k = grid.inverse_depth, plane.up, grid.intrinsics
    across, along, _ = level_axes(up[0], up[1], up[2])
    above = inside = 0
    for i in range(0, inv_depth.shape[0], COUNT_STRIDE):
        y = (i - k.cy) / k.fy
        for j in range(0, inv_depth.shape[1], COUNT_STRIDE):
            w = inv_depth[i, j]
            if w <= 0:
                continue
            x = (j - k.cx) / k.fx
            p = (across[0] * x + across[1] * y + across[2]) / w
            q = (along[0] * x + along[1] * y + along[2]) / w
            d = 0
            while d < DIRECTIONS and COS[d] * p + SIN[d] * q < plane.extent[d]:
                d += 1
            if d == DIRECTIONS:
                rise = (up[0] * x + up[1] * y + up[2]) / w - plane.offset
                inside += 1
                above += 2 * min_height_at(1 / w) < rise < PLANES.max_object_m
    return above, inside


@kernel
def _largest_part(grid: DepthGrid, inliers: DepthSamples, plane: SupportingPlane) -> float:
    """Return the area of the largest connected part of a plane, m², from its ``inliers``.

    Objects on a plane hide parts of it, so nearer surface and missing depth connect parts. Farther
    surface, which is seen past an edge, separates them.
    """
    inv_depth = grid.inverse_depth
    rows, columns = inv_depth.shape
    connects = np.zeros(inv_depth.shape, np.bool_)
    for i in range(rows):
        for j in range(columns):
            level, value = plane.a * j + plane.b * i + plane.c, inv_depth[i, j]
            farthest = level - PLANES.tolerance
            connects[i, j] = (level > 0) & ((value <= 0) | (value > farthest))
    links, part = np.full(inv_depth.shape, RIGHT | DOWN, np.uint8), unset(inv_depth.shape, np.int32)
    spans = np.zeros((rows, 2), np.int32)
    spans[:, 1] = columns
    areas = np.zeros(connected_components(connects, links, spans, part).size)
    for k in range(inliers.inverse_depth.size):
        i, j = int(inliers.i[k]), int(inliers.j[k])
        level = plane.a * j + plane.b * i + plane.c
        facing = max(-level * plane.offset, 0.05)
        areas[part[i, j]] += inliers.cells_per_sample / (level * level * facing)
    return float(areas.max() / (grid.intrinsics.fx * grid.intrinsics.fy))


@kernel
def _is_enclosed(grid: DepthGrid, inliers: DepthSamples, plane: SupportingPlane) -> bool:
    """Return whether the surface rises around a plane, as the walls do around the floor of a bin.

    Around the top of an object the surface drops.
    """
    inv_depth = grid.inverse_depth
    rises = drops = 0
    for k in range(inliers.inverse_depth.size):
        i, j = int(inliers.i[k]), int(inliers.j[k])
        level = plane.a * j + plane.b * i + plane.c
        radius = max(2, int(PLANES.around_m * grid.intrinsics.fx * level))
        for di, dj in ((-radius, 0), (radius, 0), (0, -radius), (0, radius)):
            v, u = i + di, j + dj
            if 0 <= v < inv_depth.shape[0] and 0 <= u < inv_depth.shape[1] and inv_depth[v, u] > 0:
                ahead = inv_depth[v, u] - (plane.a * u + plane.b * v + plane.c)
                rises += ahead > 2 * PLANES.tolerance
                drops += ahead < -2 * PLANES.tolerance
    return rises >= MIN_EVIDENCE and drops < PLANES.drop_ratio * rises


@kernel
def _count_below_edge(
    grid: DepthGrid, inliers: DepthSamples, plane: SupportingPlane, drop: float
) -> tuple[int, int]:
    """Count the points below the front edge of a plane that are on a wall, and those in free space.

    The points begin just below the edge in front of each of the ``inliers``, which are the samples
    of the plane, and go down by at most ``drop``, its height above the next plane below, metres.
    """
    on_wall = beyond = 0
    for k in range(inliers.inverse_depth.size):
        i, j = inliers.i[k], inliers.j[k]
        level = plane.a * j + plane.b * i + plane.c
        x, y, z = _front_edge(grid, plane, i, j, 1 / level)
        if z == 0:
            continue
        first = max(4, _blurred_steps(grid.intrinsics.fx, plane, x, y, z))  # an edge is rounded
        for step in range(first, min(STEPS_DOWN, int(drop / PLANES.step_m))):
            s = PLANES.step_m * step
            dx, dy, dz = x - s * plane.up[0], y - s * plane.up[1], z - s * plane.up[2]
            inv_depth = _inverse_depth_at(grid.inverse_depth, grid.intrinsics, dx, dy, dz)
            if inv_depth < 0:
                break
            if inv_depth > 0:
                behind = 1 / inv_depth - dz
                on_wall += abs(behind) < PLANES.wall_m
                beyond += behind >= PLANES.wall_m
    return on_wall, beyond


@kernel(inline=True)
def _blurred_steps(fx: float, plane: SupportingPlane, x: float, y: float, z: float) -> int:
    """Return the number of steps below an edge that are hidden in its blur.

    ``x``, ``y``, ``z`` are a point of the edge, metres, sensor frame; ``fx`` is in cells. The more
    the side below an edge is seen from above, the fewer cells it covers.
    """
    up, distance2 = plane.up, x * x + y * y + z * z
    height = x * up[0] + y * up[1] + z * up[2]
    horizontal = math.sqrt(max(distance2 - height * height, PLANES.step_m**2))
    return int(EDGE_CELLS * distance2 / (fx * horizontal * PLANES.step_m)) + 1


@kernel(inline=True)
def _front_edge(
    grid: DepthGrid, plane: SupportingPlane, i: float, j: float, z: float
) -> tuple[float, float, float]:
    """Follow a plane towards the camera; return its edge, metres, or zeros if none is found.

    The start is cell (i, j) at depth ``z``, metres; the edge is x, y, z in the sensor frame.
    """
    k, up = grid.intrinsics, plane.up
    x, y = back_project(k, i, j, z)
    h = x * up[0] + y * up[1] + z * up[2]
    tx, ty, tz = h * up[0] - x, h * up[1] - y, h * up[2] - z
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    step = PLANES.step_m / max(length, PLANES.step_m)
    edge = x, y, z
    for _ in range(STEPS_TO_EDGE):
        x, y, z = x + step * tx, y + step * ty, z + step * tz
        inv_depth = _inverse_depth_at(grid.inverse_depth, k, x, y, z)
        ahead = inv_depth - 1 / z
        if inv_depth > 0 and ahead < -2 * PLANES.tolerance:
            return edge
        if inv_depth <= 0 or ahead > 2 * PLANES.tolerance:  # no depth, or an object on the plane
            break
        if ahead > -PLANES.tolerance:  # not yet the side of a box, just below its top
            edge = x, y, z
    return 0.0, 0.0, 0.0


@kernel(inner=True)
def _inverse_depth_at(
    inv_depth: F4, intrinsics: PinholeIntrinsics, x: float, y: float, z: float
) -> float:
    """Return the inverse depth of the cell that shows a point, 1/m.

    It is 0 where depth is missing, and -1 outside the image or too near the sensor. ``inv_depth``
    is (rows, columns); ``x``, ``y``, ``z`` are the point, metres, sensor frame.
    """
    if z <= NEAREST_M:
        return -1.0
    v, u = project(intrinsics, x, y, z)
    if v < 0 or u < 0 or v >= inv_depth.shape[0] or u >= inv_depth.shape[1]:
        return -1.0
    return float(inv_depth[v, u])
