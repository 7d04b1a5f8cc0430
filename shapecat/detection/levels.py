"""Levels: the planes of a scene are parallel, so the larger ones tell how the others lie."""

import math

import numpy as np

from shapecat.arrays import F8
from shapecat.detection.cells import Cells, Lens
from shapecat.detection.consensus import TOLERANCE, Readings, level_plane
from shapecat.detection.grazing import grazing_board
from shapecat.detection.planes import DIRECTIONS, Support, find_planes, support_of
from shapecat.jit import kernel

__all__ = ["find_levels"]

TURNED_COS = math.cos(math.radians(1))
"""Readings are collected again where up turns out to be off by more."""
DISAGREEING, REWEIGHTED = math.radians(0.5), 5
"""From which angle to the mean, radians, a plane counts less than half; how often this is done."""


def find_levels(cells: Cells, up: F8, rng: np.random.Generator) -> list[tuple[Support, Readings]]:
    """Return the planes of `find_planes` with one normal in common, lowest first.

    A board seen at a grazing angle, or only a strip of one, does not tell its tilt well: half a
    degree is a centimetre of height a metre away. What is not level then, such as the top of a
    tilted thing, is left out.
    """
    found = find_planes(cells, up, rng)
    if not found:
        return found
    better = _common_up([support for support, _ in found])
    if better @ up < TURNED_COS:
        found = find_planes(cells, better, rng)
        better = _common_up([support for support, _ in found]) if found else better
    if len(found) > 1:
        levelled = [(_levelled(cells, *one, better), one[1]) for one in found]
        found = [(support, readings) for support, readings in levelled if support is not None]
    grazing = grazing_board(cells, [support for support, _ in found], better)
    if grazing is not None:
        found.append(grazing)
    return sorted(found, key=lambda one: one[0].offset)


def _common_up(supports: list[Support]) -> F8:
    """Return the mean normal, weighted by how well each plane tells it: area and width squared."""
    if len(supports) == 1:
        return supports[0].up
    half = DIRECTIONS // 2
    reach = np.array([s.reach for s in supports])
    width = (reach[:, :half] + reach[:, half:]).min(axis=1)
    area = np.array([s.area_m2 for s in supports])
    return np.asarray(_robust_mean(np.array([s.up for s in supports]), area * width * width))


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


def _levelled(cells: Cells, support: Support, readings: Readings, up: F8) -> Support | None:
    """Fit the plane with the normal ``up`` to the readings of a support, by least squares."""
    plane = _level_fit(cells.lens, readings, support.a, support.b, support.c, up)
    return support_of(cells, readings, plane)


@kernel(fast=True)
def _level_fit(lens: Lens, readings: Readings, a: float, b: float, c: float, up: F8) -> F8:
    # The inverse depth of the plane up @ p == offset is along / offset.
    squares = products = 0.0
    for k in range(readings.w.size):
        j, i, v = readings.j[k], readings.i[k], readings.w[k]
        near = abs(v - (a * j + b * i + c)) < TOLERANCE
        along = up[0] * (j - lens.cx) / lens.fx + up[1] * (i - lens.cy) / lens.fy + up[2]
        squares += along * along if near else 0.0
        products += along * v if near else 0.0
    plane: F8 = level_plane(lens, up, squares / products)
    return plane
