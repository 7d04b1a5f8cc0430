"""Depth grid: the depth image, downsampled to the working resolution of detection.

All steps use inverse depth ``w = 1 / z`` (1/m), for two reasons: a plane is exactly linear in
(column, row, w), and the noise of disparity cameras is constant in w. So thresholds do not depend
on range, except near the camera (`discontinuity_at`).
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.geometry import DISCONTINUITY, NEAREST_M
from shapecat.jit import kernel
from shapecat.types import Camera

__all__ = [
    "BORDER_SHARE",
    "STRAIGHT_SHARE",
    "DepthGrid",
    "PinholeIntrinsics",
    "back_project",
    "discontinuity_at",
    "downsample",
    "find_borders",
    "project",
    "row_and_column",
    "smallest_object_at",
]

CELL_M = 0.0035
"""Target size of a cell, metres: small against the smallest object, larger than the noise."""
SMALL_M2 = 9e-4
"""Visible area of the smallest object, m²."""
MIN_CELLS = 20.0
"""Minimum number of cells of an object; fewer may be noise."""
ENOUGH_CELLS = 60.0
"""Upper bound of the minimum number of cells of an object; this many are enough at any depth."""
BORDER_SHARE = 0.12
"""Maximum width of a blank border, as a fraction of the image. A Kinect whose depth is registered
to its colour image leaves a tenth blank."""
STRAIGHT_SHARE = 0.3
"""Minimum extent of the samples along the inner edge of a border, as a fraction of the image side.
If it is less, the blank area merely ends at a tall object, and is not a border."""
LARGEST_FACTOR = 16
"""Upper bound of `DepthGrid.factor`."""
STEP_M = 0.004
"""Smallest step between two surfaces, metres. It matters only near the camera, where even a slanted
surface changes from cell to cell by more than a `DISCONTINUITY`."""
MAX_CELLS = 100_000
"""Maximum number of cells, to bound the time per frame. In larger images, cells are larger than
`CELL_M`."""


class PinholeIntrinsics(NamedTuple):
    """A pinhole camera in units of cells: cell (i, j) sees ((j - cx) / fx, (i - cy) / fy, 1)."""

    fx: float
    fy: float
    cx: float
    cy: float


class DepthGrid(NamedTuple):
    """A downsampled depth image; its elements are called cells, or samples if they have depth.

    Attributes
    ----------
    inverse_depth : (rows, columns) float32, 1/m; 0 where depth is missing.
    intrinsics : the camera in units of cells.
    factor : pixels along the edge of a cell.
    discontinuity : step in inverse depth that separates two surfaces, 1/m.
    """

    inverse_depth: F4
    intrinsics: PinholeIntrinsics
    factor: int
    discontinuity: float


def downsample(depth: F4, camera: Camera, *, range_m: float) -> DepthGrid | None:
    """Downsample a depth image: a cell averages the depths close to its nearest depth.

    Cells are about `CELL_M` wide at the median depth, and at least one pixel. Return None if no
    depth is in range. In an image larger than 50 x 50 pixels, only every fifth row and column is
    read for this and for the median.

    Parameters
    ----------
    depth : (h, w) metres, 0 where depth is missing.
    camera : the intrinsics of the image.
    range_m : depths beyond it, or below `NEAREST_M`, are ignored (thesis 4.2, pass-through filter).
    """
    sample = _sampled(depth, 5 if min(depth.shape) > 50 else 1, np.float32(range_m))
    if sample.size == 0:
        return None
    # The upper median; `numpy.median` takes twice as long.
    depth_m = float(np.partition(sample, sample.size // 2)[sample.size // 2])
    pixel_m = depth_m / max(abs(camera.fx), 1e-6)
    min_factor = math.sqrt(depth.size / MAX_CELLS)
    factor = round(
        min(max(CELL_M / max(pixel_m, 1e-9), min_factor, 1.0), LARGEST_FACTOR, *depth.shape)
    )
    shift = (factor - 1) / 2
    intrinsics = PinholeIntrinsics(
        camera.fx / factor,
        camera.fy / factor,
        (camera.cx - shift) / factor,
        (camera.cy - shift) / factor,
    )
    rows, columns = depth.shape[0] // factor, depth.shape[1] // factor
    inv_depth = np.zeros((rows, columns), np.float32)
    step = discontinuity_at(depth_m)
    _average(depth, factor, np.float32(range_m), np.float32(step), inv_depth)
    return DepthGrid(inv_depth, intrinsics, factor, step)


def discontinuity_at(depth_m: float) -> float:
    """Return the step in inverse depth, 1/m, that separates two surfaces at ``depth_m``, metres."""
    return max(DISCONTINUITY, STEP_M / depth_m**2)


@kernel
def _sampled(depth: F4, step: int, range_m: float) -> F4:
    """Return the depths in range at every ``step``-th row and column, (n,) metres.

    ``depth`` (height, width) and ``range_m`` are as in `downsample`.
    """
    rows, columns = depth.shape
    result = np.zeros((rows // step + 1) * (columns // step + 1), np.float32)
    n, one, min_depth = np.uint64(0), np.uint64(1), np.float32(NEAREST_M)
    for i in range(step // 2, rows, step):
        for j in range(np.uint64(step // 2), np.uint64(columns), np.uint64(step)):
            z = depth[i, j]
            result[n] = z
            n += one if (z >= min_depth) & (z <= range_m) else np.uint64(0)
    return result[:n]


@kernel(inner=True)
def row_and_column(p: int, columns: int) -> tuple[int, int]:
    """Return row and column of the cell with the flat index ``p`` = ``row * columns + column``."""
    i = int((p + 0.5) * (1.0 / columns))  # a multiplication is faster than a division
    return i, p - i * columns


@kernel(inner=True)
def back_project(k: PinholeIntrinsics, i: float, j: float, z: float) -> tuple[float, float]:
    """Return x and y, metres, of the point that cell (i, j) sees at the depth z."""
    return (j - k.cx) / k.fx * z, (i - k.cy) / k.fy * z


@kernel(inner=True)
def project(k: PinholeIntrinsics, x: float, y: float, z: float) -> tuple[int, int]:
    """Return row and column of the cell that sees a point; it may be outside the grid.

    The point ``x``, ``y``, ``z`` is in metres, in the frame of the grid's camera.
    """
    return math.floor(k.cy + k.fy * y / z + 0.5), math.floor(k.cx + k.fx * x / z + 0.5)


def smallest_object_at(grid: DepthGrid, depth_m: F4) -> F4:
    """Return the number of cells (n,) that the smallest object covers at each of the depths (n,).

    Its visible area is `SMALL_M2`; the result is at least `MIN_CELLS` and at most `ENOUGH_CELLS`.
    ``depth_m`` (n,) is in metres.
    """
    covered = SMALL_M2 * grid.intrinsics.fx**2 / depth_m.astype(np.float64) ** 2
    return np.clip(covered, MIN_CELLS, ENOUGH_CELLS).astype(np.float32)


@kernel
def find_borders(inv_depth: F4, band: int) -> I4:
    """Measure the blank border on each side of the image.

    A border is no wider than `BORDER_SHARE` of the image, and its inner edge is straight: the
    samples there extend over `STRAIGHT_SHARE` of the side.

    Parameters
    ----------
    inv_depth : (rows, columns) 1/m.
    band : number of lines, from the first that has a sample, in which the extent is measured.

    Returns
    -------
    (4,) number of blank lines at the top, bottom, left and right; 0 without a blank border.
    """
    borders = np.zeros(4, np.int64)
    for side in range(4):
        axis, back = side // 2, side % 2 > 0
        lines, length = inv_depth.shape[axis], inv_depth.shape[1 - axis]
        first, low, high = math.ceil(BORDER_SHARE * lines), length, -1
        for k in range(lines):
            if k >= first + (band if high >= 0 else 0):
                break
            line = lines - 1 - k if back else k
            for n in range(length):
                if (inv_depth[line, n] if axis == 0 else inv_depth[n, line]) > 0:
                    first = k if high < 0 else first
                    low, high = min(low, n), max(high, n)
        if high - low > STRAIGHT_SHARE * length:
            borders[side] = first
    return borders


@kernel
def _average(depth: F4, factor: int, range_m: float, jump: float, inv_depth: F4) -> None:
    """Write the inverse of each cell's mean depth, over the pixels close to its nearest pixel.

    ``depth`` (height, width) and ``range_m`` are as in `downsample`; ``factor`` and ``jump``
    (``discontinuity``) as in `DepthGrid`. Writes to ``inv_depth`` (rows, columns), 1/m.
    """
    if factor == 2:  # the usual case, in a form that vectorises
        _average_two(depth, range_m, jump, inv_depth)
        return
    rows, columns = inv_depth.shape
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    no_depth, min_depth = np.float32(1e9), np.float32(NEAREST_M)
    # ``parts`` are the pixels of a row of cells, grouped by their position in the cell, so that
    # loops vectorise.
    parts = np.zeros((factor * factor, columns), np.float32)
    scratch = np.zeros((4, columns), np.float32)
    nearest, limit, total, count = scratch[0], scratch[1], scratch[2], scratch[3]
    for i in range(rows):
        nearest[:] = no_depth
        for k in range(factor * factor):
            x, part = k % factor, parts[k]
            line = depth[i * factor + k // factor]
            for j in range(columns):
                z = line[x + factor * j]
                part[j] = z if (z >= min_depth) & (z <= range_m) else no_depth
                nearest[j] = part[j] if part[j] < nearest[j] else nearest[j]
        for j in range(columns):
            # The depth that is one discontinuity, in inverse depth, behind the nearest.
            slope = jump * nearest[j]
            behind = nearest[j] / (one - (slope if slope < half else half))
            limit[j] = behind if nearest[j] < no_depth else zero
        total[:], count[:] = zero, zero
        for k in range(factor * factor):
            part = parts[k]
            for j in range(columns):
                inlier = part[j] <= limit[j]
                total[j] += part[j] if inlier else zero
                count[j] += one if inlier else zero
        out = inv_depth[i]
        for j in range(columns):
            out[j] = count[j] / total[j] if count[j] > zero else zero


@kernel(inline=True)
def _average_two(depth: F4, range_m: float, jump: float, inv_depth: F4) -> None:
    """Do the work of `_average` for a ``factor`` of 2, in a form that vectorises."""
    rows, columns = inv_depth.shape
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    no_depth, min_depth = np.float32(1e9), np.float32(NEAREST_M)
    for i in range(rows):
        top, bottom, out = depth[2 * i], depth[2 * i + 1], inv_depth[i]
        for j in range(columns):
            a, b, c, d = top[2 * j], top[2 * j + 1], bottom[2 * j], bottom[2 * j + 1]
            a = a if (a >= min_depth) & (a <= range_m) else no_depth
            b = b if (b >= min_depth) & (b <= range_m) else no_depth
            c = c if (c >= min_depth) & (c <= range_m) else no_depth
            d = d if (d >= min_depth) & (d <= range_m) else no_depth
            ab, cd = (a if a < b else b), (c if c < d else d)
            nearest = ab if ab < cd else cd
            slope = jump * nearest
            limit = nearest / (one - (slope if slope < half else half))
            limit = limit if nearest < no_depth else zero
            total = (a if a <= limit else zero) + (b if b <= limit else zero)
            total += (c if c <= limit else zero) + (d if d <= limit else zero)
            count = (one if a <= limit else zero) + (one if b <= limit else zero)
            count += (one if c <= limit else zero) + (one if d <= limit else zero)
            out[j] = count / total if nearest < no_depth else zero
