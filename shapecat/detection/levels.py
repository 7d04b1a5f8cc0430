"""Levels: the planes of a scene are parallel, so the larger ones tell how the others lie."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells, Lens, place_of
from shapecat.detection.consensus import TOLERANCE, level_plane
from shapecat.detection.grazing import grazing_board
from shapecat.detection.planes import DIRECTIONS, Support, find_planes, support_of
from shapecat.jit import kernel

__all__ = ["find_levels"]

TURNED_COS = math.cos(math.radians(1))
"""Readings are collected again where up turns out to be off by more."""
DISAGREEING, REWEIGHTED = math.radians(0.5), 5
"""From which angle to the mean, radians, a plane counts less than half; how often this is done."""


def find_levels(cells: Cells, up: F8, rng: np.random.Generator) -> list[tuple[Support, I4]]:
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
        levelled = [(_levelled(cells, support, index, better), index) for support, index in found]
        found = [(support, index) for support, index in levelled if support is not None]
    grazing = grazing_board(cells, [support for support, _ in found], better)
    if grazing is not None:
        found.append(grazing)
    return sorted(found, key=lambda one: one[0].offset)


def _common_up(supports: list[Support]) -> F8:
    """Return the mean normal, weighted by how well each plane tells it: area and width squared.

    A plane that disagrees counts less (iteratively reweighted least squares, Cauchy's weights).
    """
    if len(supports) == 1:
        return supports[0].up
    half = DIRECTIONS // 2
    widths = [float((s.reach[:half] + s.reach[half:]).min()) for s in supports]
    weights = np.array([s.area_m2 * w * w for s, w in zip(supports, widths, strict=True)])
    ups = np.array([s.up for s in supports])
    mean = weights @ ups
    for _ in range(REWEIGHTED):
        mean /= np.linalg.norm(mean)
        apart = ((ups - mean) ** 2).sum(axis=1) / DISAGREEING**2
        mean = (weights / (1 + apart)) @ ups
    return np.asarray(mean / np.linalg.norm(mean))


def _levelled(cells: Cells, support: Support, index: I4, up: F8) -> Support | None:
    """Fit the plane with the normal ``up`` to the readings of a support, by least squares."""
    offset = _offset(cells.w, cells.lens, index, support.a, support.b, support.c, up)
    return support_of(cells, index, level_plane(cells.lens, up, offset))


@kernel
def _offset(w: F4, lens: Lens, index: I4, a: float, b: float, c: float, up: F8) -> float:
    columns = w.shape[1]
    # The inverse depth of the plane up @ p == offset is along / offset.
    squares = products = 0.0
    for p in index:
        i, j = place_of(p, columns)
        if abs(w[i, j] - (a * j + b * i + c)) < TOLERANCE:
            along = up[0] * (j - lens.cx) / lens.fx + up[1] * (i - lens.cy) / lens.fy + up[2]
            squares += along * along
            products += along * w[i, j]
    return float(squares / products)
