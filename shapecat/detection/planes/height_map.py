"""Height map: the plane below each sample, and the height above it (thesis Alg. 2, step 2)."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import COS, DIRECTIONS, SIN, SupportingPlane
from shapecat.geometry import gravity_rotation
from shapecat.jit import kernel

__all__ = [
    "HEIGHT_NOISE",
    "MIN_HEIGHT_M",
    "OUTLINE",
    "HeightMap",
    "distance_outside",
    "measure_heights",
    "min_height_at",
    "pack_planes",
]

MIN_HEIGHT_M = 0.004
"""Minimum height of an object's sample, metres; `HEIGHT_NOISE` times the squared depth is added."""
HEIGHT_NOISE = 0.0025
BEYOND_M = 0.1
"""Surface level with a plane, and this near to its outline, is not an object on a lower plane."""
OUT = -1e6
"""Placeholder for the height of cells that do not belong to a plane: below all noise."""
OUTLINE = 10
"""Index at which the outline begins in a row of `pack_planes`."""
FINE = 65536
"""Steps per 1/m to which inverse depth is rounded."""


class HeightMap(NamedTuple):
    """The plane below each cell of the grid, and the height above it.

    Attributes
    ----------
    plane_id : (rows, columns) int8. For plane k, from 0: k + 1 above it and inside its outline,
        -(k + 1) on its surface. 0 elsewhere.
    height : (rows, columns) float32, metres above the plane of ``plane_id``.
    """

    plane_id: I4
    height: F4


def pack_planes(supports: list[SupportingPlane]) -> F8:
    """Return planes as rows of numbers, for kernels: (planes, `OUTLINE` + `DIRECTIONS`).

    A row is a, b, c of inverse depth, the depth below the sensor, two level axes (3 + 3), and the
    extent in each direction; lengths in metres, sensor frame.
    """
    rows = np.zeros((len(supports), OUTLINE + DIRECTIONS))
    for row, support in zip(rows, supports, strict=True):
        row[:4] = support.a, support.b, support.c, -support.offset
        row[4:OUTLINE] = gravity_rotation(support.up)[:2].ravel()
        row[OUTLINE:] = support.extent
    return rows


@kernel
def measure_heights(grid: DepthGrid, planes: F8, highest_m: float) -> HeightMap:
    """Assign each sample to the highest plane below it.

    ``planes`` are from `pack_planes`, lowest first; ``highest_m`` is the maximum height above the
    plane, metres.
    """
    shape = grid.inverse_depth.shape
    heights = HeightMap(np.zeros(shape, np.int8), np.zeros(shape, np.float32))
    for number in range(len(planes), 0, -1):
        _assign(grid, planes[number - 1], number, highest_m, heights)
    return heights


