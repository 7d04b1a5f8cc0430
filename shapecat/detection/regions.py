"""Regions: pieces of surface bounded by jumps and concave edges."""

import numpy as np

from shapecat.arrays import I4, U1
from shapecat.detection.heights import Heights
from shapecat.detection.surfaces import DOWN, RIGHT, Surfaces
from shapecat.jit import kernel

__all__ = ["regions_of"]

EDGE_DEG = 34
"""Concave angle that may part two objects; a bowl of 7 cm turns 16 degrees over the same cells."""
WEAK_DEG = 20
RIDGE, RIDGE_CELLS = 0.5, 5
LEAST_CELLS = 12
MOST_REGIONS = 250
BUCKET_DEG = 4


def regions_of(heights: Heights, surfaces: Surfaces, *, concave: bool = True) -> tuple[I4, int]:
    """Label the object cells: (rows, columns) int16 labels 1..n, 0 elsewhere, and n.

    Flat cells that are linked make a seed; a flood from the seeds, flattest cells first, gives
    the cells of an edge to its sides (Meyer 1991). With ``concave`` off only jumps part regions.
    """
    labels = np.zeros(heights.owner.shape, np.int16)
    barrier = np.zeros(labels.shape, np.uint8)
    if concave:
        _creases(surfaces.edge, barrier)
    n = _flat_parts(heights.owner, surfaces.links, barrier, labels, 0)
    _flood(surfaces.links, surfaces.edge, labels)
    barrier[:] = 0
    n = _flat_parts(heights.owner, surfaces.links, barrier, labels, n)
    np.maximum(labels, 0, out=labels)
    return labels, n


@kernel
def _creases(edge: U1, barrier: U1) -> None:
    """Mark strong concave edges, and weaker ones that continue them (hysteresis, Canny 1986)."""
    rows, columns = edge.shape
    stack = np.zeros(edge.size, np.int32)
    top = 0
    for i in range(rows):
        for j in range(columns):
            if edge[i, j] >= EDGE_DEG:
                barrier[i, j] = 1
                stack[top] = i * columns + j
                top += 1
    while top > 0:
        top -= 1
        i, j = stack[top] // columns, stack[top] % columns
        for y in range(max(i - 1, 0), min(i + 2, rows)):
            for x in range(max(j - 1, 0), min(j + 2, columns)):
                if barrier[y, x] == 0 and edge[y, x] >= WEAK_DEG and _is_ridge(edge, y, x):
                    barrier[y, x] = 1
                    stack[top] = y * columns + x
                    top += 1


@kernel
def _is_ridge(edge: U1, i: int, j: int) -> bool:
    """Whether an edge falls off on two opposite sides; inside a bowl it does not."""
    rows, columns = edge.shape
    least = RIDGE * edge[i, j]
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
        if edge[i - di, j - dj] < least and edge[i + di, j + dj] < least:
            return True
    return False


@kernel
def _flat_parts(owner: I4, links: U1, barrier: U1, labels: I4, n: int) -> int:
    """Label linked unlabelled cells that are no barrier; small parts get -1."""
    columns = owner.shape[1]
    stack = np.zeros(owner.size, np.int32)
    flat_owner, flat_links = owner.reshape(-1), links.reshape(-1)
    closed, flat = barrier.reshape(-1), labels.reshape(-1)
    for k in range(flat.size):
        flat[k] = 0 if flat[k] < 0 else flat[k]
    for s in range(flat.size):
        if flat_owner[s] <= 0 or flat[s] != 0 or closed[s] or n >= MOST_REGIONS:
            continue
        n += 1
        stack[0] = s
        flat[s] = n
        done, top = 0, 1
        while done < top:
            p = stack[done]
            done += 1
            for d in range(4):
                q = _neighbour(p, d, columns, flat_links)
                if q >= 0 and flat[q] == 0 and closed[q] == 0:
                    flat[q] = n
                    stack[top] = q
                    top += 1
        if top < LEAST_CELLS:
            for t in range(top):
                flat[stack[t]] = -1
            n -= 1
    return n


@kernel
def _neighbour(p: int, d: int, columns: int, links: U1) -> int:
    """Return the linked neighbour of cell ``p`` in direction ``d``, or -1."""
    if d == 0:
        return p + 1 if links[p] & RIGHT else -1
    if d == 1:
        return p + columns if links[p] & DOWN else -1
    if d == 2:
        return p - 1 if p % columns > 0 and links[p - 1] & RIGHT else -1
    return p - columns if p >= columns and links[p - columns] & DOWN else -1


@kernel
def _flood(links: U1, edge: U1, labels: I4) -> None:
    """Grow the labels over links, cells with small concave angles first."""
    columns = labels.shape[1]
    flat_links, flat_edge, flat = links.reshape(-1), edge.reshape(-1), labels.reshape(-1)
    buckets = 256 // BUCKET_DEG
    head = np.full(buckets, -1, np.int32)
    tail = np.full(buckets, -1, np.int32)
    following = np.full(flat.size, -1, np.int32)
    for p in range(flat.size):
        if flat[p] <= 0:
            continue
        for d in range(4):
            q = _neighbour(p, d, columns, flat_links)
            if q >= 0 and flat[q] <= 0:
                if head[0] < 0:
                    head[0] = p
                else:
                    following[tail[0]] = p
                tail[0] = p
                break
    now = 0
    while now < buckets:
        p = head[now]
        if p < 0:
            now += 1
            continue
        head[now] = following[p]
        following[p] = -1
        for d in range(4):
            q = _neighbour(p, d, columns, flat_links)
            if q < 0 or flat[q] > 0:
                continue
            flat[q] = flat[p]
            level = max(now, flat_edge[q] // BUCKET_DEG)
            if head[level] < 0:
                head[level] = q
            else:
                following[tail[level]] = q
            tail[level] = q
