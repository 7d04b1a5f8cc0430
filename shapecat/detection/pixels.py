"""Pixels: labels of cells brought back to full resolution."""

from itertools import pairwise

import numpy as np

from shapecat.arrays import F4, F8, I4, U4, Bool
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
SURE_M = 0.03
"""A reading within one jump of a cell this high is above the plane itself."""


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
        found.heights,
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
    starts = np.concatenate([[0, 0], np.cumsum(sizes[1:])])
    # Label 0 has a list of size 0.
    order = np.zeros(int(starts[-1]), np.uint32)
    _sort(marks, starts[:-1].copy(), order)
    return [order[a:b] for a, b in pairwise(starts[1:])]


@kernel
def _mark(
    depth: F4,
    w: F4,
    labels: I4,
    heights: F4,
    planes: F8,
    owners: I4,
    filled: I4,
    factor: int,
    range_m: float,
    marks: I4,
    sizes: I4,
) -> None:
    rows, columns = w.shape
    shift = (factor - 1) * 0.5
    jump = np.float32(JUMP)
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        y1 = (i + 1) * factor if i + 1 < rows else depth.shape[0]
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            label = labels[i, j]
            nearby = label | labels[above, j] | labels[below, j] | labels[i, left]
            nearby |= labels[i, right] | labels[above, left] | labels[above, right]
            nearby |= labels[below, left] | labels[below, right]
            if nearby == 0:
                continue
            v0 = w[i, j]
            sure = label > 0 and (heights[i, j] > SURE_M or filled[i, j] > 0)
            # Depths within one jump of the cell.
            z0 = np.float32(1) / (v0 + jump)
            z1 = np.float32(1) / (v0 - jump) if v0 > jump else np.float32(np.inf)
            x1 = (j + 1) * factor if j + 1 < columns else depth.shape[1]
            for y in range(i * factor, y1):
                for x in range(j * factor, x1):
                    z = depth[y, x]
                    if sure & (z > z0) & (z < z1) & (z <= range_m):
                        marks[y, x] = label
                        sizes[label] += 1
                    elif (z >= NEAREST_M) & (z <= range_m):
                        chosen = _choose(
                            w,
                            labels,
                            planes,
                            owners,
                            filled,
                            i,
                            j,
                            1.0 / z,
                            (x - shift) / factor,
                            (y - shift) / factor,
                        )
                        if chosen > 0:
                            marks[y, x] = chosen
                            sizes[chosen] += 1


@kernel
def _mark_points(
    points: F4,
    cell: I4,
    w: F4,
    lens: Lens,
    labels: I4,
    planes: F8,
    owners: I4,
    filled: I4,
    marks: I4,
    sizes: I4,
) -> None:
    columns = w.shape[1]
    for k in range(points.shape[0]):
        if cell[k] < 0:
            continue
        i, j, v = cell[k] // columns, cell[k] % columns, 1.0 / points[k, 2]
        x, y = lens.fx * points[k, 0] * v + lens.cx, lens.fy * points[k, 1] * v + lens.cy
        label = _choose(w, labels, planes, owners, filled, i, j, v, x, y)
        if label > 0:
            marks[k] = label
            sizes[label] += 1


@kernel
def _choose(
    w: F4,
    labels: I4,
    planes: F8,
    owners: I4,
    filled: I4,
    i: int,
    j: int,
    v: float,
    x: float,
    y: float,
) -> int:
    """Return the label of a reading ``v`` at column x, row y of cell (i, j), or 0."""
    bi, bj = i, j
    if not ((abs(w[i, j] - v) < JUMP) & (w[i, j] > 0)):
        nearest = 2 * JUMP
        for ii in range(max(i - 1, 0), min(i + 2, w.shape[0])):
            for jj in range(max(j - 1, 0), min(j + 2, w.shape[1])):
                gap = abs(w[ii, jj] - v)
                if gap < nearest:
                    nearest, bi, bj = gap, ii, jj
        if nearest >= 2 * JUMP:
            return 0
    label = int(labels[bi, bj])
    if label == 0 or filled[bi, bj]:
        return label
    plane = planes[owners[label]]
    z = 1.0 / v
    h = (v - plane[0] * x - plane[1] * y - plane[2]) * z * plane[3]
    return label if h > FRINGE * (LEAST_M + NOISE * z * z) else 0


@kernel
def _sort(marks: I4, next_place: I4, order: U4) -> None:
    for p in range(marks.size):
        label = marks[p]
        if label > 0:
            order[next_place[label]] = p
            next_place[label] += 1