@kernel(inline=True)
def _assign(grid: DepthGrid, plane: F8, number: int, highest: float, heights: HeightMap) -> None:
    """Assign the free cells inside the outline of a plane to it; the loops over a row vectorise.

    ``plane`` is a row of `pack_planes`, and ``highest`` the maximum height above it, metres.
    Compiled without ``fast``: with it, the inlined copy would round heights differently in the
    process that compiles and in later ones.
    """
    inv_depth, intrinsics, (plane_id, height) = grid.inverse_depth, grid.intrinsics, heights
    rows, columns = inv_depth.shape
    a, scale, zero, one = np.float32(plane[0]), np.float32(plane[3]), np.float32(0), np.float32(1)
    min_height, noise, outside = np.float32(MIN_HEIGHT_M), np.float32(HEIGHT_NOISE), np.float32(OUT)
    beyond, high = np.float32(BEYOND_M), np.float32(highest)
    above, surface = np.int8(number), np.int8(-number)
    x = np.arange(columns).astype(np.float32)
    line, slack = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    # Level coordinates times inverse depth are linear in the image: per column, per row, constant.
    sides = np.zeros((DIRECTIONS // 2, 3))
    for d in range(2):
        p, q = plane[4 + 3 * d] / intrinsics.fx, plane[5 + 3 * d] / intrinsics.fy
        for k in range(DIRECTIONS // 2):
            part = SIN[k] if d else COS[k]
            sides[k, 0] += part * p
            sides[k, 1] += part * q
            sides[k, 2] += part * (plane[6 + 3 * d] - p * intrinsics.cx - q * intrinsics.cy)
    for i in range(rows):
        base = np.float32(plane[1] * i + plane[2])
        any_valid = False
        for j in range(np.uint64(columns)):
            v = inv_depth[i, j]
            z = one / v if v > zero else zero
            h = (v - (a * x[j] + base)) * z * scale
            gate = min_height + noise * z * z
            valid = (v > zero) & (h > -gate) & (h < high) & (plane_id[i, j] == 0)
            line[j] = h if valid else outside
            slack[j] = zero if h > gate else beyond * v
            any_valid |= valid
        if not any_valid:
            continue
        left, right, min_inv_depth, max_inv_depth = _bounds(line, inv_depth, i)
        for k in range(DIRECTIONS // 2):
            step, first = np.float32(sides[k, 0]), np.float32(sides[k, 1] * i + sides[k, 2])
            extent = np.float32(plane[OUTLINE + k])
            opposite = np.float32(plane[OUTLINE + k + DIRECTIONS // 2])
            # Few rows reach beyond a side; bounds rule out most of the others.
            ends = step * left + first, step * right + first
            limits = (
                min(extent * min_inv_depth, extent * max_inv_depth),
                min(opposite * min_inv_depth, opposite * max_inv_depth),
            )
            if max(ends[0], ends[1]) <= limits[0] and -min(ends[0], ends[1]) <= limits[1]:
                continue
            for j in range(np.uint64(columns)):
                v, margin = inv_depth[i, j], slack[j]
                t = step * x[j] + first
                within = (t <= extent * v + margin) & (-t <= opposite * v + margin)
                line[j] = line[j] if within else outside
        for j in range(np.uint64(columns)):
            assigned = above if slack[j] == zero else surface
            plane_id[i, j] = assigned if line[j] > outside else plane_id[i, j]
        for j in range(np.uint64(columns)):
            height[i, j] = line[j] if line[j] > outside else height[i, j]


@kernel(inline=True)
def _bounds(
    line: F4, inv_depth: F4, i: int
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the first and last cell of a row with a height, and bounds of the inverse depth."""
    left, right = 0, line.size - 1
    while line[left] <= OUT:
        left += 1
    while line[right] <= OUT:
        right -= 1
    out, fine, one = np.float32(OUT), np.float32(FINE), np.float32(1)
    largest, smallest = np.int32(2**30), np.int32(0)
    minimum, maximum = largest, smallest
    for k in range(np.uint64(line.size)):  # integers, whose bounds vectorise
        v, assigned = np.int32(inv_depth[i, k] * fine), line[k] > out
        low, high = (v if assigned else largest), (v if assigned else smallest)
        minimum, maximum = (
            (low if low < minimum else minimum),
            (high if high > maximum else maximum),
        )
    min_inv_depth, max_inv_depth = np.float32(minimum) / fine, (np.float32(maximum) + one) / fine
    return np.float32(left), np.float32(right), min_inv_depth, max_inv_depth


@kernel(inner=True)
def min_height_at(depth_m: float) -> float:
    """Return the minimum height of an object's sample at a depth, metres."""
    return MIN_HEIGHT_M + HEIGHT_NOISE * depth_m * depth_m


@kernel(inner=True)
def distance_outside(plane: F8, x: float, y: float, z: float) -> float:
    """Return how far a point is outside the outline of a plane, metres; negative inside.

    ``plane`` is a row of `pack_planes`; x, y, z are metres, sensor frame.
    """
    p = plane[4] * x + plane[5] * y + plane[6] * z
    q = plane[7] * x + plane[8] * y + plane[9] * z
    outside = -np.inf
    for k in range(DIRECTIONS):
        outside = max(outside, COS[k] * p + SIN[k] * q - plane[OUTLINE + k])
    return outside
