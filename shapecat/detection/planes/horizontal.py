"""Horizontal planes: one for each peak in the height histogram (thesis 4.3, Alg. 1).

They are parallel: all get one normal, which the larger ones determine best. A board that is partly
visible or seen at a grazing angle constrains its tilt poorly, and half a degree is a centimetre of
height at a distance of one metre. Planes that do not fit this normal, such as the top of a tilted
object, are dropped.
"""

from collections.abc import Iterable

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import (
    DIRECTIONS,
    PlaneCandidate,
    area_of,
    measure_candidate,
)
from shapecat.detection.planes.oriented_points import OrientedPoints, level_samples
from shapecat.detection.planes.plane_fit import (
    DepthSamples,
    dot,
    horizontal_plane,
    plane_normal,
    refine,
    select_inliers,
)
from shapecat.detection.planes.ransac import count_inliers, ransac_plane
from shapecat.detection.planes.settings import PLANES
from shapecat.jit import kernel

__all__ = ["find_horizontal_planes"]

MAX_PEAKS = 10
"""Maximum number of peaks of the height histogram at which a plane is fitted."""
MIN_SAMPLES = 44
"""Minimum number of points on a plane; noise alone gives a tenth of that."""
_PEAK_BINS = 5
"""Number of bins, centred on a peak, whose samples may belong to one plane."""


def find_horizontal_planes(
    grid: DepthGrid, points: OrientedPoints, up: F8, trials: F8
) -> list[PlaneCandidate]:
    """Return the horizontal planes of the scene, lowest first, with a common normal.

    ``up`` is a unit vector (3,), sensor frame; ``trials`` are from `draw_trials`.
    """
    samples, heights = level_samples(points, up)
    planes = fit_peaks(samples, heights, grid.intrinsics, up, trials)
    candidates = _measure_candidates(grid, samples, planes)
    if len(candidates) > 1:
        common = _common_up(candidates)
        planes = [_refit_parallel(grid.intrinsics, c.inliers, common) for c in candidates]
        candidates = _measure_candidates(grid, samples, planes)
    return sorted(candidates, key=lambda candidate: candidate.plane.offset)


def _measure_candidates(
    grid: DepthGrid, samples: DepthSamples, planes: Iterable[F8]
) -> list[PlaneCandidate]:
    """Measure planes (a, b, c) on their inliers; leave out those below `PLANES.min_area_m2`."""
    candidates = (measure_candidate(grid, samples, plane) for plane in planes)
    return [candidate for candidate in candidates if candidate.plane.area_m2 >= PLANES.min_area_m2]


def _common_up(candidates: list[PlaneCandidate]) -> F8:
    """Return the mean normal of the planes, a unit vector (3,).

    Each normal is weighted by its precision: the visible area of the plane times the square of the
    smallest width of its outline.
    """
    half = DIRECTIONS // 2
    mean = np.zeros(3)
    for plane, *_ in candidates:
        width = (plane.extent[:half] + plane.extent[half:]).min()
        mean += plane.area_m2 * width * width * plane.up
    return np.asarray(mean / np.linalg.norm(mean))


@kernel(fast=True)
def _refit_parallel(intrinsics: PinholeIntrinsics, inliers: DepthSamples, up: F8) -> F8:
    """Fit a plane with the normal ``up`` to the inliers of another plane, by least squares.

    Returns a, b, c (3,) of its inverse depth, as `horizontal_plane` does. ``up`` is a unit vector
    (3,), sensor frame.
    """
    # The inverse depth of the plane up @ p == offset is along / offset.
    squares = products = 0.0
    for k in range(inliers.inverse_depth.size):
        x = (inliers.j[k] - intrinsics.cx) / intrinsics.fx
        y = (inliers.i[k] - intrinsics.cy) / intrinsics.fy
        along = x * up[0] + y * up[1] + up[2]
        squares += along * along
        products += along * inliers.inverse_depth[k]
    parallel: F8 = horizontal_plane(intrinsics, up, squares / products)
    return parallel


def fit_peaks(
    samples: DepthSamples, heights: F4, intrinsics: PinholeIntrinsics, up: F8, trials: F8
) -> list[F8]:
    """Fit a plane to each peak of the heights; return (a, b, c) of each plane of sufficient area.

    Peaks that are not below the sensor are skipped.

    Parameters
    ----------
    samples, heights : the samples and their heights, from `level_samples`.
    up : (3,) unit vector, sensor frame.
    trials : (n, 3) random numbers from `draw_trials`.
    """
    planes: list[F8] = []
    rest = np.stack([samples.j, samples.i, samples.inverse_depth, heights])
    for _ in range(MAX_PEAKS):
        if rest.shape[1] < MIN_SAMPLES:
            break
        off_peak = abs(rest[3] - _histogram_peak(rest[3])) > _PEAK_BINS / 2 * PLANES.bin_m
        j, i, inv_depth, at_peak = np.compress(~off_peak, rest, axis=1)
        rest = np.compress(off_peak, rest, axis=1)
        size = at_peak.size
        if size < MIN_SAMPLES:
            break
        offset = float(np.partition(at_peak, size // 2)[size // 2])
        if offset > -PLANES.margin_m:
            continue
        peak = DepthSamples(j, i, inv_depth, samples.cells_per_sample)
        plane, is_large = _fit(peak, intrinsics, up, trials, offset)
        if is_large:
            a, b, c = plane.astype(np.float32)
            distance = abs(rest[2] - (a * rest[0] + b * rest[1] + c))
            rest = np.compress(distance > np.float32(3 * PLANES.tolerance), rest, axis=1)
            planes.append(plane)
    return planes


def _histogram_peak(heights: F4) -> np.float64:
    """Return the middle of the bin with the most heights, metres.

    Heights in the two bins beside it count half. ``heights`` (n,) are in metres.
    """
    low = heights.min().astype(np.float64)
    bins = ((heights - low) / PLANES.bin_m).astype(np.int64)
    count = np.concatenate([[0], np.bincount(bins), [0]])
    best = np.argmax(count[:-2] + 2 * count[1:-1] + count[2:])
    return np.float64(low + (best + 0.5) * PLANES.bin_m)


@kernel
def _fit(
    samples: DepthSamples, intrinsics: PinholeIntrinsics, up: F8, trials: F8, offset: float
) -> tuple[F8, bool]:
    """Fit a plane to samples at about one height.

    Returns the plane (a, b, c), and whether it has enough inliers and visible area. ``offset`` is
    that height above the sensor, metres; ``up`` and ``trials`` are as in `fit_peaks`.
    """
    level = horizontal_plane(intrinsics, up, offset)
    plane = level.copy()
    count = 0
    for _ in range(3):
        count = refine(samples, 1.5 * PLANES.tolerance, plane)
        if count < MIN_SAMPLES:
            return plane, False
        if dot(plane_normal(plane, intrinsics), up) < PLANES.steady_cos:
            plane[0], plane[1], plane[2] = level
            break
    close = count_inliers(samples, plane, PLANES.tolerance / 2)
    if close < PLANES.close_share * count:
        voted, votes = ransac_plane(
            samples, trials, intrinsics, up, (PLANES.steady_cos, 1.0), PLANES.tolerance / 2
        )
        if votes > close:
            plane[0], plane[1], plane[2] = voted
    inliers = select_inliers(samples, plane, PLANES.tolerance)
    area = area_of(inliers, plane, abs(offset)) / (intrinsics.fx * intrinsics.fy)
    return plane, bool(area >= PLANES.min_area_m2)
