"""Up estimation: the up direction from the surfaces of the scene."""

import math

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import PinholeIntrinsics
from shapecat.detection.planes.oriented_points import STRIDE, OrientedPoints, level_samples
from shapecat.detection.planes.plane_fit import dot, horizontal_plane, plane_normal, refine
from shapecat.detection.planes.settings import PLANES, UP
from shapecat.geometry import cross
from shapecat.jit import kernel

__all__ = ["estimate_up"]

MAX_DIRECTIONS = 4
"""Maximum number of directions to find: level surface and the walls of a corner make three."""
NORMALS_PER_BLOCK = 512
"""Number of normals after which a direction that can no longer win is dropped."""
GRAZING_COS = 0.1
"""Lower bound of the cosine between a normal and a ray in the computation of a point's area. At
more grazing angles, noise would determine the area."""


@kernel
def estimate_up(
    points: OrientedPoints, intrinsics: PinholeIntrinsics, hint: F8, trials: F8, roll_penalty: float
) -> F8:
    """Return the unit normal (3,) of the dominant supporting plane; zeros if there is none.

    Without a hint, the candidates are the normals of the largest planes and the directions
    perpendicular to two walls. The candidate with the most surface in large levels wins; a level is
    a peak in the histogram of heights along the candidate. Distant surface has less weight. The
    score is lower if the levels are much smaller than a table, or if the candidate points along the
    line of sight, so that the boards of a shelf beat its back.

    Parameters
    ----------
    hint : (3,) unit vector, sensor frame: only normals within 15 degrees of it are considered.
        Zeros if up is unknown.
    trials : (n, 3) random numbers from `draw_trials`.
    roll_penalty : penalty on directions that imply a camera on its side or upside down:
        `UpSettings.roll_penalty`, or 0 if the camera may be held in any way.
    """
    surface = _every_second(points, intrinsics)
    normals, min_count = surface[:3], UP.min_share * surface.shape[1]
    has_hint = hint[0] != 0 or hint[1] != 0 or hint[2] != 0
    if has_hint:
        normals = _select(normals, hint, (UP.hint_cos, 2.0))
    directions = _directions(normals, min_count, trials)
    if len(directions) == 0:
        return np.zeros(3)
    hypotheses = _hypotheses(directions, 0.0 if has_hint else UP.corner_cos)
    bins = _bins_of(surface)
    best, best_score = 0, -1.0
    for k in range(len(hypotheses)):
        score = _score(surface, hypotheses[k], bins, 0.0 if has_hint else roll_penalty)
        best, best_score = (k, score) if score > best_score else (best, best_score)
    up: F8 = _refined(points, surface, intrinsics, hypotheses[best], bins)
    return up


