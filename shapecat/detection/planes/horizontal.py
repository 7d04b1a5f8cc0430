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
    plane_normal,
    ransac_plane,
    refine,
    select_outliers,
)
from shapecat.detection.planes.settings import PLANES
from shapecat.jit import kernel

__all__ = ["find_horizontal_planes"]

MAX_PLANES = 10
MIN_SAMPLES = 44
"""Minimum number of points on a plane; noise alone gives a tenth of that."""


def find_horizontal_planes(
    grid: DepthGrid, points: OrientedPoints, up: F8, trials: F8
) -> list[PlaneCandidate]:
    """Return the horizontal planes of the scene, lowest first, with a common normal.

    ``up`` is a unit vector (3,), sensor frame; ``trials`` are from `draw_trials`.
    """
    candidates = _fit_candidates(grid, points, up, trials)
    common = _common_up(candidates) if candidates else up
    if common @ up < PLANES.turned_cos:
        candidates = _fit_candidates(grid, points, common, trials)
        common = _common_up(candidates) if candidates else common
    if len(candidates) > 1:
        parallel = [
            _refit_parallel(grid.intrinsics, samples, plane, common)
            for plane, samples, _ in candidates
        ]
        candidates = _measure_candidates(grid, candidates[0].samples, parallel)
    return sorted(candidates, key=lambda candidate: candidate.plane.offset)


def _fit_candidates(
    grid: DepthGrid, points: OrientedPoints, up: F8, trials: F8
) -> list[PlaneCandidate]:
    samples, heights = level_samples(points, up)
    planes = fit_horizontal_planes(samples, heights, grid.intrinsics, up, trials)
    return _measure_candidates(grid, samples, planes)


def _measure_candidates(
    grid: DepthGrid, samples: DepthSamples, planes: Iterable[F8]
) -> list[PlaneCandidate]:
    candidates = (PlaneCandidate(measure_plane(grid, samples, plane), samples) for plane in planes)
    return [candidate for candidate in candidates if candidate.plane.area_m2 >= PLANES.min_area_m2]


def _common_up(candidates: list[PlaneCandidate]) -> F8:
    """Return the mean normal (3,), weighted by the precision of each: area times width squared."""
    half = DIRECTIONS // 2
    mean = np.zeros(3)
    for plane, *_ in candidates:
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
        inlier = abs(v - (plane.a * j + plane.b * i + plane.c)) < PLANES.tolerance
        x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
        along = x * up[0] + y * up[1] + up[2] if inlier else 0.0
        squares += along * along
        products += along * v
    parallel: F8 = horizontal_plane(intrinsics, up, squares / products)
    return parallel


@kernel
def fit_horizontal_planes(
    samples: DepthSamples, heights: F4, intrinsics: PinholeIntrinsics, up: F8, trials: F8
) -> F8:
    """Return the horizontal planes (n, 3), as coefficients a, b, c, most samples first.

    Parameters
    ----------
    samples, heights : the samples and their heights, from `level_samples`.
    up : (3,) unit vector, sensor frame.
    trials : from `draw_trials`.
    """
    planes = np.zeros((MAX_PLANES, 3))
    n = 0
    # (3) one plane candidate for each peak in height
    for _ in range(MAX_PLANES):
        if heights.size < MIN_SAMPLES:
            break
        peak = _histogram_peak(heights)
        peak_samples, peak_heights, samples, heights = _split(samples, heights, peak)
        if peak_heights.size < MIN_SAMPLES:
            break
        # (4) refine the plane, and drop the samples on it
        offset = np.float64(median_of(peak_heights))
        if offset > -PLANES.margin_m or not _fit(
            peak_samples, intrinsics, up, trials, offset, planes[n]
        ):
            continue
        outliers = select_outliers(samples, planes[n], 3 * PLANES.tolerance)
        samples, heights = outliers, _heights(outliers, intrinsics, up)
        n += 1
    return planes[:n]


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
    best, best_count = 0, -1
    for b in range(1, count.size - 1):
        smoothed = count[b - 1] + 2 * count[b] + count[b + 1]
        if smoothed > best_count:
            best, best_count = b, smoothed
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
    inside, outside = parts[0], parts[1]
    m, r = n[0], n[1]
    return (
        DepthSamples(inside[0][:m], inside[1][:m], inside[2][:m], samples.share),
        inside[3][:m],
        DepthSamples(outside[0][:r], outside[1][:r], outside[2][:r], samples.share),
        outside[3][:r],
    )


@kernel(inline=True)
def _fit(
    samples: DepthSamples,
    intrinsics: PinholeIntrinsics,
    up: F8,
    trials: F8,
    offset: float,
    plane: F8,
) -> bool:
    """Fit a plane to samples at about one height; return whether it is large enough."""
    level = horizontal_plane(intrinsics, up, offset)
    plane[0], plane[1], plane[2] = level
    count = 0
    for _ in range(3):
        count = refine(samples, 1.5 * PLANES.tolerance, plane)
        if count < MIN_SAMPLES:
            return False
        if cosine(plane_normal(plane, intrinsics), up) < PLANES.steady_cos:
            plane[0], plane[1], plane[2] = level
            break
    close = count_inliers(samples, plane, PLANES.tolerance / 2)
    if close < PLANES.close_share * count:
        voted, votes = ransac_plane(
            samples, trials, intrinsics, up, (PLANES.steady_cos, 1.0), PLANES.tolerance / 2
        )
        if votes > close:
            plane[0], plane[1], plane[2] = voted
    area = area_of(samples, plane, abs(offset)) / (intrinsics.fx * intrinsics.fy)
    return bool(area >= PLANES.min_area_m2)
