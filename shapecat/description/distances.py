"""Distances along the surface: all-pairs shortest paths on the graph."""

import numpy as np

from shapecat.arrays import F4, U2
from shapecat.jit import kernel

__all__ = ["euclidean_distances", "geodesic_distances", "mean_gap"]

_NO_PATH = np.float32(1e30)


@kernel(fast=True)
def euclidean_distances(x: F4, y: F4, z: F4) -> F4:
    """Return the distances (n, n) between points with coordinates x, y, z (n,)."""
    count = x.size
    result = np.zeros((count, count), np.float32)
    for i in range(count):
        for j in range(count):
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            result[i, j] = np.sqrt(dx * dx + dy * dy + dz * dz)
    return result


@kernel(fast=True)
def geodesic_distances(euclidean: F4, edges: U2) -> F4:
    """Return the lengths (n, n) of the shortest paths along the edges of a graph.

    A pair without a path gets its Euclidean distance plus the longest path in the graph. Source:
    Floyd 1962, Warshall 1962; thesis ch. 6. O(n**3), but 80 nodes take 16 µs: for a graph of this
    size, dense rows are faster than Dijkstra's algorithm.

    Parameters
    ----------
    euclidean : (n, n) Euclidean distances.
    edges : (m, 2) pairs of nodes.
    """
    count = euclidean.shape[0]
    padded = (count + 15) // 16 * 16  # whole vectors: no remainder in the inner loop
    paths = np.zeros((padded, padded), np.float32)
    paths[:] = _NO_PATH
    for e in range(edges.shape[0]):
        a, b = np.int64(edges[e, 0]), np.int64(edges[e, 1])
        paths[a, b] = paths[b, a] = euclidean[a, b]
    for i in range(count):
        paths[i, i] = 0
    via = np.zeros((4, padded), np.float32)
    for k in range(0, count, 4):  # four nodes at a time: each row is read and written only once
        _paths_from_block(paths, k, via)
        for i in range(count):
            _shorten(paths, i, via, k)
    joined: F4 = _joined(paths, euclidean)
    return joined


@kernel(fast=True, inner=True)
def _minimum(a: float, b: float) -> float:
    """Return the smaller of two numbers, in a form that vectorises."""
    return a if a < b else b


@kernel(fast=True, inline=True)
def _paths_from_block(paths: F4, k: int, via: F4) -> None:
    """Write the path lengths from each of the nodes k to k + 3 to ``via``.

    ``paths`` (n, n) are the lengths so far, ``via`` is (4, n). A path from node k + m may pass
    through the nodes k to k + m - 1.
    """
    first, second, third, fourth = paths[k], paths[k + 1], paths[k + 2], paths[k + 3]
    a = second[k]
    b = third[k]
    c = _minimum(third[k + 1], b + first[k + 1])
    d = fourth[k]
    e = _minimum(fourth[k + 1], d + first[k + 1])
    f = _minimum(fourth[k + 2], d + first[k + 2])
    f = _minimum(f, e + _minimum(second[k + 2], a + first[k + 2]))
    for j in range(first.size):
        w0 = first[j]
        w1 = _minimum(second[j], a + w0)
        w2 = _minimum(_minimum(third[j], b + w0), c + w1)
        w3 = _minimum(_minimum(_minimum(fourth[j], d + w0), e + w1), f + w2)
        via[0, j], via[1, j], via[2, j], via[3, j] = w0, w1, w2, w3


@kernel(fast=True, inline=True)
def _shorten(paths: F4, i: int, via: F4, k: int) -> None:
    """Route the paths of node i through the nodes k to k + 3 where that is shorter.

    ``paths`` (n, n) is changed in place; ``via`` (4, n) is from `_paths_from_block`.
    """
    a = paths[i, k]
    b = _minimum(paths[i, k + 1], a + via[0, k + 1])
    c = _minimum(_minimum(paths[i, k + 2], a + via[0, k + 2]), b + via[1, k + 2])
    d = _minimum(_minimum(paths[i, k + 3], a + via[0, k + 3]), b + via[1, k + 3])
    d = _minimum(d, c + via[2, k + 3])
    for j in range(paths.shape[1]):
        best = _minimum(paths[i, j], a + via[0, j])
        best = _minimum(best, b + via[1, j])
        best = _minimum(best, c + via[2, j])
        paths[i, j] = _minimum(best, d + via[3, j])


@kernel(fast=True, inline=True)
def _joined(paths: F4, euclidean: F4) -> F4:
    """Return the path lengths (n, n) without padding.

    Two nodes without a path get their Euclidean distance, from ``euclidean`` (n, n), plus the
    length of the longest path.
    """
    count = euclidean.shape[0]
    result = np.zeros((count, count), np.float32)
    longest = np.float32(0)
    for i in range(count):
        for j in range(count):
            length = paths[i, j]
            longest = length if length > longest else longest
            result[i, j] = length
    if longest < _NO_PATH:
        return result
    longest = np.float32(0)
    for i in range(count):
        for j in range(count):
            if result[i, j] < _NO_PATH:
                longest = max(longest, result[i, j])
    for i in range(count):
        for j in range(count):
            if not result[i, j] < _NO_PATH:
                result[i, j] = euclidean[i, j] + longest
    return result


@kernel(fast=True, inner=True)
def mean_gap(euclidean: F4) -> float:
    """Return the mean distance from a node to its nearest neighbour, from distances (n, n)."""
    count = euclidean.shape[0]
    total = 0.0
    for i in range(count):
        row = euclidean[i]
        best = np.float32(np.inf)
        for j in range(i):
            best = row[j] if row[j] < best else best
        for j in range(i + 1, count):
            best = row[j] if row[j] < best else best
        total += float(best)
    return float(total / count)
