"""Supports: what is measured of a horizontal plane: its outline and its area."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, U1
from shapecat.detection.depth_grid import Cells, Lens
from shapecat.detection.planes.ransac import TOLERANCE, Readings, normal_of
from shapecat.geometry import level_axes
from shapecat.jit import kernel

__all__ = [
    "ARM",
    "COS",
    "DIRECTIONS",
    "LEAST_AREA_M2",
    "MARGIN_M",
    "SIN",
    "Support",
    "corners_of",
    "sort_by_height",
    "support_of",
]

DIRECTIONS = 16
"""Sides of the convex outline of a plane."""
ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COS, SIN = np.cos(ANGLES), np.sin(ANGLES)
MARGIN_M = 0.01
"""An outline reaches this far beyond the readings."""
LEAST_AREA_M2 = 0.02
"""Visible area of the smallest plane."""
ARM = 3
"""Cells to each side over which a surface is seen to be level; odd."""


class Support(NamedTuple):
    """A horizontal plane that objects may stand on, in units of cells.

    ``a * j + b * i + c`` is its inverse depth at cell (i, j); ``up`` (3,) its unit normal in the
    sensor frame and ``offset`` its height along ``up``; ``reach`` (DIRECTIONS,) how far it extends
    along evenly spaced directions of the level frame, metres; ``area_m2`` its visible area.
    """

    a: float
    b: float
    c: float
    up: F8
    offset: float
    reach: F8
    area_m2: float


@kernel
def support_of(cells: Cells, readings: Readings, plane: F8) -> Support:
    """Measure a plane (a, b, c) on readings near it."""
    w, lens = cells.w, cells.lens
    normal = normal_of(plane, lens)
    x, y = plane[0] * lens.fx, plane[1] * lens.fy
    z = plane[0] * lens.cx + plane[1] * lens.cy + plane[2]
    distance = 1 / math.sqrt(x * x + y * y + z * z)
    area = _area_of(readings, plane, distance) / (lens.fx * lens.fy)
    axes = np.array(level_axes(normal[0], normal[1], normal[2]))
    beside = _beside_inliers(readings, plane, w.shape[0], w.shape[1])
    reach = _reach_of(w, lens, plane, axes, beside)
    return Support(plane[0], plane[1], plane[2], normal, -distance, reach, area)


@kernel(fast=True, leaf=True)
def _area_of(readings: Readings, plane: F8, distance: float) -> float:
    """Return the visible area of a plane by that of a pixel at 1 m, from its distance."""
    j, i, w = readings.j, readings.i, readings.w
    total = 0.0
    for k in range(w.size):
        level = plane[0] * j[k] + plane[1] * i[k] + plane[2]
        near = (level > 0) & (abs(w[k] - level) < TOLERANCE)
        facing = level * distance  # the cosine between the normal and the ray
        area = 1 / (level * level * (facing if facing > 0.05 else 0.05))
        total += area if near else 0.0
    return float(readings.share * total)


@kernel(fast=True)
def _beside_inliers(readings: Readings, plane: F8, rows: int, columns: int) -> U1:
    """Mark the cells (rows, columns) to which the surface was seen to go on from an inlier."""
    j, i, w = readings.j, readings.i, readings.w
    top, width = np.int32(ARM), np.int32(columns)
    place = np.zeros(w.size, np.int32)
    for k in range(w.size):
        level = plane[0] * j[k] + plane[1] * i[k] + plane[2]
        near = (level > 0) & (abs(w[k] - level) < TOLERANCE)
        here = np.int32(j[k]) + (np.int32(i[k]) + top) * width
        place[k] = here if near else np.int32(0)
    # There are margins above and below; those at the sides are cells that never are inliers.
    n, margin = rows * columns, ARM * columns
    inliers = np.zeros(n + 2 * margin, np.uint8)
    for p in place:
        inliers[p] = 1
    inliers[0] = 0
    above, below = inliers[:n], inliers[2 * margin :]
    left, right = inliers[margin - ARM :], inliers[margin + ARM :]
    beside = np.zeros(n, np.uint8)
    for k in range(n):
        beside[k] = above[k] | below[k] | left[k] | right[k]
    return beside.reshape(rows, columns)


@kernel
def _reach_of(w: F4, lens: Lens, plane: F8, axes: F8, beside: U1) -> F8:
    """Return how far the plane reaches along `DIRECTIONS`, metres, with a margin."""
    across, along = axes[0], axes[1]
    reach = np.full(DIRECTIONS, -np.inf)
    for i in range(w.shape[0]):
        # The outline is convex in the image too: the first and last cell of each row tell it.
        first, last = _ends(w, plane, i, beside[i])
        if first > last:
            continue
        for j in (first, last):
            z = 1 / (plane[0] * j + plane[1] * i + plane[2])
            x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
            u = across[0] * x + across[1] * y + across[2] * z
            v = along[0] * x + along[1] * y + along[2] * z
            for k in range(DIRECTIONS):
                there = COS[k] * u + SIN[k] * v
                reach[k] = there if there > reach[k] else reach[k]
    return reach + MARGIN_M


@kernel(leaf=True)
def _ends(w: F4, plane: F8, i: int, beside: U1) -> tuple[int, int]:
    """Return the first and the last marked cell of a row in the plane; none: first > last."""
    none = np.int32(beside.size)
    first, last = none, np.int32(-1)
    for k in range(beside.size):  # no more than 32 bits, and this vectorises
        low = np.int32(k) if beside[k] else none
        high = np.int32(k) if beside[k] else np.int32(-1)
        first, last = (low if low < first else first), (high if high > last else last)
    while first <= last and not (beside[first] and _is_in(w, plane, i, first)):
        first += 1
    while first < last and not (beside[last] and _is_in(w, plane, i, last)):
        last -= 1
    return int(first), int(last)


@kernel(leaf=True)
def _is_in(w: F4, plane: F8, i: int, j: int) -> bool:
    level = plane[0] * j + plane[1] * i + plane[2]
    return bool(level > 0 and abs(w[i, j] - level) < TOLERANCE)


@kernel
def corners_of(support: Support) -> F8:
    """Return the corners (k, 3) of the convex outline, sensor frame, in order, without repeats."""
    up, reach = support.up, support.reach
    axes = level_axes(up[0], up[1], up[2])
    corners = np.zeros((DIRECTIONS, 3))
    for k in range(DIRECTIONS):
        # Neighbouring sides x cos + y sin = reach meet at a corner.
        along = (reach[(k + 1) % DIRECTIONS] - reach[k] * COS[1]) / SIN[1]
        x, y = reach[k] * COS[k] - along * SIN[k], reach[k] * SIN[k] + along * COS[k]
        for d in range(3):
            corners[k, d] = x * axes[0][d] + y * axes[1][d] + support.offset * axes[2][d]
    return corners


@kernel
def sort_by_height(found: list[tuple[Support, Readings]]) -> None:
    """Put the lowest plane first, in place."""
    for k in range(1, len(found)):
        one, m = found[k], k
        while m > 0 and found[m - 1][0].offset > one[0].offset:
            found[m] = found[m - 1]
            m -= 1
        found[m] = one
