"""Up estimation: the direction that the surfaces of the scene tell to be up."""

import math

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.ransac import (
    INLIER_TOLERANCE,
    cosine,
    horizontal_plane,
    plane_normal,
    refine,
    sample_grid,
)
from shapecat.geometry import DISCONTINUITY, cross
from shapecat.jit import kernel

__all__ = ["HELD", "estimate_up"]

ARM = 3
"""Cells to each side over which a surface is seen to be smooth."""
LEAST_SHARE, LEAST_FACETS = 0.04, 12
"""A direction that may be up is faced by this share of the surface, and so many facets."""
HINT_COS = math.cos(math.radians(15))
FACING_COS = math.cos(math.radians(20))
SAME_COS = math.cos(math.radians(12))
CORNER_COS = 0.3
TRIALS, BLOCK = 120, 512
"""Directions that are tried, and after how many facets it is asked if one can still win."""
MOST_DIRECTIONS = 4
HEIGHT_BINS, LEVEL_BIN_M = 80, 0.04
LEVELS_APART = 2
"""Bins between two levels."""
SEVERAL, CLEAR, ASLANT = 1.5, 2, 0.55
"""How much it counts that levels are several, by the power of their number; that what faces a
direction lies in them, by the power of the share; and that the camera looks at them aslant."""
HELD = 3.0
"""How much it counts against a direction that the camera would be rolled by the sine 1, or be
upside down: it is divided by one more."""
STEEP = 0.03
"""Squared sine of the angle to the line of sight below which a direction hardly tells a roll."""
HALF_M = 1.5
"""Distance at which a surface counts half."""


@kernel
def estimate_up(grid: DepthGrid, hint: F8, trials: F8, held: float) -> F8:
    """Return the normal of the dominant supporting plane, (3,) unit, or zeros if there is none.

    With a ``hint`` only planes within 15 degrees of being perpendicular to it count. Without, if
    it is zeros, the direction wins that faces most large levels: the normal of one of the largest
    planes, or the direction that two walls leave. What the camera looks at head-on counts less, so
    that the boards of a shelf beat its back; what is far counts less than what is near. That
    the camera is turned about its axis takes the more to be believed the larger ``held`` is:
    `HELD`, or 0 where nothing is known of it. ``trials`` are of `draw_trials`.
    """
    oriented_points = _orient_points(grid.inverse_depth, grid.intrinsics)
    least = max(LEAST_SHARE * oriented_points.shape[1], float(LEAST_FACETS))
    free = not np.any(hint)
    found = _directions(
        oriented_points[:3] if free else _facing(oriented_points, hint), least, trials
    )
    if len(found) == 0:
        return np.zeros(3)
    up: F8 = _dominant(
        grid.inverse_depth,
        grid.intrinsics,
        oriented_points,
        found,
        CORNER_COS if free else 0.0,
        held if free else 0.0,
    )
    return up


@kernel
def _directions(normals: F4, least: float, trials: F8) -> F8:
    """Return directions (n, 3) that many normals face, most first: RANSAC on one at a time."""
    found = np.zeros((MOST_DIRECTIONS, 3))
    for k in range(MOST_DIRECTIONS):
        if normals.shape[1] < least:
            return found[:k]
        inliers, normals = _most_faced(normals, trials, found[k])
        if inliers < least:
            return found[:k]
    return found


@kernel
def _facing(oriented_points: F4, hint: F8) -> F4:
    """Return the normals (3, n) of the facets that may be level."""
    chosen = np.zeros((3, oriented_points.shape[1]), np.float32)
    n = 0
    for k in range(oriented_points.shape[1]):
        x, y, z = oriented_points[0, k], oriented_points[1, k], oriented_points[2, k]
        chosen[0, n], chosen[1, n], chosen[2, n] = x, y, z
        n += x * hint[0] + y * hint[1] + z * hint[2] > HINT_COS
    return chosen[:, :n].copy()


@kernel
def _most_faced(normals: F4, trials: F8, best: F8) -> tuple[int, F4]:
    """Write the direction most normals (3, n) face; return how many do, and those that do not."""
    most = -1
    for draw in trials[:TRIALS, 0]:
        t = int(draw * normals.shape[1])
        inliers = _inliers_if_more(normals, t, most)
        if inliers > most:
            most = inliers
            best[0], best[1], best[2] = normals[0, t], normals[1, t], normals[2, t]
    for _ in range(3):
        most = _mean_near(normals, best)
    rest = np.zeros(normals.shape, np.float32)
    n = 0
    for k in range(normals.shape[1]):
        x, y, z = normals[0, k], normals[1, k], normals[2, k]
        rest[0, n], rest[1, n], rest[2, n] = x, y, z
        n += not (x * best[0] + y * best[1] + z * best[2] > FACING_COS)
    return most, rest[:, :n].copy()


