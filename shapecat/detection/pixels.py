"""Pixels: labels of cells brought back to full resolution."""

from itertools import pairwise

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, U4, Bool
from shapecat.detection.cells import JUMP, NEAREST_M, Cells, Lens
from shapecat.detection.fill import FRINGE
from shapecat.detection.heights import LEAST_M, NOISE, inside
from shapecat.detection.hidden import spread_labels
from shapecat.detection.segmentation import Segmentation
from shapecat.detection.views import View
from shapecat.jit import kernel

__all__ = ["pixels_of", "points_of"]

MOST_LABELS = 1000
HIGHEST_M = 0.6
BLOCK = 64
"""Pixels that are looked at together: most have no label."""


def pixels_of(depth: F4, cells: Cells, found: Segmentation, *, range_m: float) -> list[U4]:
    """Return the ascending pixel indices of the labels 1, 2, ...

    A pixel takes the label of its cell, or else of the neighbour whose depth fits best; it keeps
    it only where it is above the plane itself, except in filled cells.
    """
    marks = np.zeros(depth.shape, np.int16)
    sizes = np.zeros(found.leaders.size, np.int64)
    _mark(
        depth,
        cells.w,
        found.labels,
        found.planes,
        found.owners,
        found.filled,
        cells.factor,
        range_m,
        marks,
        sizes,
    )
    return _sorted(marks.reshape(-1), sizes)


def points_of(view: View, found: Segmentation, *, fused: bool) -> list[U4]:
    """Return the ascending point indices of the labels, as `pixels_of`.

    With ``fused`` points behind the visible surface are given to what they touch; lists beyond
    the labels are clusters that touch nothing visible.
    """
    points, cells, first_new = view.points, view.cells, found.leaders.size
    marks = np.zeros(len(points), np.int16)
    sizes = np.zeros(first_new, np.int64)
    _mark_points(
        points,
        view.cell,
        cells.w,
        cells.lens,
        found.labels,
        found.planes,
        found.owners,
        found.filled,
        marks,
        sizes,
    )
    if fused:
        above = marks > 0
        for plane in found.planes:
            above |= _above(points, view.cell, cells.lens, plane)
        loose = np.flatnonzero(above)
        if loose.size:
            labels = spread_labels(points[loose], marks[loose].astype(np.int64), first_new)
            marks[loose] = np.where(labels <= MOST_LABELS, labels, 0)
            sizes = np.bincount(marks, minlength=first_new)
    return _sorted(marks, sizes)


@kernel
def _above(points: F4, cell: I4, lens: Lens, plane: F8) -> Bool:
    """Return which points are above a plane and inside its outline."""
    result = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        if cell[k] >= 0:
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            level = plane[0] * (lens.fx * x / z + lens.cx) + plane[1] * (lens.fy * y / z + lens.cy)
            h = (1 / z - level - plane[2]) * z * plane[3]
            result[k] = (
                h > LEAST_M + NOISE * z * z and h < HIGHEST_M and inside(plane, x, y, z, 0.0)
            )
    return result


def _sorted(marks: I4, sizes: I4) -> list[U4]:
    starts = np.zeros(sizes.size + 1, np.int64)
    np.cumsum(sizes[1:], out=starts[2:])
    # Label 0 has a list of size 0.
    order = np.zeros(int(starts[-1]), np.uint32)
    _sort(marks, starts[:-1].copy(), order)
    return [order[a:b] for a, b in pairwise(starts[1:])]


@kernel
def _near(labels: I4) -> U1:
    """Return 1 for the cells that have a label or are next to one that has."""
    rows, columns = labels.shape
    near = np.zeros(labels.shape, np.uint8)
    line = np.zeros(columns + 2, np.int16)
    for i in range(rows):
        above, here, below = labels[max(i - 1, 0)], labels[i], labels[min(i + 1, rows - 1)]
        for j in range(columns):
            line[j + 1] = above[j] | here[j] | below[j]
        out = near[i]
        for j in range(columns):
            out[j] = (line[j] | line[j + 1] | line[j + 2]) != 0
    return near


