"""RANSAC: planes that many depth samples lie in (Fischler and Bolles 1981)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.depth_grid import PinholeIntrinsics
from shapecat.jit import kernel

__all__ = [
    "INLIER_TOLERANCE",
    "DepthSamples",
    "cosine",
    "count_inliers",
    "draw_trials",
    "horizontal_plane",
    "median_of",
    "plane_normal",
    "ransac_plane",
    "refine",
    "remove_inliers",
    "sample_grid",
    "select",
]

INLIER_TOLERANCE = 0.01
"""Distance of an inlier from a plane in inverse depth, 1/m: three steps of a Kinect."""
TRIALS, BLOCK = 240, 256
"""Planes that are tried, and after how many readings it is asked if one can still win."""
LEAST_DOUBLE_AREA = 30.0
"""Of the triangle of three readings, in cells squared: smaller ones are mostly noise."""
SAMPLE = 4800
"""About as many cells propose planes and vote."""


class DepthSamples(NamedTuple):
    """Depth samples in a list: ``j`` (n,) columns, ``i`` (n,) rows, ``inverse_depth`` (n,) 1/m.

    All float32. ``share`` is how many cells each stands for.
    """

    j: F4
    i: F4
    inverse_depth: F4
    share: int


@kernel
def sample_grid(inv_depth: F4, wanted: F4) -> DepthSamples:
    """Return evenly spaced cells with a reading, where ``wanted`` (rows, columns) is above 0."""
    rows, columns = inv_depth.shape
    stride = max(1, round(math.sqrt(inv_depth.size / SAMPLE)))
    result = np.zeros((3, (rows // stride + 1) * (columns // stride + 1)), np.float32)
    n = 0
    for i in range(stride // 2, rows, stride):
        for j in range(stride // 2, columns, stride):
            result[0, n], result[1, n], result[2, n] = j, i, inv_depth[i, j]
            n += (inv_depth[i, j] > 0) & (wanted[i, j] > 0)
    return DepthSamples(result[0, :n], result[1, :n], result[2, :n], stride * stride)


@kernel
def select(samples: DepthSamples, chosen: I4) -> DepthSamples:
    """Return the readings at the ``chosen`` (n,) places in the list."""
    result = np.zeros((3, chosen.size), np.float32)
    j, i, inv_depth = result[0], result[1], result[2]
    for k in range(chosen.size):
        j[k], i[k], inv_depth[k] = (
            samples.j[chosen[k]],
            samples.i[chosen[k]],
            samples.inverse_depth[chosen[k]],
        )
    return DepthSamples(j, i, inv_depth, samples.share)


@kernel
def median_of(values: F4, chosen: I4) -> float:
    """Return the upper median of the values at the ``chosen`` places, at least one.

    Source: Hoare 1961, Algorithm 65. `numpy.partition` in a kernel takes 15 ms to load.
    """
    sample = np.zeros(chosen.size, np.float32)
    for k in range(chosen.size):
        sample[k] = values[chosen[k]]
    middle, low, high = sample.size // 2, 0, sample.size - 1
    while low < high:
        pivot, i, j = sample[middle], low, high
        while i <= j:
            while sample[i] < pivot:
                i += 1
            while sample[j] > pivot:
                j -= 1
            if i <= j:
                sample[i], sample[j] = sample[j], sample[i]
                i, j = i + 1, j - 1
        if j < middle:
            low = i
        if i > middle:
            high = j
    return float(sample[middle])


@kernel
def remove_inliers(samples: DepthSamples, plane: F8, tolerance: float) -> DepthSamples:
    """Return the readings that are not near a plane."""
    a, b, c = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    gate = np.float32(tolerance)
    rest = np.zeros((3, samples.inverse_depth.size), np.float32)
    n = 0
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        rest[0, n], rest[1, n], rest[2, n] = j, i, v
        n += abs(v - (a * j + b * i + c)) > gate
    return DepthSamples(rest[0, :n], rest[1, :n], rest[2, :n], samples.share)


@kernel
def plane_normal(plane: F8, intrinsics: PinholeIntrinsics) -> F8:
    """Return the unit normal towards the camera of a plane (a, b, c) of inverse depth."""
    a, b, c = plane
    x, y, z = -a * intrinsics.fx, -b * intrinsics.fy, -(a * intrinsics.cx + b * intrinsics.cy + c)
    norm = math.sqrt(x * x + y * y + z * z)
    return np.array([x / norm, y / norm, z / norm])


@kernel
def cosine(a: F8, b: F8) -> float:
    """Return the cosine of the angle between two unit vectors (3,)."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@kernel
def horizontal_plane(intrinsics: PinholeIntrinsics, up: F8, offset: float) -> F8:
    """Return the plane ``up @ p == offset`` as inverse depth (a, b, c)."""
    a, b = up[0] / intrinsics.fx, up[1] / intrinsics.fy
    return np.array(
        [a / offset, b / offset, (up[2] - a * intrinsics.cx - b * intrinsics.cy) / offset]
    )


