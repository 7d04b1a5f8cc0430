"""RANSAC: planes with many inliers among depth samples (Fischler and Bolles 1981)."""

import math

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.depth_grid import PinholeIntrinsics
from shapecat.detection.planes.plane_fit import DepthSamples, refine
from shapecat.jit import kernel

__all__ = [
    "count_inliers",
    "draw_trials",
    "ransac_plane",
    "sample_grid",
    "select_outliers",
]

TRIALS = 240
"""Number of planes tried. A plane with a seventh of the samples is missed with a probability of one
half."""
SAMPLES_PER_BLOCK = 256
"""Number of samples after which a plane that can no longer win is dropped."""
MIN_DOUBLE_AREA = 30.0
"""Twice the minimum area of the triangle of three samples, in square cells. Noise spoils the planes
of smaller triangles."""
SAMPLE = 4800
"""Approximate number of cells among which `sample_grid` looks for samples: with more, RANSAC only
takes longer."""


@kernel
def sample_grid(inv_depth: F4, mask: F4) -> DepthSamples:
    """Return evenly spaced samples with depth where ``mask`` (rows, columns) is above 0.

    ``inv_depth`` is (rows, columns), 1/m.
    """
    rows, columns = inv_depth.shape
    stride = max(1, round(math.sqrt(inv_depth.size / SAMPLE)))
    result = np.zeros((3, (rows // stride + 1) * (columns // stride + 1)), np.float32)
    n = 0
    for i in range(stride // 2, rows, stride):
        for j in range(stride // 2, columns, stride):
            result[0, n], result[1, n], result[2, n] = j, i, inv_depth[i, j]
            n += (inv_depth[i, j] > 0) & (mask[i, j] > 0)
    return DepthSamples(result[0][:n], result[1][:n], result[2][:n], stride * stride)


@kernel(inner=True)
def select_outliers(samples: DepthSamples, plane: F8, tolerance: float) -> DepthSamples:
    """Return the samples whose inverse depth differs by more than ``tolerance``, 1/m, from a plane.

    The inverse depth of the plane (a, b, c) at column j and row i is ``a * j + b * i + c``, 1/m.
    """
    a, b, c = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    gate = np.float32(tolerance)
    outliers = np.zeros((3, samples.inverse_depth.size), np.float32)
    n = 0
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        outliers[0, n], outliers[1, n], outliers[2, n] = j, i, v
        n += abs(v - (a * j + b * i + c)) > gate
    return DepthSamples(outliers[0][:n], outliers[1][:n], outliers[2][:n], samples.cells_per_sample)


def draw_trials(rng: np.random.Generator) -> F8:
    """Draw random numbers (n, 3) in [0, 1), to pick the samples in all RANSAC runs of a frame."""
    return rng.random((TRIALS, 3))


@kernel
def ransac_plane(
    samples: DepthSamples,
    trials: F8,
    intrinsics: PinholeIntrinsics,
    guide: F8,
    cosines: tuple[float, float],
    tolerance: float,
) -> tuple[F8, int]:
    """Return the plane (a, b, c) of inverse depth with the most inliers, and their number.

    The plane is refitted to its inliers. If none has at least three inliers, the number is 0.

    Parameters
    ----------
    trials : (n, 3) from `draw_trials`; each row picks three samples that propose a plane.
    guide : (3,) unit vector, sensor frame.
    cosines : bounds, inclusive, of the cosine between ``guide`` and the plane's normal towards the
        camera; other planes are not considered.
    tolerance : largest distance of an inlier in inverse depth, 1/m.
    """
    plane, best = np.zeros(3), np.zeros(3)
    best_count, n = 0, samples.inverse_depth.size
    for t in range(len(trials) if n >= 3 else 0):
        # (1) three samples propose a plane
        if not _propose(samples, trials, t, plane):
            continue
        a, b = plane[0] * intrinsics.fx, plane[1] * intrinsics.fy
        c = plane[0] * intrinsics.cx + plane[1] * intrinsics.cy + plane[2]
        along = -(a * guide[0] + b * guide[1] + c * guide[2])
        norm = math.sqrt(a * a + b * b + c * c)
        if not ((along >= cosines[0] * norm) & (along <= cosines[1] * norm)):
            continue
        # (2) count the inliers
        inliers = 0
        for start in range(0, n, SAMPLES_PER_BLOCK):
            if inliers + n - start <= best_count:
                break
            end = min(start + SAMPLES_PER_BLOCK, n)
            inliers += _count_part(samples, plane, tolerance, start, end)
        if inliers > best_count:
            best_count = inliers
            best[0], best[1], best[2] = plane[0], plane[1], plane[2]
    # (3) the plane is refitted to its inliers
    for _ in range(4):
        refine(samples, tolerance, best)
    return best, count_inliers(samples, best, tolerance) if best_count >= 3 else 0


@kernel(inline=True)
def _propose(samples: DepthSamples, trials: F8, t: int, plane: F8) -> bool:
    """Write the plane through the three samples of trial ``t``, an index into ``trials``.

    Returns whether the triangle of these samples has at least the area of `MIN_DOUBLE_AREA`.
    ``plane`` (3,) is a, b, c of inverse depth; ``trials`` are from `draw_trials`.
    """
    n = samples.inverse_depth.size
    p, q, r = int(trials[t, 0] * n), int(trials[t, 1] * n), int(trials[t, 2] * n)
    j, i, w = samples.j[p], samples.i[p], samples.inverse_depth[p]
    j1, i1, w1 = samples.j[q] - j, samples.i[q] - i, float(samples.inverse_depth[q]) - w
    j2, i2, w2 = samples.j[r] - j, samples.i[r] - i, float(samples.inverse_depth[r]) - w
    double_area = i1 * j2 - i2 * j1
    plane[0], plane[1] = (i1 * w2 - i2 * w1) / double_area, (j2 * w1 - j1 * w2) / double_area
    plane[2] = w - plane[0] * j - plane[1] * i
    return bool(abs(double_area) >= MIN_DOUBLE_AREA)


@kernel(inner=True)
def count_inliers(samples: DepthSamples, plane: F8, tolerance: float) -> int:
    """Count the samples within ``tolerance`` (1/m) of a plane (a, b, c) of inverse depth."""
    first = np.int64(0)  # numba would compile another version for a literal
    return int(_count_part(samples, plane, tolerance, first, samples.inverse_depth.size))


@kernel(fast=True)
def _count_part(samples: DepthSamples, plane: F8, tolerance: float, start: int, stop: int) -> int:
    """Count the inliers of a plane among the samples from ``start`` to before ``stop``.

    ``plane`` (3,) and ``tolerance`` are as in `count_inliers`.
    """
    j, i, inv_depth = samples.j, samples.i, samples.inverse_depth
    a, b, c = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    gate, total = np.float32(tolerance), np.int32(0)
    for k in range(np.uint64(start), np.uint64(stop)):  # unsigned: no check for negative indices
        total += np.int32(abs(inv_depth[k] - (a * j[k] + b * i[k] + c)) < gate)
    return int(total)