@kernel
def _mark(
    depth: F4,
    w: F4,
    labels: I4,
    planes: F8,
    owners: I4,
    filled: U1,
    factor: int,
    range_m: float,
    marks: I4,
    sizes: I4,
) -> None:
    rows, columns = w.shape
    shift, scale = (factor - 1) * 0.5, 1.0 / factor
    low, high = np.float32(NEAREST_M), np.float32(range_m)
    near = _near(labels)
    for i in range(rows):
        y1 = (i + 1) * factor if i + 1 < rows else depth.shape[0]
        for j in range(columns):
            if near[i, j] == 0:
                continue
            x1 = (j + 1) * factor if j + 1 < columns else depth.shape[1]
            here, mine, count = w[i, j], labels[i, j], 0
            sure = mine > 0 and (filled[i, j] or _is_high(planes, owners[mine], i, j, here))
            for y in range(i * factor, y1):
                for x in range(j * factor, x1):
                    z = depth[y, x]
                    if not ((z >= low) & (z <= high)):
                        continue
                    u, v = (x - shift) * scale, (y - shift) * scale
                    if _fits(here, z):
                        if sure or (mine > 0 and _rises(planes, owners[mine], u, v, z)):
                            marks[y, x] = mine
                            count += 1
                        continue
                    p = _best_beside(w, i, j, z)
                    if p < 0:
                        continue
                    ii, jj = p // columns, p % columns
                    label = labels[ii, jj]
                    if label > 0 and (filled[ii, jj] or _rises(planes, owners[label], u, v, z)):
                        marks[y, x] = label
                        sizes[label] += 1
            sizes[mine] += count


@kernel(leaf=True)
def _is_high(planes: F8, k: int, i: int, j: int, w: float) -> bool:
    """Whether every pixel that fits a cell is above plane k."""
    z = 1 / max(w - JUMP, 1e-3)
    level = planes[k, 0] * j + planes[k, 1] * i + planes[k, 2]
    level += 1.5 * (abs(planes[k, 0]) + abs(planes[k, 1]))  # the farthest pixel of a cell
    return bool((1 - max(level, 0.0) * z) * planes[k, 3] > LEAST_M + NOISE * z * z)


@kernel
def _mark_points(
    points: F4,
    cell: I4,
    w: F4,
    lens: Lens,
    labels: I4,
    planes: F8,
    owners: I4,
    filled: U1,
    marks: I4,
    sizes: I4,
) -> None:
    columns = w.shape[1]
    near = _near(labels).reshape(-1)
    for k in range(points.shape[0]):
        p = cell[k]
        if p < 0 or near[p] == 0:
            continue
        i, j, z = p // columns, p % columns, points[k, 2]
        if not _fits(w[i, j], z):
            p = _best_beside(w, i, j, z)
            if p < 0:
                continue
            i, j = p // columns, p % columns
        label = labels[i, j]
        u, v = lens.fx * points[k, 0] / z + lens.cx, lens.fy * points[k, 1] / z + lens.cy
        if label > 0 and (filled[i, j] or _rises(planes, owners[label], u, v, z)):
            marks[k] = label
            sizes[label] += 1


@kernel(leaf=True)
def _fits(w: float, z: float) -> bool:
    """Whether a depth is within one jump of a cell; both sides are multiplied by the depth."""
    return bool(abs(w * z - np.float32(1)) < np.float32(JUMP) * z)


@kernel(leaf=True)
def _best_beside(w: F4, i: int, j: int, z: float) -> int:
    """Return the flat neighbour of a cell whose depth fits best, -1 if none is within two jumps."""
    best, nearest = -1, np.float32(2 * JUMP) * z
    for ii in range(max(i - 1, 0), min(i + 2, w.shape[0])):
        for jj in range(max(j - 1, 0), min(j + 2, w.shape[1])):
            gap = abs(w[ii, jj] * z - np.float32(1))
            if gap < nearest:
                nearest, best = gap, ii * w.shape[1] + jj
    return best


@kernel(leaf=True)
def _rises(planes: F8, k: int, u: float, v: float, z: float) -> bool:
    """Whether a depth at column u, row v is above plane k, if only as a foot is."""
    h = (1 - (planes[k, 0] * u + planes[k, 1] * v + planes[k, 2]) * z) * planes[k, 3]
    return bool(h > FRINGE * (LEAST_M + NOISE * z * z))


@kernel(leaf=True)
def _sort(marks: I4, next_place: I4, order: U4) -> None:
    for start in range(0, marks.size, BLOCK):
        block = marks[start : start + BLOCK]
        some = np.int16(0)
        for k in range(block.size):
            some |= block[k]
        if some == 0:
            continue
        for k in range(block.size):
            label = block[k]
            if label > 0:
                order[next_place[label]] = start + k
                next_place[label] += 1
