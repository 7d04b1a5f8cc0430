"""Hole filling: cells of objects at the level of their plane, such as the floors of bowls."""

import numpy as np

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.connected_components import (
    DOWN,
    RIGHT,
    SIDES,
    connected_components,
    spans_of,
)
from shapecat.detection.depth_grid import DepthGrid
from shapecat.jit import kernel, unset

__all__ = ["fill_holes"]

BOUNDARY, IN_FRONT, CONTINUOUS = range(3)
"""Indices of three counts of the sides that a hole shares with a label: all sides, those where the
label is in front of the hole, and those where the surface continues."""


@kernel
def fill_holes(grid: DepthGrid, labels: I4, count: int, filled: U1) -> None:
    """Give the cells of holes the label of the object around them, in place.

    A hole is a connected component of unlabelled samples between labels. It is filled if most of
    its boundary has one label, and all other labels on the boundary are in front of it. In
    addition, the surface must continue into the hole, or the hole must be large and closed: the
    table between the grip and the base of a drill is not part of it.

    Parameters
    ----------
    labels : (rows, columns) objects 1..count, 0 elsewhere; changed in place.
    count : the number of objects.
    filled : (rows, columns) uint8, set to 1 in the filled cells.
    """
    inside, spans = _between_labels(grid.inverse_depth, labels)
    component = unset(labels.shape, np.int32)
    links = np.full(labels.shape, RIGHT | DOWN, np.uint8)
    n = connected_components(inside, links, spans, component).size
    sides, total = np.zeros((n, count + 1, 3), np.int32), np.zeros(n, np.int64)
    owner, area = np.zeros(n, np.int16), np.zeros(n, np.int64)
    _count_sides(grid, labels, inside, spans, component, sides, total, area)
    label_area = np.zeros(count + 1, np.int64)
    if n > 1:
        _count_label_cells(labels, spans, label_area)
    for p in range(1, n):
        owner[p] = _owner_of(sides[p], total[p], area[p], label_area)
    for i in range(len(spans)):
        for j in range(spans[i, 0], spans[i, 1]):
            if owner[component[i, j]] > 0:
                labels[i, j] = owner[component[i, j]]
                filled[i, j] = 1


@kernel(inline=True)
def _between_labels(inv_depth: F4, labels: I4) -> tuple[Bool, I4]:
    """Return where unlabelled samples are between labels, and the span of the labels in each row.

    A sample is between labels if a label lies in each of the four directions. The results are
    (rows, columns) and (rows, 2); ``inv_depth`` and ``labels`` are (rows, columns).
    """
    rows, columns = labels.shape
    first, last = np.full(columns, rows, np.int32), np.full(columns, -1, np.int32)
    inside, spans = np.zeros(labels.shape, np.bool_), spans_of(labels)
    for i in range(rows):
        row = np.int32(i)
        for j in range(np.uint64(spans[i, 0]), np.uint64(spans[i, 1])):  # these vectorise
            first[j] = row if (labels[i, j] > 0) & (row < first[j]) else first[j]
            last[j] = row if labels[i, j] > 0 else last[j]
    for i in range(rows):
        row = np.int32(i)
        for j in range(np.uint64(spans[i, 0]), np.uint64(spans[i, 1])):
            between = (first[j] < row) & (row < last[j])
            inside[i, j] = (labels[i, j] == 0) & (inv_depth[i, j] > 0) & between
    return inside, spans


@kernel(inline=True)
def _count_sides(
    grid: DepthGrid,
    labels: I4,
    inside: Bool,
    spans: I4,
    component: I4,
    sides: I4,
    total: I4,
    area: I4,
) -> None:
    """Count, in place, the cells of the holes 1..n - 1, and the sides of cells on their boundary.

    ``sides`` (n, labels, 3) holds the counts `BOUNDARY`, `IN_FRONT` and `CONTINUOUS` of the sides
    with each label; ``total`` (n,) also counts sides without a label. ``area`` (n,) counts cells.
    ``inside`` and ``spans`` are from `_between_labels`; ``component`` (rows, columns) is the hole
    of each cell inside. Cells without depth beyond a side are skipped: the label after them counts,
    and they are added to the area, once for each such side.
    """
    inv_depth, jump = grid.inverse_depth, grid.discontinuity
    for i in range(len(spans)):
        for j in range(spans[i, 0], spans[i, 1]):
            if not inside[i, j]:
                continue
            p, w = component[i, j], inv_depth[i, j]
            area[p] += 1
            for di, dj in SIDES:
                y, x = i + di, j + dj
                missing = inv_depth[y, x] <= 0 and labels[y, x] == 0
                while inv_depth[y, x] <= 0 and labels[y, x] == 0:  # there is a label at the end
                    y, x = y + di, x + dj
                    area[p] += 1
                label, neighbour_w = labels[y, x], inv_depth[y, x]
                if label > 0:
                    sides[p, label, BOUNDARY] += 1
                    sides[p, label, IN_FRONT] += neighbour_w > w + jump
                    sides[p, label, CONTINUOUS] += abs(neighbour_w - w) < jump
                total[p] += label > 0 or missing or not inside[y, x]


@kernel(inline=True)
def _count_label_cells(labels: I4, spans: I4, area: I4) -> None:
    """Add up the cells of each label in ``area`` (labels,); ``spans`` is from `_between_labels`."""
    for i in range(len(spans)):
        for j in range(spans[i, 0], spans[i, 1]):
            area[labels[i, j]] += 1


@kernel(inline=True)
def _owner_of(sides: I4, total: int, area: int, label_area: I4) -> int:
    """Return the label that a hole belongs to; 0 if there is none.

    ``sides`` (labels, 3), ``total`` and ``area`` are the counts of the hole from `_count_sides`;
    ``label_area`` (labels,) is the number of cells of each label.
    """
    best = 0
    for k in range(1, len(sides)):
        best = k if sides[k, BOUNDARY] > sides[best, BOUNDARY] else best
    if sides[best, BOUNDARY] <= CLEANUP.enclosed_share * total:
        return 0
    # In a cup seen from above, the inner wall is hidden, but the mouth is large, and closed.
    mouth = sides[best, BOUNDARY] == total and area > CLEANUP.mouth_share * label_area[best]
    if sides[best, CONTINUOUS] <= CLEANUP.continuous_share * total and not mouth:
        return 0
    for k in range(1, len(sides)):
        if k != best and sides[k, IN_FRONT] < sides[k, BOUNDARY]:
            return 0
    return int(best)
