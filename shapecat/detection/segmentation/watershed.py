"""Watershed: segments of surface bounded by depth discontinuities and concave edges."""

from collections.abc import Callable

import numpy as np

from shapecat.arrays import I4, U1, Bool
from shapecat.detection.connected_components import DOWN, RIGHT, connected_components, spans_of
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.jit import kernel, unset

__all__ = ["SeedSplitter", "watershed"]

NO_EDGE = 255
"""Concave angle that no edge reaches, degrees."""
BUCKETS = 256 // SEGMENTATION.bucket_deg
"""Number of ranges of concave angles."""
SeedSplitter = Callable[[SurfaceGraph, I4, int], int]
"""A function that gets (graph, labels, n), splits the seeds 1..n of ``labels`` (rows, columns) in
place, and returns the new n."""
LEFT, UP = 4, 8
"""Bits of links to the other two neighbours, in addition to `RIGHT` and `DOWN`."""


def watershed(
    heights: HeightMap, graph: SurfaceGraph, *, split_seeds: SeedSplitter | None = None
) -> tuple[I4, int]:
    """Split the object cells into segments at depth discontinuities and concave edges.

    Each connected component of flat cells is a seed. A flood from the seeds, flattest cells first,
    assigns the cells of concave edges to the segments beside them (Meyer 1991). Parts that it does
    not reach become segments too, unless they are small. ``split_seeds`` may split the seeds first.
    Returns the labels 1..n, 0 elsewhere, (rows, columns) int16, and n.
    """
    labels = np.zeros(heights.plane_id.shape, np.int16)
    n = _label_parts(heights.plane_id, graph, SEGMENTATION.edge_deg, labels, 0)
    if split_seeds is not None:
        n = split_seeds(graph, labels, n)
    _flood_labels(graph.links, graph.concavity, graph.spans, labels)
    return labels, _label_parts(heights.plane_id, graph, NO_EDGE, labels, n)


@kernel
def _label_parts(plane_id: I4, graph: SurfaceGraph, edge_deg: int, labels: I4, n: int) -> int:
    """Label connected parts of unlabelled cells with concavity below ``edge_deg``, from ``n`` + 1.

    Parts that `_min_size` does not choose stay unlabelled. Returns the last label. ``plane_id`` is
    as in `HeightMap`; ``labels`` (rows, columns), 0 where unlabelled, is changed in place.
    """
    inside: Bool = np.zeros(labels.shape, np.bool_)
    concavity, spans, threshold = graph.concavity, graph.spans, np.uint8(edge_deg)
    for i in range(len(spans)):
        for j in range(np.uint64(spans[i, 0]), np.uint64(spans[i, 1])):  # this vectorises
            flat = concavity[i, j] < threshold
            inside[i, j] = (plane_id[i, j] > 0) & (labels[i, j] == 0) & flat
    spans, component = spans_of(inside.view(np.int8)), unset(labels.shape, np.int32)
    sizes = connected_components(inside, graph.links, spans, component)
    new_labels, (min_size, ties) = np.zeros(sizes.size, np.int16), _min_size(sizes, n)
    for k in range(1, sizes.size):
        tie = sizes[k] == min_size and ties > 0
        if sizes[k] > min_size or tie:
            n, ties = n + 1, ties - tie
            new_labels[k] = n
    for i in range(len(spans)):
        for j in range(spans[i, 0], spans[i, 1]):
            labels[i, j] |= new_labels[component[i, j]]
    return n


@kernel(inline=True)
def _min_size(sizes: I4, n: int) -> tuple[int, int]:
    """Choose the largest components, as many as there is room for beside ``n`` segments.

    Those with fewer cells than `SegmentationSettings.min_cells` are never chosen. ``sizes`` (k,)
    are the sizes of components 1..k - 1. Returns a size and a number: all larger components are
    chosen, and this many of exactly that size.
    """
    min_size, room = SEGMENTATION.min_cells - 1, SEGMENTATION.max_segments - n
    while True:
        larger, smallest = 0, np.iinfo(np.int32).max
        for k in range(1, sizes.size):
            if sizes[k] > min_size:
                larger, smallest = larger + 1, min(smallest, sizes[k])
        if larger <= room:
            return min_size, room - larger if min_size >= SEGMENTATION.min_cells else 0
        min_size = smallest


@kernel
def _flood_labels(links: U1, concavity: U1, spans: I4, labels: I4) -> None:
    """Grow labels (rows, columns) along links, in place, over flat cells first.

    Flat cells have small concave angles. There is a queue of cells for each range of angles, as a
    linked list. The other parameters are as in `SurfaceGraph`.
    """
    columns, size = labels.shape[1], labels.size
    angle, flat = concavity.reshape(-1), labels.reshape(-1)
    directions = unset(size, np.uint8)
    _find_directions(links.reshape(-1), flat, spans, columns, directions)
    # The successor of each cell in its queue, -1 for the last; then the heads of the queues.
    following = unset(size + BUCKETS, np.int32)
    following[size:] = -1
    last = np.arange(size, size + BUCKETS)
    for i in range(len(spans)):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            if directions[p] > 0 and flat[p] > 0:
                following[last[0]], last[0], following[p] = p, p, -1
    for bucket in range(BUCKETS):
        p = following[size + bucket]
        while p >= 0:
            for d in range(4):
                if not directions[p] >> d & 1:
                    continue
                q = p + (columns if d & 1 else 1) * (1 if d < 2 else -1)
                if flat[q] <= 0:
                    flat[q] = flat[p]
                    queue = max(bucket, angle[q] // SEGMENTATION.bucket_deg)
                    following[last[queue]], last[queue], following[q] = q, q, -1
            p = following[p]


@kernel(inline=True)
def _find_directions(links: U1, labels: I4, spans: I4, columns: int, directions: U1) -> None:
    """Write bits for the directions in which each cell (n,) is linked with an unlabelled cell.

    ``links`` and ``labels`` are flattened, ``spans`` as in `SurfaceGraph`; the bits are `RIGHT`,
    `DOWN`, `LEFT` and `UP`. The loops vectorise, because unsigned indices need no check for
    negative values.
    """
    one, below = np.uint64(1), np.uint64(columns)
    right, down, left, up = np.uint8(RIGHT), np.uint8(DOWN), np.uint8(LEFT), np.uint8(UP)
    none = np.uint8(0)
    for i in range(len(spans)):
        first, end = np.uint64(i * columns + spans[i, 0]), np.uint64(i * columns + spans[i, 1])
        if first == end:
            continue
        directions[end - one] = none
        for p in range(first, end - one):
            directions[p] = links[p] & right if labels[p + one] <= 0 else none
        for p in range(first + one, end):
            directions[p] |= left if (links[p - one] & right > 0) & (labels[p - one] <= 0) else none
        for p in range(first, end if i + 1 < len(spans) else first):
            directions[p] |= links[p] & down if labels[p + below] <= 0 else none
        for p in range(first, end if i > 0 else first):
            directions[p] |= (
                up if (links[p - below] & down > 0) & (labels[p - below] <= 0) else none
            )
