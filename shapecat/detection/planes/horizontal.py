"""Horizontal planes: one for each peak in the height histogram (thesis 4.3, Alg. 1).

They are parallel: all get one normal, which the larger ones determine best. A board that is partly
visible or seen at a grazing angle constrains its tilt poorly, and half a degree is a centimetre of
height at a distance of one metre. Planes that are then not level, such as the top of a tilted
object, are dropped.
"""

from collections.abc import Iterable

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import (
    DIRECTIONS,
    PlaneCandidate,
    SupportingPlane,
    area_of,
    measure_plane,
)
from shapecat.detection.planes.oriented_points import OrientedPoints, level_samples
from shapecat.detection.planes.ransac import (
    DepthSamples,
    cosine,
    count_inliers,
    horizontal_plane,
    median_of,
    off_plane,
    plane_normal,
    ransac_plane,
    refine,
)
from shapecat.detection.planes.settings import PLANES
from shapecat.jit import kernel

__all__ = ["find_horizontal_planes"]

MOST_PLANES = 10
LEAST_SAMPLES = 44
"""Minimum number of points on a plane; noise alone gives a tenth of that."""


def find_horizontal_planes(
    grid: DepthGrid, points: OrientedPoints, up: F8, trials: F8
) -> list[PlaneCandidate]:
    """Return the horizontal planes of the scene, lowest first, with a common normal.

    ``up`` is a unit vector (3,), sensor frame; ``trials`` are from `draw_trials`.
    """
    found = _fitted(grid, points, up, trials)
    better = _common_up(found) if found else up
    if better @ up < PLANES.turned_cos:
        found = _fitted(grid, points, better, trials)
        better = _common_up(found) if found else better
    if len(found) > 1:
        turned = [_refit_parallel(grid.intrinsics, one.samples, one.plane, better) for one in found]
        found = _measured(grid, found[0].samples, turned)
    return sorted(found, key=lambda one: one.plane.offset)


def _fitted(grid: DepthGrid, points: OrientedPoints, up: F8, trials: F8) -> list[PlaneCandidate]:
    samples, heights = level_samples(points, up)
    planes = fit_horizontal_planes(samples, heights, grid.intrinsics, up, trials)
    return _measured(grid, samples, planes)


def _measured(grid: DepthGrid, samples: DepthSamples, planes: Iterable[F8]) -> list[PlaneCandidate]:
    found = (PlaneCandidate(measure_plane(grid, samples, plane), samples) for plane in planes)
    return [one for one in found if one.plane.area_m2 >= PLANES.least_m2]


def _common_up(found: list[PlaneCandidate]) -> F8:
    """Return the mean normal (3,), weighted by the precision of each: area times width squared."""
    half = DIRECTIONS // 2
    mean = np.zeros(3)
    for plane, *_ in found:
        width = (plane.extent[:half] + plane.extent[half:]).min()
        mean += plane.area_m2 * width * width * plane.up
    return np.asarray(mean / np.linalg.norm(mean))


@kernel(fast=True)
def _refit_parallel(
    intrinsics: PinholeIntrinsics, samples: DepthSamples, plane: SupportingPlane, up: F8
) -> F8:
    """Fit a plane with the normal ``up`` to the inliers of another plane, by least squares."""
    # The inverse depth of the plane up @ p == offset is along / offset.
    squares = products = 0.0
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        near = abs(v - (plane.a * j + plane.b * i + plane.c)) < PLANES.tolerance
        x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
        along = x * up[0] + y * up[1] + up[2] if near else 0.0
        squares += along * along
        products += along * v
    turned: F8 = horizontal_plane(intrinsics, up, squares / products)
    return turned


