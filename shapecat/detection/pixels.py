"""Pixels: labels of cells brought back to full resolution."""

import numpy as np

from shapecat.arrays import F4, F8, I4, U4
from shapecat.detection.cells import JUMP, NEAREST_M, Cells, Lens
from shapecat.detection.heights import LEAST_M, NOISE
from shapecat.jit import kernel

__all__ = ["pixels_of", "points_of"]


def pixels_of(
    depth: F4, cells: Cells, labels: I4, planes: F8, owners: I4, filled: I4, *, range_m: float
) -> list[U4]:
    """Return the ascending pixel indices of the labels 1, 2, ... of ``labels`` (rows, columns).

    A pixel takes the label of its cell, or else of the neighbour whose depth fits best; it keeps
    it only where it is above the plane itself, except in ``filled`` cells.
    """
    count = int(labels.max(initial=0))
    marks = np.zeros(depth.shape, np.int16)
    sizes = np.zeros(count + 1, np.int64)
    _mark(depth, cells.w, labels, planes, owners, filled, cells.factor, range_m, marks, sizes)
    return _sorted(marks.reshape(-1), sizes)


def points_of(
    points: F4, cell: I4, cells: Cells, labels: I4, planes: F8, owners: I4, filled: I4
) -> list[U4]:
    """Return the ascending point indices of the labels, as `pixels_of`.

    ``points`` (n, 3) are in the frame of the virtual camera, ``cell`` (n,) their cells.
    """
    count = int(labels.max(initial=0))
    marks = np.zeros(len(points), np.int16)
    sizes = np.zeros(count + 1, np.int64)
    _mark_points(points, cell, cells.w, cells.lens, labels, planes, owners, filled, marks, sizes)
    return _sorted(marks, sizes)


def _sorted(marks: I4, sizes: I4) -> list[U4]:
    starts = np.concatenate([[0], np.cumsum(sizes)])
    order = np.zeros(int(starts[-1]), np.uint32)
    _sort(marks, starts[:-1].copy(), order)
    return [order[a:b] for a, b in zip(starts[1:-1], starts[2:], strict=True)]


@kernel
def _mark(
    depth: F4,
    w: F4,
    labels: I4,
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
    for y in range(depth.shape[0]):
        i = min(y // factor, rows - 1)
        up, down = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            any_label = labels[i, j] | labels[up, j] | labels[down, j]
            any_label |= labels[i, left] | labels[i, right]
            if any_label == 0:
                continue
            stop = (j + 1) * factor if j + 1 < columns else depth.shape[1]
            for x in range(j * factor, stop):
                z = depth[y, x]
                if not ((z >= NEAREST_M) & (z <= range_m)):
                    continue
                label = _choose(
                    w, labels, planes, owners, filled, i, j, 1.0 / z,
                    (x - shift) / factor, (y - shift) / factor,
                )
                if label > 0:
                    marks[y, x] = label
                    sizes[label] += 1


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
    label = labels[bi, bj]
    if label == 0 or filled[bi, bj]:
        return label
    plane = planes[owners[label]]
    z = 1.0 / v
    h = (v - plane[0] * x - plane[1] * y - plane[2]) * z * plane[3]
    return label if h > LEAST_M + NOISE * z * z else 0


@kernel
def _sort(marks: I4, next_place: I4, order: U4) -> None:
    for p in range(marks.size):
        label = marks[p]
        if label > 0:
            order[next_place[label]] = p
            next_place[label] += 1