@kernel(fast=True)
def _inliers_if_more(normals: F4, t: int, most: int) -> int:
    """Count the normals that face as normal ``t`` does, as long as there may be over ``most``."""
    xs, ys, zs = normals[0], normals[1], normals[2]  # unpacked they would not be contiguous
    x, y, z = xs[t], ys[t], zs[t]
    inliers = 0
    for start in range(0, xs.size, BLOCK):
        if inliers + xs.size - start <= most:
            break
        stop = start + BLOCK
        inliers += _count_facing(xs[start:stop], ys[start:stop], zs[start:stop], x, y, z)
    return inliers


@kernel(fast=True)
def _count_facing(xs: F4, ys: F4, zs: F4, x: float, y: float, z: float) -> int:
    least = np.float32(FACING_COS)
    inliers = np.int32(0)
    for k in range(xs.size):
        inliers += np.int32(xs[k] * x + ys[k] * y + zs[k] * z > least)
    return int(inliers)


@kernel(fast=True)
def _mean_near(normals: F4, direction: F8) -> int:
    """Turn a direction to the mean of the normals that face it; return how many these are."""
    xs, ys, zs = normals[0], normals[1], normals[2]
    x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
    least = np.float32(FACING_COS)
    sx = sy = sz = np.float64(0)
    inliers = np.int32(0)
    for k in range(xs.size):
        near = xs[k] * x + ys[k] * y + zs[k] * z > least
        inliers += np.int32(near)
        sx += xs[k] if near else np.float32(0)
        sy += ys[k] if near else np.float32(0)
        sz += zs[k] if near else np.float32(0)
    norm = math.sqrt(sx * sx + sy * sy + sz * sz)
    direction[0], direction[1], direction[2] = sx / norm, sy / norm, sz / norm
    return int(inliers)


@kernel
def _dominant(
    inv_depth: F4,
    intrinsics: PinholeIntrinsics,
    oriented_points: F4,
    found: F8,
    corner_cos: float,
    held: float,
) -> F8:
    """Return the exact normal of the largest plane that faces the best direction, (3,).

    Parameters
    ----------
    found : (n, 3) directions that surfaces face, at least one.
    corner_cos : two of them with a smaller cosine may be walls; 0 for none.
    held : `HELD`; 0 where nothing is known of how the camera is held.
    """
    total = 0.0
    for k in range(oriented_points.shape[1]):
        total += oriented_points[6, k]
    least = total * max(LEAST_SHARE, LEAST_FACETS / oriented_points.shape[1])
    best, most = found[0], -1.0
    for k in range(len(found)):
        merit = _merit(oriented_points, found[k], least, held)
        if merit > most:
            best, most = found[k], merit
    for k in range(len(found)):
        for m in range(k):
            if abs(cosine(found[k], found[m])) >= corner_cos:
                continue
            # Two walls leave one direction, up or down.
            corner = cross(found[k], found[m])
            corner /= math.sqrt(cosine(corner, corner))
            for direction in (corner, -corner):
                merit = _merit(oriented_points, direction, least, held)
                if merit > most:
                    best, most = direction, merit
    up: F8 = _settled(inv_depth, intrinsics, oriented_points, best)
    return up


@kernel
def _merit(oriented_points: F4, direction: F8, least: float, held: float) -> float:
    """Return how well a direction explains the surface: what of it lies in large levels."""
    count = _count_levels(oriented_points, direction)
    level, squares = _large_levels(count, least)
    if level == 0:
        return 0.0
    # The boards of a shelf are several, its back is one; what stands before a wall makes it several
    # as well, but these are unlike in size, and much of what faces as it does lies in none.
    levels, clear = level**2 / squares, level / np.sum(count)
    # A camera that looks down at a board sees it aslant, and rather the wall behind it head-on.
    aslant = 1 - ASLANT * direction[2] ** 2
    across, down = direction[0] ** 2, max(direction[1], 0.0) ** 2
    turned = (across + down) / (across + direction[1] ** 2 + STEEP)
    return float(level * levels**SEVERAL * clear**CLEAR * aslant / (1 + held * turned))


