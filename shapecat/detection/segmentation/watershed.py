"""Watershed: segments of surface bounded by depth discontinuities and concave edges."""

import numpy as np

from shapecat.arrays import F4, I4, U1
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import DOWN, RIGHT, SurfaceGraph
from shapecat.jit import kernel, unset

__all__ = ["relabel", "relabel_above", "watershed"]

EDGE_DEG = 27
"""Concave angle that may part two objects; a bowl of 7 cm turns 16 degrees over the same cells."""
WEAK_DEG, NO_EDGE_DEG = 17, 256
"""Concave angle that continues such an edge; one that no edge has, for angles are in 8 bits."""
RIDGE, RIDGE_CELLS = 0.5, 5
"""Share of its angle that is left of an edge so far to either side of it."""
LEAST_CELLS, MOST_REGIONS = 12, 250
"""Smaller parts are scraps, that belong to what is around them; the number bounds the time."""
BUCKET_DEG = 4
"""Angles that differ less are flooded in one go."""


def watershed(heights: HeightMap, graph: SurfaceGraph, *, concave: bool) -> tuple[I4, int]:
    """Label the object cells: (rows, columns) int16 labels 1..n, 0 elsewhere, and n.

    Flat cells that are linked make a seed; a flood from the seeds, flattest cells first, gives
    the cells of an edge to its sides (Meyer 1991). With ``concave`` off only jumps part regions.
    """
    plane_id, links, concavity, spans = heights.plane_id, graph.links, graph.concavity, graph.spans
    labels = np.zeros(plane_id.shape, np.int16)
    barrier = np.zeros(plane_id.shape, np.uint8)
    stack, part = unset(plane_id.size, np.int32), unset(plane_id.shape, np.int32)
    _concave_edges(concavity, spans, EDGE_DEG if concave else NO_EDGE_DEG, barrier, stack)
    n = _flat_parts(plane_id, spans, links, barrier, labels, 0, part)
    _flood_labels(links, concavity, spans, labels, stack)
    barrier[:] = 0
    return labels, _flat_parts(plane_id, spans, links, barrier, labels, n, part)


@kernel
def _concave_edges(concavity: U1, spans: I4, strong: int, barrier: U1, stack: I4) -> None:
    """Mark strong concave edges, and weaker ones that continue them (hysteresis, Canny 1986)."""
    rows, columns = concavity.shape
    top = 0
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            if concavity[i, j] >= strong:
                barrier[i, j] = 1
                stack[top] = i * columns + j
                top += 1
    while top > 0:
        top -= 1
        i, j = stack[top] // columns, stack[top] % columns
        for y in range(max(i - 1, 0), min(i + 2, rows)):
            for x in range(max(j - 1, 0), min(j + 2, columns)):
                if (
                    barrier[y, x] == 0
                    and concavity[y, x] >= WEAK_DEG
                    and _is_ridge(concavity, y, x)
                ):
                    barrier[y, x] = 1
                    stack[top] = y * columns + x
                    top += 1


@kernel
def _is_ridge(concavity: U1, i: int, j: int) -> bool:
    """Whether an edge falls off on two opposite sides; inside a bowl it does not."""
    rows, columns = concavity.shape
    least = RIDGE * concavity[i, j]
    for d in range(4):
        di = 0 if d == 0 else RIDGE_CELLS
        dj = RIDGE_CELLS if d == 0 else (0 if d == 1 else (RIDGE_CELLS if d == 2 else -RIDGE_CELLS))
        if (
            i - di < 0
            or i + di >= rows
            or min(j - dj, j + dj) < 0
            or max(j - dj, j + dj) >= columns
        ):
            continue
        if concavity[i - di, j - dj] < least and concavity[i + di, j + dj] < least:
            return True
    return False


@kernel
def _flat_parts(
    plane_id: I4, spans: I4, links: U1, barrier: U1, labels: I4, n: int, part: I4
) -> int:
    """Label linked unlabelled cells that are no barrier, from ``n`` + 1 on; return the last label.

    Two passes with a table of equivalent labels (Rosenfeld and Pfaltz 1966). Small parts get none.
    ``part`` (rows, columns) is room: links do not lead out of the spans, all of which is written.
    """
    rows = plane_id.shape[0]
    most = 1  # in speckle no cell is linked
    for i in range(rows):
        most += spans[i, 1] - spans[i, 0]
    parent, size = unset(most, np.int32), unset(most, np.int32)
    count = 0
    # (1) first labels, and which of them meet
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            part[i, j] = 0
            if plane_id[i, j] <= 0 or labels[i, j] > 0 or barrier[i, j]:
                continue
            me = part[i, j - 1] if j > 0 and links[i, j - 1] & RIGHT else 0
            above = part[i - 1, j] if i > 0 and links[i - 1, j] & DOWN else 0
            if me == 0 and above == 0:
                count += 1
                parent[count] = me = count
                size[count] = 0
            elif me == 0:
                me = above
            elif above > 0 and above != me:
                a, b = _root(parent, me), _root(parent, above)
                parent[max(a, b)] = me = min(a, b)
            part[i, j] = me
            size[me] += 1
    # (2) final labels, in the order of their first cells
    for k in range(count, 0, -1):
        size[parent[k]] += size[k] if parent[k] != k else 0
    name = np.zeros(count + 1, np.int16)
    for k in range(1, count + 1):
        if parent[k] != k:
            name[k] = name[parent[k]]
        elif size[k] >= LEAST_CELLS and n < MOST_REGIONS:
            n += 1
            name[k] = n
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            if part[i, j] > 0:
                labels[i, j] = name[part[i, j]]
    return n


@kernel
def _root(parent: I4, k: int) -> int:
    while parent[k] != k:
        k = parent[k]
    return k


@kernel
def _flood_labels(links: U1, concavity: U1, spans: I4, labels: I4, following: I4) -> None:
    """Grow the labels over links, cells with small concave angles first.

    ``following`` (cells,) is room for the next cell of the same queue.
    """
    columns = labels.shape[1]
    flat_links, flat_edge, flat = links.reshape(-1), concavity.reshape(-1), labels.reshape(-1)
    buckets = 256 // BUCKET_DEG
    head, tail = np.zeros(buckets, np.int32), np.zeros(buckets, np.int32)
    head[:] = -1
    for i in range(labels.shape[0]):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            if flat[p] <= 0:
                continue
            for d in range(4):
                step, way = (columns if d & 1 else 1), (DOWN if d & 1 else RIGHT)
                q = p + step if d < 2 else p - step
                if not (flat_links[p] & way if d < 2 else q >= 0 and flat_links[q] & way):
                    continue
                if flat[q] <= 0:
                    if head[0] < 0:
                        head[0] = p
                    else:
                        following[tail[0]] = p
                    tail[0], following[p] = p, -1
                    break
    now = 0
    while now < buckets:
        p = head[now]
        if p < 0:
            now += 1
            continue
        head[now] = following[p]
        for d in range(4):
            step, way = (columns if d & 1 else 1), (DOWN if d & 1 else RIGHT)
            q = p + step if d < 2 else p - step
            if not (flat_links[p] & way if d < 2 else q >= 0 and flat_links[q] & way):
                continue
            if flat[q] > 0:
                continue
            flat[q] = flat[p]
            level = max(now, flat_edge[q] // BUCKET_DEG)
            if head[level] < 0:
                head[level] = q
            else:
                following[tail[level]] = q
            tail[level], following[q] = q, -1


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