@kernel(inline=True)
def _every_second(points: OrientedPoints, intrinsics: PinholeIntrinsics) -> F4:
    """Return the normal, position, weight and area (8, n), in this order, of every second point.

    Half of the points are enough, and faster. Points without a normal are left out. Positions are
    in metres, areas in m2.
    """
    normals, positions = points.normals, points.positions
    surface = np.zeros((8, normals.shape[1] // 2 + 1), np.float32)
    cell = 2 * STRIDE * STRIDE / (intrinsics.fx * intrinsics.fy)
    n = 0
    for k in range(0, normals.shape[1], 2):
        for d in range(3):
            surface[d, n], surface[3 + d, n] = normals[d, k], positions[d, k]
        surface[6, n] = 1 / (1 + (positions[2, k] / UP.half_weight_m) ** 2)
        x, y, z = positions[0, k], positions[1, k], positions[2, k]
        distance = -(normals[0, k] * x + normals[1, k] * y + normals[2, k] * z)  # of the plane
        surface[7, n] = cell * z**3 / max(distance, GRAZING_COS * z, 1e-9)
        n += normals[2, k] != 0
    return surface[:, :n].copy()


@kernel(inline=True)
def _bins_of(surface: F4) -> int:
    """Return the number of bins of `UpSettings.level_bin_m` up to the farthest point.

    ``surface`` (8, n) is from `_every_second`.
    """
    farthest2 = 0.0
    for k in range(surface.shape[1]):
        x, y, z = surface[3, k], surface[4, k], surface[5, k]
        farthest2 = max(farthest2, x * x + y * y + z * z)
    return int(math.sqrt(farthest2) / UP.level_bin_m) + 1


@kernel(inline=True)
def _directions(normals: F4, min_count: float, trials: F8) -> F8:
    """Return directions (n, 3) that many normals share, the most common first, by RANSAC.

    ``normals`` (3, n) are unit vectors; at least ``min_count`` must share a direction. ``trials``
    are from `draw_trials`.
    """
    directions = np.zeros((MAX_DIRECTIONS, 3))
    for k in range(MAX_DIRECTIONS):
        if (
            normals.shape[1] <= min_count
            or _ransac_direction(normals, trials, directions[k]) < min_count
        ):
            return directions[:k]
        normals = _select(normals, directions[k], (-2.0, UP.facing_cos))
    return directions


@kernel(inner=True)
def _select(normals: F4, direction: F8, bounds: tuple[float, float]) -> F4:
    """Return the normals (3, n) whose cosine with a direction is within bounds.

    ``direction`` (3,) is a unit vector; the cosine is above the lower bound, and at most the upper.
    """
    selected = np.zeros(normals.shape, np.float32)
    x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
    n = 0
    for k in range(normals.shape[1]):
        a, b, c = normals[0, k], normals[1, k], normals[2, k]
        selected[0, n], selected[1, n], selected[2, n] = a, b, c
        cos = a * x + b * y + c * z
        n += (cos > bounds[0]) & (cos <= bounds[1])
    return selected[:, :n].copy()


@kernel(inline=True)
def _ransac_direction(normals: F4, trials: F8, best: F8) -> int:
    """Find the direction with the most normals (3, n) near it; return the number of these normals.

    The direction is written to ``best`` (3,). ``trials`` are from `draw_trials`.
    """
    n, best_count = normals.shape[1], 0
    direction = np.zeros(3)
    for t in range(UP.trials):
        k = int(trials[t, 0] * n)
        direction[0], direction[1], direction[2] = normals[0, k], normals[1, k], normals[2, k]
        inliers = 0
        for start in range(0, n, NORMALS_PER_BLOCK):
            if inliers + n - start <= best_count:
                break
            end = min(start + NORMALS_PER_BLOCK, n)
            inliers += _count_facing(normals, direction, start, end)
        if inliers > best_count:
            best_count = inliers
            best[0], best[1], best[2] = direction[0], direction[1], direction[2]
    for _ in range(3):
        best_count = _turn_to_mean(normals, best)
    return best_count


@kernel(fast=True, inner=True)
def _count_facing(normals: F4, direction: F8, start: int, stop: int) -> int:
    """Count the normals (3, n) near ``direction`` (3,), from ``start`` to before ``stop``.

    Near means a cosine above `UpSettings.facing_cos`.
    """
    xs, ys, zs = normals[0], normals[1], normals[2]  # unpacked they would not be contiguous
    x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
    min_cos, inliers = np.float32(UP.facing_cos), np.int32(0)
    for k in range(np.uint64(start), np.uint64(stop)):  # unsigned: no check for negative indices
        inliers += np.int32(xs[k] * x + ys[k] * y + zs[k] * z > min_cos)
    return int(inliers)


@kernel(fast=True, inner=True)
def _turn_to_mean(normals: F4, direction: F8) -> int:
    """Turn a direction to the mean of the normals near it; return their number.

    ``normals`` are (3, n); ``direction`` (3,) is changed in place.
    """
    xs, ys, zs = normals[0], normals[1], normals[2]
    x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
    min_cos, zero = np.float32(UP.facing_cos), np.float32(0)
    sx = sy = sz = np.float64(0)
    inliers = np.int32(0)
    for k in range(xs.size):
        faces = xs[k] * x + ys[k] * y + zs[k] * z > min_cos
        inliers += np.int32(faces)
        sx += xs[k] if faces else zero
        sy += ys[k] if faces else zero
        sz += zs[k] if faces else zero
    norm = math.sqrt(sx * sx + sy * sy + sz * sz)
    direction[0], direction[1], direction[2] = sx / norm, sy / norm, sz / norm
    return int(inliers)


@kernel(inline=True)
def _hypotheses(directions: F8, corner_cos: float) -> F8:
    """Return candidates for up (n, 3): the directions found, and both normals of pairs of walls.

    ``directions`` are from `_directions`; two of them may be walls in a corner if the absolute
    value of their cosine is below ``corner_cos``.
    """
    n = len(directions)
    result = np.zeros((n * n, 3))
    for k in range(len(directions)):
        for d in range(3):
            result[k, d] = directions[k, d]
        for m in range(k):
            if abs(dot(directions[k], directions[m])) < corner_cos:
                corner = cross(directions[k], directions[m])
                norm = math.sqrt(dot(corner, corner))
                for d in range(3):
                    result[n, d], result[n + 1, d] = corner[d] / norm, -corner[d] / norm
                n += 2
    return result[:n]


@kernel(inline=True)
def _score(surface: F4, direction: F8, bins: int, roll_penalty: float) -> float:
    """Return the score of a direction: the weight of large levels, adjusted as in `estimate_up`.

    ``surface`` (8, n) is from `_every_second`, ``bins`` from `_bins_of`; ``direction`` is (3,).
    """
    count, areas, facing, total = _count_levels(surface, direction, bins)
    level, squares, area = _large_levels(count, areas, UP.min_share * total)
    if level == 0:
        return 0.0
    # A shelf has several boards but one back. Objects in front of a wall add levels as well, but of
    # unequal size, and much of the surface parallel to the wall is in no level.
    levels, purity = level**2 / squares, level / facing
    # A camera that looks down on a board sees it obliquely, and the wall behind it head-on.
    frontal = 1 - UP.frontal_penalty * direction[2] ** 2
    across, down = direction[0] ** 2, max(direction[1], 0.0) ** 2
    roll = (across + down) / (across + direction[1] ** 2 + UP.frontal_sin2)
    size = level**UP.level_exponent * min(area / PLANES.furniture_m2, 1.0)
    pure = purity**UP.purity_exponent
    return float(size * levels * pure * frontal / (1 + roll_penalty * roll))


@kernel(inline=True)
def _large_levels(count: F8, areas: F8, min_weight: float) -> tuple[float, float, float]:
    """Sum weights, squared weights and areas (m2) over the levels heavier than ``min_weight``.

    ``count`` and ``areas`` (bins,) are the weights and the areas, m2, at each height. A level fills
    two bins and has more weight than its neighbours; slanted surfaces have no such peaks.
    """
    weight = squares = area = 0.0
    last = count.size - 1
    for k in range(last):
        level_weight = count[k] + count[k + 1]
        stands_out = level_weight > min_weight
        for m in range(max(0, k - 2), min(last, k + 3)):
            neighbour_weight = count[m] + count[m + 1]
            stands_out &= (
                level_weight > neighbour_weight if m < k else level_weight >= neighbour_weight
            )
        if stands_out:
            weight += level_weight
            squares += level_weight * level_weight
            area += areas[k] + areas[k + 1]
    return weight, squares, area


@kernel(inner=True)
def _count_levels(surface: F4, direction: F8, bins: int) -> tuple[F8, F8, float, float]:
    """Sum the weights of the points that face a direction, in bins of distance below the sensor.

    The distance is along ``direction`` (3,); ``surface`` (8, n) is from `_every_second`. Returns
    the weight (bins,) and the area (bins,), m2, in each bin; the sum of the weights in all bins;
    and the weight of all points.
    """
    x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
    nx, ny, nz, weights = surface[0], surface[1], surface[2], surface[6]
    px, py, pz = surface[3], surface[4], surface[5]
    bin_of, scale = np.zeros(nx.size, np.int32), np.float32(-1 / UP.level_bin_m)
    min_cos, other_bin = np.float32(UP.facing_cos), np.int32(bins)
    for k in range(nx.size):  # this vectorises
        below = scale * (px[k] * x + py[k] * y + pz[k] * z)
        faces = nx[k] * x + ny[k] * y + nz[k] * z > min_cos
        bin_of[k] = np.int32(below) if faces & (below >= 0) & (below < other_bin) else other_bin
    count, areas = np.zeros(bins + 1), np.zeros(bins + 1)  # the last bin is for the other points
    for k in range(nx.size):
        count[bin_of[k]] += weights[k]
        areas[bin_of[k]] += surface[7, k]
    facing = np.sum(count[:bins])
    return count[:bins], areas[:bins], facing, facing + count[bins]


@kernel(inline=True)
def _refined(
    points: OrientedPoints, surface: F4, intrinsics: PinholeIntrinsics, direction: F8, bins: int
) -> F8:
    """Return the normal (3,) of the largest plane that faces ``direction``, by least squares.

    If it differs from ``direction`` by more than 20 degrees, return ``direction``. ``surface`` and
    ``bins`` are as in `_score`.
    """
    count, _, _, _ = _count_levels(surface, direction, bins)
    plane = horizontal_plane(intrinsics, direction, -(np.argmax(count) + 0.5) * UP.level_bin_m)
    samples, _ = level_samples(points, direction)
    for multiple in (4, 3, 2, 1, 1):
        refine(samples, multiple * PLANES.tolerance, plane)
    normal = plane_normal(plane, intrinsics)
    return normal if dot(normal, direction) > UP.facing_cos else direction.copy()