def draw_trials(rng: np.random.Generator) -> F8:
    """Draw the numbers (n, 3) from 0 to 1 that tell all kernels of a frame which to try."""
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
    """Return the plane (a, b, c) with most inliers, and how many readings these are.

    Only planes count whose normal towards the camera has a cosine within ``cosines`` to
    ``guide``. No readings agree on a plane: 0.

    Parameters
    ----------
    trials : of `draw_trials`; the readings at these shares of the list propose planes.
    """
    best = np.zeros(3)
    most, n = 0, samples.inverse_depth.size
    for t in range(len(trials) if n >= 3 else 0):
        # (1) three readings propose a plane
        p, q, r = int(trials[t, 0] * n), int(trials[t, 1] * n), int(trials[t, 2] * n)
        w0 = float(samples.inverse_depth[p])
        j1, i1 = samples.j[q] - samples.j[p], samples.i[q] - samples.i[p]
        j2, i2 = samples.j[r] - samples.j[p], samples.i[r] - samples.i[p]
        double = i1 * j2 - i2 * j1
        if abs(double) < LEAST_DOUBLE_AREA:
            continue
        a = (i1 * (samples.inverse_depth[r] - w0) - i2 * (samples.inverse_depth[q] - w0)) / double
        b = (j2 * (samples.inverse_depth[q] - w0) - j1 * (samples.inverse_depth[r] - w0)) / double
        c = w0 - a * samples.j[p] - b * samples.i[p]
        nx, ny, nz = a * intrinsics.fx, b * intrinsics.fy, a * intrinsics.cx + b * intrinsics.cy + c
        along = -(nx * guide[0] + ny * guide[1] + nz * guide[2])
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if not ((along >= cosines[0] * norm) & (along <= cosines[1] * norm)):
            continue
        # (2) all vote
        inliers = _inliers_if_more(samples, a, b, c, tolerance, most)
        if inliers > most:
            most = inliers
            best[0], best[1], best[2] = a, b, c
    # (3) the inliers refit
    for _ in range(4):
        refine(samples.j, samples.i, samples.inverse_depth, tolerance, best)
    inliers = count_inliers(samples, best[0], best[1], best[2], tolerance) if most >= 3 else 0
    return best, inliers


@kernel
def _inliers_if_more(
    samples: DepthSamples, a: float, b: float, c: float, tolerance: float, most: int
) -> int:
    """Count the readings near a plane as long as there may be over ``most``."""
    j, i, inv_depth, share = samples
    inliers = 0
    for start in range(0, inv_depth.size, BLOCK):
        if inliers + inv_depth.size - start <= most:
            break
        some = slice(start, start + BLOCK)
        inliers += count_inliers(
            DepthSamples(j[some], i[some], inv_depth[some], share), a, b, c, tolerance
        )
    return inliers


@kernel(fast=True)
def count_inliers(samples: DepthSamples, a: float, b: float, c: float, tolerance: float) -> int:
    """Count the readings near a plane."""
    a4, b4, c4, gate = np.float32(a), np.float32(b), np.float32(c), np.float32(tolerance)
    total = np.int32(0)
    for k in range(samples.inverse_depth.size):
        level = a4 * samples.j[k] + b4 * samples.i[k] + c4
        total += np.int32(abs(samples.inverse_depth[k] - level) < gate)
    return int(total)


@kernel(fast=True)
def refine(j: F4, i: F4, inv_depth: F4, tolerance: float, plane: F8) -> int:
    """Fit a plane (a, b, c) to its inliers by least squares; return how many they are.

    The plane stays as it is if they do not span one.
    """
    if inv_depth.size == 0:
        return 0
    a, b, c = plane[0], plane[1], plane[2]
    j0, i0, w0 = float(j[0]), float(i[0]), float(inv_depth[0])
    n = mx = my = mw = xx = xy = yy = xw = yw = 0.0
    for k in range(inv_depth.size):
        # A sum of products with 0 or 1 vectorises.
        near = 1.0 if abs(inv_depth[k] - (a * j[k] + b * i[k] + c)) < tolerance else 0.0
        x, y, v = near * (j[k] - j0), near * (i[k] - i0), near * (inv_depth[k] - w0)
        n += near
        mx += x
        my += y
        mw += v
        xx += x * x
        xy += x * y
        yy += y * y
        xw += x * v
        yw += y * v
    if n < 3:
        return int(n)
    mx, my, mw = mx / n, my / n, mw / n
    xx, xy, yy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    xw, yw = xw / n - mx * mw, yw / n - my * mw
    determinant = xx * yy - xy * xy
    if determinant > 1e-6 * (xx + yy) ** 2:
        a = (xw * yy - yw * xy) / determinant
        b = (yw * xx - xw * xy) / determinant
        plane[0], plane[1] = a, b
        plane[2] = w0 + mw - a * (mx + j0) - b * (my + i0)
    return int(n)
