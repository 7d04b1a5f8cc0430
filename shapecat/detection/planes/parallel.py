"""Parallel planes: those of a scene have one normal, which the larger ones tell best."""

import math

import numpy as np

from shapecat.arrays import F8
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import (
    DIRECTIONS,
    LEAST_AREA_M2,
    SupportingPlane,
    measure_plane,
    sort_by_height,
)
from shapecat.detection.planes.horizontal import find_horizontal_planes
from shapecat.detection.planes.oblique import add_oblique_plane
from shapecat.detection.planes.ransac import (
    INLIER_TOLERANCE,
    DepthSamples,
    cosine,
    horizontal_plane,
)
from shapecat.jit import kernel

__all__ = ["find_parallel_planes"]

TURNED_COS = math.cos(math.radians(1))
"""Readings are collected again where up turns out to be off by more."""
DISAGREEING, REWEIGHTED = math.radians(0.5), 5
"""From which angle to the mean, radians, a plane counts less than half; how often this is done."""


@kernel
def find_parallel_planes(
    grid: DepthGrid, up: F8, trials: F8
) -> list[tuple[SupportingPlane, DepthSamples]]:
    """Return the planes of `find_horizontal_planes` with one normal in common, lowest first.

    A board seen at a grazing angle, or only a strip of one, does not tell its tilt well: half a
    degree is a centimetre of height a metre away. What is not level then, such as the top of a
    tilted thing, is left out.
    """
    found: list[tuple[SupportingPlane, DepthSamples]] = find_horizontal_planes(grid, up, trials)
    if len(found) == 0:
        return found
    better = _common_up(found)
    if cosine(better, up) < TURNED_COS:
        found = find_horizontal_planes(grid, better, trials)
        better = _common_up(found) if len(found) > 0 else better
    if len(found) > 1:
        found = _refit_parallel(grid, found, better)
    add_oblique_plane(grid, found, better)
    sort_by_height(found)
    return found


@kernel
def _common_up(found: list[tuple[SupportingPlane, DepthSamples]]) -> F8:
    """Return the mean normal, weighted by how well each plane tells it: area and width squared."""
    if len(found) == 1:
        return found[0][0].up
    half = DIRECTIONS // 2
    directions, weights = np.zeros((len(found), 3)), np.zeros(len(found))
    for k, (support, _) in enumerate(found):
        width = np.min(support.extent[:half] + support.extent[half:])
        directions[k], weights[k] = support.up, support.area_m2 * width * width
    mean: F8 = _robust_mean(directions, weights)
    return mean


@kernel
def _robust_mean(directions: F8, weights: F8) -> F8:
    """Return the weighted mean (3,) of directions (n, 3).

    One that disagrees counts less (iteratively reweighted least squares, Cauchy's weights).
    """
    mean = np.zeros(3)
    factors = np.ones(weights.size)
    for _ in range(1 + REWEIGHTED):
        mean[:] = 0
        for k in range(weights.size):
            mean += factors[k] * weights[k] * directions[k]
        mean /= math.sqrt(np.sum(mean * mean))
        for k in range(weights.size):
            apart = np.sum((directions[k] - mean) ** 2)
            factors[k] = 1 / (1 + apart / DISAGREEING**2)
    return mean


@kernel
def _refit_parallel(
    grid: DepthGrid, found: list[tuple[SupportingPlane, DepthSamples]], up: F8
) -> list[tuple[SupportingPlane, DepthSamples]]:
    """Fit planes with the normal ``up`` to the readings of others, by least squares."""
    levelled: list[tuple[SupportingPlane, DepthSamples]] = []
    for before, samples in found:
        plane = _fit_constrained(grid.intrinsics, samples, before.a, before.b, before.c, up)
        support = measure_plane(grid, samples, plane)
        if support.area_m2 >= LEAST_AREA_M2:
            levelled.append((support, samples))
    return levelled


@kernel(fast=True)
def _fit_constrained(
    intrinsics: PinholeIntrinsics, samples: DepthSamples, a: float, b: float, c: float, up: F8
) -> F8:
    # The inverse depth of the plane up @ p == offset is along / offset.
    squares = products = 0.0
    for k in range(samples.inverse_depth.size):
        j, i, v = samples.j[k], samples.i[k], samples.inverse_depth[k]
        near = abs(v - (a * j + b * i + c)) < INLIER_TOLERANCE
        along = (
            up[0] * (j - intrinsics.cx) / intrinsics.fx
            + up[1] * (i - intrinsics.cy) / intrinsics.fy
            + up[2]
        )
        squares += along * along if near else 0.0
        products += along * v if near else 0.0
    plane: F8 = horizontal_plane(intrinsics, up, squares / products)
    return plane