@kernel
def fit_horizontal_planes(
    rest: DepthSamples, height: F4, intrinsics: PinholeIntrinsics, up: F8, trials: F8
) -> F8:
    """Return the horizontal planes (n, 3), as coefficients a, b, c, most samples first.

    Parameters
    ----------
    rest, height : the samples and their heights, from `level_samples`.
    up : (3,) unit vector, sensor frame.
    trials : from `draw_trials`.
    """
    found = np.zeros((MOST_PLANES, 3))
    n = 0
    # (3) one plane candidate for each peak in height
    for _ in range(MOST_PLANES):
        if height.size < LEAST_SAMPLES:
            break
        peak = _histogram_peak(height)
        near, near_height, rest, height = _split(rest, height, peak)
        if near_height.size < LEAST_SAMPLES:
            break
        # (4) refine the plane, and drop the samples on it
        offset = np.float64(median_of(near_height))
        if offset > -PLANES.margin_m or not _fit(near, intrinsics, up, trials, offset, found[n]):
            continue
        off = off_plane(rest, found[n], 3 * PLANES.tolerance)
        rest, height = off, _heights(off, intrinsics, up)
        n += 1
    return found[:n]


@kernel(inline=True)
def _heights(samples: DepthSamples, intrinsics: PinholeIntrinsics, up: F8) -> F4:
    heights = np.zeros(samples.inverse_depth.size, np.float32)
    for k in range(heights.size):
        x = (samples.j[k] - intrinsics.cx) / intrinsics.fx
        y = (samples.i[k] - intrinsics.cy) / intrinsics.fy
        heights[k] = (x * up[0] + y * up[1] + up[2]) / samples.inverse_depth[k]
    return heights


@kernel(inline=True)
def _histogram_peak(height: F4) -> float:
    """Return the middle of the bin that, with its neighbours, holds the most heights."""
    low = high = float(height[0])
    for h in height:
        low, high = min(low, h), max(high, h)
    count = np.zeros(int((high - low) / PLANES.bin_m) + 3, np.int64)
    for h in height:
        count[int((h - low) / PLANES.bin_m) + 1] += 1
    best, most = 0, -1
    for b in range(1, count.size - 1):
        here = count[b - 1] + 2 * count[b] + count[b + 1]
        if here > most:
            best, most = b, here
    return low + (best - 0.5) * PLANES.bin_m


@kernel(inline=True)
def _split(
    samples: DepthSamples, height: F4, peak: float
) -> tuple[DepthSamples, F4, DepthSamples, F4]:
    """Split samples and their heights into those within five bins around a height and the rest."""
    parts = np.zeros((2, 4, height.size), np.float32)
    n = np.zeros(2, np.int64)
    for k in range(height.size):
        p = int(abs(height[k] - peak) > 2.5 * PLANES.bin_m)
        parts[p, 0, n[p]], parts[p, 1, n[p]] = samples.j[k], samples.i[k]
        parts[p, 2, n[p]], parts[p, 3, n[p]] = samples.inverse_depth[k], height[k]
        n[p] += 1
    near, rest = parts[0], parts[1]
    m, r = n[0], n[1]
    return (
        DepthSamples(near[0][:m], near[1][:m], near[2][:m], samples.share),
        near[3][:m],
        DepthSamples(rest[0][:r], rest[1][:r], rest[2][:r], samples.share),
        rest[3][:r],
    )


@kernel(inline=True)
def _fit(
    near: DepthSamples, intrinsics: PinholeIntrinsics, up: F8, trials: F8, offset: float, plane: F8
) -> bool:
    """Fit a plane to samples at about one height; return whether it is large enough."""
    level = horizontal_plane(intrinsics, up, offset)
    plane[0], plane[1], plane[2] = level
    count = 0
    for _ in range(3):
        count = refine(near, 1.5 * PLANES.tolerance, plane)
        if count < LEAST_SAMPLES:
            return False
        if cosine(plane_normal(plane, intrinsics), up) < PLANES.steady_cos:
            plane[0], plane[1], plane[2] = level
            break
    close = count_inliers(near, plane, PLANES.tolerance / 2)
    if close < PLANES.close_share * count:
        voted, votes = ransac_plane(
            near, trials, intrinsics, up, (PLANES.steady_cos, 1.0), PLANES.tolerance / 2
        )
        if votes > close:
            plane[0], plane[1], plane[2] = voted
    area = area_of(near, plane, abs(offset)) / (intrinsics.fx * intrinsics.fy)
    return bool(area >= PLANES.least_m2)
