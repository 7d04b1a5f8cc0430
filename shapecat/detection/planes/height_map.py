"""Height map: the plane below each sample, and the height above it (thesis Alg. 2, step 2)."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, Records, Row
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import COS, DIRECTIONS, SIN, SupportingPlane
from shapecat.geometry import gravity_rotation
from shapecat.jit import kernel

__all__ = [
    "CUT_OFF_M",
    "FRINGE",
    "HEIGHT_NOISE",
    "MIN_HEIGHT_M",
    "PLANE",
    "HeightMap",
    "distance_outside",
    "height_above",
    "measure_heights",
    "min_height_at",
    "pack_planes",
]

MIN_HEIGHT_M = 0.004
"""Minimum height of an object's sample at a depth of 0, metres."""
HEIGHT_NOISE = 0.0025
"""Increase of the minimum height at a depth of 1 m, metres. It grows with the squared depth."""
FRINGE = 0.6
"""Next to an object, samples above this fraction of the minimum height belong to it. Elsewhere,
half of such samples are noise of the plane."""
CUT_OFF_M = 0.02
"""An object that comes this close to the maximum height is assumed to continue above it, metres."""
BEYOND_M = 0.1
"""Surface at the height of a plane, and within this distance of its outline, metres, belongs to
that plane. It is not an object on a lower plane."""
OUT = -1e6
"""Placeholder for the height of cells that do not belong to a plane: below all noise."""
FINE = 65536
"""Steps per 1/m to which the bounds of inverse depth in a row are rounded."""
PLANE = np.dtype(
    [
        ("a", "f8"),  # a, b, c of inverse depth, as in `SupportingPlane`
        ("b", "f8"),
        ("c", "f8"),
        ("offset", "f8"),
        ("up", "f8", 3),
        ("axes", "f8", (2, 3)),  # horizontal axes of its level frame
        ("extent", "f8", DIRECTIONS),
        ("area_m2", "f8"),
    ],
    align=True,
)
"""A supporting plane for kernels: the fields of `SupportingPlane`, and two axes."""


class HeightMap(NamedTuple):
    """The plane below each cell of the grid, and the height above it.

    Attributes
    ----------
    plane_id : (rows, columns) int8. With planes counted from 0, it is k + 1 above plane k and
        inside its outline, -(k + 1) on the surface of plane k, and 0 elsewhere.
    height : (rows, columns) float32, metres above the plane of ``plane_id``.
    """

    plane_id: I4
    height: F4


def pack_planes(supports: list[SupportingPlane]) -> Records:
    """Return planes as records of `PLANE`, (planes,)."""
    planes = np.zeros(len(supports), PLANE)
    for plane, support in zip(planes, supports, strict=True):
        for name in SupportingPlane._fields:
            plane[name] = getattr(support, name)
        plane["axes"] = gravity_rotation(support.up)[:2]
    return planes


@kernel
def measure_heights(grid: DepthGrid, planes: Records, max_height_m: float) -> HeightMap:
    """Assign each sample to the highest plane below it.

    ``planes`` are from `pack_planes`, lowest first; ``max_height_m`` is the maximum height above
    the plane, metres.
    """
    shape = grid.inverse_depth.shape
    heights = HeightMap(np.zeros(shape, np.int8), np.zeros(shape, np.float32))
    for number in range(len(planes), 0, -1):
        _assign(grid, planes[number - 1], number, max_height_m, heights)
    return heights


@kernel(inline=True)
def _assign(
    grid: DepthGrid, plane: Row, number: int, max_height_m: float, heights: HeightMap
) -> None:
    """Write to ``heights`` the cells above or on a plane that belong to no plane yet.

    Cells above it must be inside its outline and below ``max_height_m``, metres; cells on it, less
    than `BEYOND_M` outside. ``plane`` is a `PLANE`. The `HeightMap.plane_id` of cells above it is
    ``number``, from 1; that of cells on it is ``-number``. The kernel is compiled without ``fast``:
    with it, its copy in `measure_heights` would round heights differently in the process that
    compiles it and in later ones.
    """
    inv_depth, intrinsics, (plane_id, height) = grid.inverse_depth, grid.intrinsics, heights
    rows, columns = inv_depth.shape
    a, below = np.float32(plane.a), np.float32(-plane.offset)
    zero, one = np.float32(0), np.float32(1)
    min_height, noise, outside = np.float32(MIN_HEIGHT_M), np.float32(HEIGHT_NOISE), np.float32(OUT)
    beyond, high = np.float32(BEYOND_M), np.float32(max_height_m)
    above, surface = np.int8(number), np.int8(-number)
    x = np.arange(columns).astype(np.float32)
    line, slack = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    # Level coordinates times inverse depth are linear in the image: ``sides`` holds their change
    # per column, their change per row, and their constant term.
    sides = np.zeros((DIRECTIONS // 2, 3))
    for d in range(2):
        p, q = plane.axes[d, 0] / intrinsics.fx, plane.axes[d, 1] / intrinsics.fy
        for k in range(DIRECTIONS // 2):
            part = SIN[k] if d else COS[k]
            sides[k, 0] += part * p
            sides[k, 1] += part * q
            sides[k, 2] += part * (plane.axes[d, 2] - p * intrinsics.cx - q * intrinsics.cy)
    for i in range(rows):
        base = np.float32(plane.b * i + plane.c)
        any_valid = False
        for j in range(np.uint64(columns)):
            v = inv_depth[i, j]
            z = one / v if v > zero else zero
            h = (v - (a * x[j] + base)) * z * below
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
            extent = np.float32(plane.extent[k])
            opposite = np.float32(plane.extent[k + DIRECTIONS // 2])
            # Few rows reach beyond a side; these bounds let most of the others skip the exact test.
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
    """Return the first and last column with a height in row i, and bounds of the inverse depth.

    ``line`` (columns,) are the heights of the row, at least one, and `OUT` where there is none. The
    lower and upper bound, 1/m, hold for all cells of the row that have a height.
    """
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
def height_above(plane: Row, i: float, j: float, z: float) -> float:
    """Return the height of a point above a `PLANE`, metres; cell (i, j) sees it at the depth z."""
    return float((1 - (plane.a * j + plane.b * i + plane.c) * z) * -plane.offset)


@kernel(inner=True)
def distance_outside(plane: Row, x: float, y: float, z: float) -> float:
    """Return how far a point is outside the outline of a `PLANE`, metres; negative inside.

    x, y, z are metres, sensor frame.
    """
    p = plane.axes[0, 0] * x + plane.axes[0, 1] * y + plane.axes[0, 2] * z
    q = plane.axes[1, 0] * x + plane.axes[1, 1] * y + plane.axes[1, 2] * z
    outside = -np.inf
    for k in range(DIRECTIONS):
        outside = max(outside, COS[k] * p + SIN[k] * q - plane.extent[k])
    return outside
