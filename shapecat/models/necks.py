"""Segments for training, split where a narrow neck joins two wider parts.

The trees that merge segments thus learn from more and smaller segments than detection produces,
above all from pairs of similar objects that touch.
"""

import numpy as np

from shapecat.arrays import I4, U1
from shapecat.detection.connected_components import DOWN, RIGHT
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.jit import kernel, unset

__all__ = ["split_necks"]

SIDE, DIAGONAL = 3, 4
"""Chamfer distances from a cell to its neighbours, in thirds of a cell."""
NECK = 1.7
"""A region is split at a neck if the parts on both sides are at least this many times as wide."""


@kernel
def split_necks(graph: SurfaceGraph, labels: I4, n: int) -> int:
    """Split labelled regions at narrow necks; return the new number of labels.

    Two round objects that touch share a narrow bridge, in which the concave edge between them ends.
    Cells are visited by their distance from the border, the innermost first. A cell with no visited
    neighbour starts a basin; any other joins a basin beside it. Where two basins meet, they are
    merged, unless both are much wider than the region is there, and the narrower one is not tiny.

    Parameters
    ----------
    graph : the links between cells; regions end where links are missing.
    labels : (rows, columns) 1..n, 0 elsewhere; changed in place.
    n : number of labels.

    Source: Meyer 1991 (watershed of the distance transform).
    """
    links, spans, columns = graph.links, graph.spans, labels.shape[1]
    distance, count = _distances(links, spans, labels)
    flat, depth, link = labels.reshape(-1), distance.reshape(-1), links.reshape(-1)
    cells = _inner_first(depth, flat, spans, columns, count)
    basin, parent = unset(flat.size, np.int32), unset(count + 1, np.int32)
    for p in cells:
        basin[p] = 0
    peak, size = unset(count + 1, np.int32), unset(count + 1, np.int32)
    last = 0
    for p in cells:
        own, d = 0, depth[p]
        for k in range(4):
            q = p + (columns if k & 1 else 1) * (1 if k < 2 else -1)
            if q < 0 or q >= flat.size or flat[q] != flat[p] or basin[q] == 0:
                continue
            if not link[min(p, q)] & (DOWN if k & 1 else RIGHT):
                continue
            other = _root(parent, basin[q])
            if own == 0:
                own = other
            if own == other:
                continue
            low, high = (own, other) if peak[own] < peak[other] else (other, own)
            own = high
            if peak[low] < NECK * d or size[low] < SEGMENTATION.min_cells:
                parent[low] = high
                size[high] += size[low]
        if own == 0:
            last += 1
            own = last
            parent[own], peak[own], size[own] = own, d, 0
        basin[p] = own
        size[own] += 1
    return int(_number(cells, basin, parent, size, last, flat, n))


@kernel
def _distances(links: U1, spans: I4, labels: I4) -> tuple[I4, int]:
    """Return the distance of labelled cells from the border of their label, and the cell count.

    The distances (rows, columns) are in thirds of a cell, and uninitialised outside the labels.
    ``labels`` are (rows, columns); ``links`` and ``spans`` are as in `SurfaceGraph`.
    """
    (rows, columns), count = labels.shape, 0
    distance = unset(labels.shape, np.int16)
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            one = labels[i, j]
            if one <= 0:
                continue
            count += 1
            distance[i, j] = SIDE
            if not (0 < i < rows - 1 and 0 < j < columns - 1):
                continue
            linked = links[i, j] & links[i, j - 1] & RIGHT and links[i, j] & links[i - 1, j] & DOWN
            if (
                linked
                and labels[i, j + 1] == one
                and labels[i, j - 1] == one
                and labels[i + 1, j] == one
                and labels[i - 1, j] == one
            ):
                beside = min(distance[i, j - 1], distance[i - 1, j]) + SIDE
                left = distance[i - 1, j - 1] if labels[i - 1, j - 1] == one else 0
                right = distance[i - 1, j + 1] if labels[i - 1, j + 1] == one else 0
                distance[i, j] = min(beside, min(left, right) + DIAGONAL)
    for i in range(rows - 2, 0, -1):
        for j in range(min(spans[i, 1], columns - 1) - 1, max(spans[i, 0], 1) - 1, -1):
            one = labels[i, j]
            if one <= 0 or distance[i, j] <= SIDE:
                continue
            beside = min(distance[i, j + 1], distance[i + 1, j]) + SIDE
            left = distance[i + 1, j - 1] if labels[i + 1, j - 1] == one else 0
            right = distance[i + 1, j + 1] if labels[i + 1, j + 1] == one else 0
            distance[i, j] = min(distance[i, j], beside, min(left, right) + DIAGONAL)
    return distance, count


@kernel
def _inner_first(distance: I4, labels: I4, spans: I4, columns: int, count: int) -> I4:
    """Return the flat indices (count,) of the labelled cells, farthest from their border first.

    ``distance`` and ``count`` are from `_distances`; ``distance`` and ``labels`` are flattened
    images, ``columns`` wide. ``spans`` are as in `SurfaceGraph`.
    """
    deepest = 0
    for i in range(len(spans)):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            if labels[p] > 0:
                deepest = max(deepest, distance[p])
    ends = np.zeros(deepest + 2, np.int32)
    for i in range(len(spans)):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            if labels[p] > 0:
                ends[distance[p]] += 1
    for d in range(deepest, 0, -1):
        ends[d - 1] += ends[d]
    cells: I4 = unset(count, np.int32)
    for i in range(len(spans)):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            if labels[p] > 0:
                ends[distance[p]] -= 1
                cells[ends[distance[p]]] = p
    return cells


@kernel(inner=True)
def _root(parent: I4, basin: int) -> int:
    """Return the root of a basin in a union-find forest, ``parent`` (k,)."""
    while parent[basin] != basin:
        parent[basin] = parent[parent[basin]]
        basin = parent[basin]
    return basin


@kernel
def _number(cells: I4, basin: I4, parent: I4, size: I4, last: int, labels: I4, n: int) -> int:
    """Relabel the cells by basin, in place; return the new number of labels.

    ``cells`` (count,) are flat indices; ``basin`` is that of each cell, flattened like ``labels``.
    ``parent`` (k,) joins the basins 1..last; ``size`` (k,) is their number of cells. The largest
    basin of each label 1..n keeps the label; the others get new ones, until there are
    `max_segments` labels, and then keep theirs, too.
    """
    label, largest = unset(last + 1, np.int16), np.zeros(n + 1, np.int32)
    for p in cells:
        root = _root(parent, basin[p])
        basin[p] = root
        old = labels[p]
        if largest[old] == 0 or size[root] > size[largest[old]]:
            largest[old] = root
    for k in range(1, last + 1):
        label[k] = 0
    for k in range(1, n + 1):
        if largest[k] > 0:
            label[largest[k]] = k
    for p in cells:
        root = basin[p]
        if label[root] == 0:
            if n < SEGMENTATION.max_segments:
                n += 1
                label[root] = n
            else:
                label[root] = labels[p]
        labels[p] = label[root]
    return n