@kernel
def _large_levels(count: F8, least: float) -> tuple[float, float]:
    """Return how many facets lie in levels of more than ``least``, and the sum of their squares.

    A level fills two bins and stands out from the next ones: a slanted surface has many heights.
    """
    oriented_points = squares = 0.0
    last = count.size - 1
    for k in range(last):
        here = count[k] + count[k + 1]
        stands_out = here > least
        for m in range(max(0, k - LEVELS_APART), min(last, k + LEVELS_APART + 1)):
            there = count[m] + count[m + 1]
            stands_out &= here > there if m < k else here >= there
        if stands_out:
            oriented_points += here
            squares += here * here
    return oriented_points, squares


@kernel
def _count_levels(oriented_points: F4, direction: F8) -> F8:
    """Weigh the facets that face a direction by their height below the sensor."""
    x, y, z = direction
    count = np.zeros(HEIGHT_BINS + 1, np.float64)  # the last for what is out of bounds
    nx, ny, nz, px, py, pz = (
        oriented_points[0],
        oriented_points[1],
        oriented_points[2],
        oriented_points[3],
        oriented_points[4],
        oriented_points[5],
    )
    level = np.zeros(nx.size, np.int32)
    for k in range(nx.size):
        faces = nx[k] * x + ny[k] * y + nz[k] * z > FACING_COS
        below = math.floor(-(px[k] * x + py[k] * y + pz[k] * z) / LEVEL_BIN_M)
        level[k] = below if faces & (below >= 0) & (below < HEIGHT_BINS) else HEIGHT_BINS
    for k in range(nx.size):
        count[level[k]] += oriented_points[6, k]
    return count[:-1]


@kernel
def _settled(
    inv_depth: F4, intrinsics: PinholeIntrinsics, oriented_points: F4, direction: F8
) -> F8:
    """Return the exact normal of the largest plane that faces ``direction``."""
    fullest = np.argmax(_count_levels(oriented_points, direction))
    plane = horizontal_plane(intrinsics, direction, -(fullest + 0.5) * LEVEL_BIN_M)
    samples = sample_grid(inv_depth, inv_depth)
    for tolerance in (4, 3, 2, 1, 1):
        refine(samples.j, samples.i, samples.inverse_depth, tolerance * INLIER_TOLERANCE, plane)
    normal = plane_normal(plane, intrinsics)
    return normal if cosine(normal, direction) > SAME_COS else direction.copy()


@kernel
def _orient_points(inv_depth: F4, intrinsics: PinholeIntrinsics) -> F4:
    """Return normals, positions and weights (7, n) of every fourth cell on a smooth surface."""
    rows, columns = inv_depth.shape
    oriented_points = np.zeros((7, (rows // 4 + 1) * (columns // 4 + 1)), np.float32)
    bend, two = np.float32(2 * DISCONTINUITY), np.float32(2)
    n = 0
    for i in range(ARM, rows - ARM, 4):
        y = (i - intrinsics.cy) / intrinsics.fy
        for j in range(ARM, columns - ARM, 4):
            center = inv_depth[i, j]
            left, right, top, bottom = (
                inv_depth[i, j - ARM],
                inv_depth[i, j + ARM],
                inv_depth[i - ARM, j],
                inv_depth[i + ARM, j],
            )
            smooth = (center > 0) & (left > 0) & (right > 0) & (top > 0) & (bottom > 0)
            smooth &= abs(left + right - two * center) <= bend
            smooth &= abs(top + bottom - two * center) <= bend
            if not smooth:
                continue
            x, z = (j - intrinsics.cx) / intrinsics.fx, 1 / float(center)
            nx, ny = (
                intrinsics.fx / (2 * ARM) * (left - right),
                intrinsics.fy / (2 * ARM) * (top - bottom),
            )
            nz = -nx * x - ny * y - center
            scale = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
            oriented_points[0, n], oriented_points[1, n], oriented_points[2, n] = (
                scale * nx,
                scale * ny,
                scale * nz,
            )
            oriented_points[3, n], oriented_points[4, n], oriented_points[5, n] = x * z, y * z, z
            oriented_points[6, n] = 1 / (1 + (z / HALF_M) ** 2)
            n += 1
    return oriented_points[:, :n].copy()
