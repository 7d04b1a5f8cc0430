"""Watershed: segments of surface bounded by depth discontinuities and concave edges."""

import numpy as np

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.detection.connected_components import DOWN, RIGHT, connected_components
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.jit import kernel, unset

__all__ = ["relabel", "relabel_above", "watershed"]

BUCKETS = 256 // SEGMENTATION.bucket_deg


def watershed(heights: HeightMap, graph: SurfaceGraph, *, concave: bool) -> tuple[I4, int]:
    """Label the object cells: (rows, columns) int16 labels 1..n, 0 elsewhere, and n.

    Flat cells that are linked make a seed; a flood from the seeds, flattest cells first, gives
    the cells of an edge to its sides (Meyer 1991). With ``concave`` off only depth discontinuities
    part segments.
    """
    labels = np.zeros(heights.plane_id.shape, np.int16)
    n = _label_parts(heights.plane_id, graph, SEGMENTATION.edge_deg if concave else 256, labels, 0)
    _flood_labels(graph.links, graph.concavity, graph.spans, labels)
    return labels, _label_parts(heights.plane_id, graph, 256, labels, n)


@kernel
def _label_parts(plane_id: I4, graph: SurfaceGraph, edge_deg: int, labels: I4, n: int) -> int:
    """Label connected unlabelled cells with smaller angles, from ``n`` + 1 on; return the last."""
    spans, component = graph.spans, unset(labels.shape, np.int32)
    inside: Bool = np.zeros(labels.shape, np.bool_)
    for i in range(len(spans)):
        for j in range(spans[i, 0], spans[i, 1]):
            inside[i, j] = (plane_id[i, j] > 0) & (labels[i, j] == 0)
            inside[i, j] &= graph.concavity[i, j] < edge_deg
    sizes = connected_components(inside, graph.links, spans, component)
    names = np.zeros(sizes.size, np.int16)
    for k in range(1, sizes.size):
        if sizes[k] >= SEGMENTATION.least_cells and n < SEGMENTATION.most_segments:
            n += 1
            names[k] = n
    for i in range(len(spans)):
        for j in range(spans[i, 0], spans[i, 1]):
            if inside[i, j]:
                labels[i, j] = names[component[i, j]]
    return n


@kernel
def _flood_labels(links: U1, concavity: U1, spans: I4, labels: I4) -> None:
    """Grow the labels over links, cells with small concave angles first."""
    columns = labels.shape[1]
    flat_links, angle, flat = links.reshape(-1), concavity.reshape(-1), labels.reshape(-1)
    queue = unset((3, max(flat.size, BUCKETS)), np.int32)
    queue[0, :BUCKETS] = -1
    for i in range(labels.shape[0]):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            some = False
            for d in range(4 if flat[p] > 0 else 0):
                q = _linked(flat_links, p, d, columns)
                some |= q >= 0 and flat[q] <= 0
            if some:
                _append(queue, 0, p)
    now = 0
    while now < BUCKETS:
        p = queue[0, now]
        if p < 0:
            now += 1
            continue
        queue[0, now] = queue[2, p]
        for d in range(4):
            q = _linked(flat_links, p, d, columns)
            if q >= 0 and flat[q] <= 0:
                flat[q] = flat[p]
                _append(queue, max(now, angle[q] // SEGMENTATION.bucket_deg), q)


@kernel
def _linked(links: U1, p: int, d: int, columns: int) -> int:
    """Return the neighbour of a flat cell on the right, below, left or above; -1 if not linked."""
    step, way = (columns, DOWN) if d & 1 else (1, RIGHT)
    from_ = p if d < 2 else p - step
    if from_ < 0 or not links[from_] & way:
        return -1
    return p + step if d < 2 else from_


@kernel
def _append(queue: I4, bucket: int, p: int) -> None:
    """Append a flat cell to a bucket of a queue: rows are the first of each, the last, the next."""
    if queue[0, bucket] < 0:
        queue[0, bucket] = p
    else:
        queue[2, queue[1, bucket]] = p
    queue[1, bucket], queue[2, p] = p, -1


@kernel
def relabel(labels: I4, spans: I4, names: I4) -> None:
    """Give labels (rows, columns) their new names (n,), in place; that of 0 is 0."""
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            labels[i, j] = names[labels[i, j]]


@kernel
def relabel_above(labels: I4, spans: I4, height: F4, label: int, level: float, name: int) -> None:
    """Give the cells of a label that are higher than a level, metres, another name, in place."""
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            if labels[i, j] == label and height[i, j] > level:
                labels[i, j] = name
