"""From a grown gas to a graph of the surface: every neuron used, one connected component."""

import numpy as np

from shapecat.arrays import F4, I4, Bool
from shapecat.jit import kernel
from shapecat.surface.growth import ABSENT, FAR, index_mask
from shapecat.surface.lanes import LANES, three_nearest

__all__ = ["link"]


@kernel
def _three_nearest(px: F4, py: F4, pz: F4, x: F4, y: F4, z: F4, count: int, nearest: I4) -> None:
    """Write the three neurons nearest to each point."""
    padded = (count + LANES - 1) // LANES * LANES
    mask = index_mask(padded)
    for k in range(px.size):
        a, b, c = three_nearest(x, y, z, padded, px[k], py[k], pz[k], mask)
        nearest[k, 0], nearest[k, 1], nearest[k, 2] = a, b, c


@kernel(fast=True)
def _mean_gap(x: F4, y: F4, z: F4, count: int) -> float:
    """Return the mean distance from a neuron to the nearest other one."""
    total = 0.0
    for i in range(count):
        best = np.float32(np.inf)
        for j in range(count):
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            squared = dx * dx + dy * dy + dz * dz
            squared = squared if j != i else np.float32(np.inf)
            best = squared if squared < best else best
        total += np.sqrt(best)
    return total / count


@kernel
def link(
    px: F4,
    py: F4,
    pz: F4,
    x: F4,
    y: F4,
    z: F4,
    born: I4,
    count: int,
    share: float,
) -> tuple[int, Bool]:
    """Finish the graph of ``count`` neurons; return how many stay and their (n, n) adjacency.

    1. Neurons nearest to no point are removed.
    2. Two neurons are linked when the gas linked them, when they are the two nearest of some point
       (competitive Hebbian learning, Martinetz and Schulten 1994), or when one of them is its
       third nearest and they are closer than three times the spacing of the neurons: the edges of
       the gas alone leave a third of them without a triangle.
    3. Parts with less than ``share`` of the points are removed, never the largest.
    4. The remaining parts are joined at their smallest gap.

    ``x, y, z`` are rearranged so that the first neurons are those that stay, in their old order.
    """
    stride = x.size
    adjacent = np.zeros((count, count), np.bool_)
    for i in range(count):
        for j in range(count):
            adjacent[i, j] = born[i * stride + j] < ABSENT
    # 1.
    nearest = np.zeros((px.size, 3), np.int32)
    _three_nearest(px, py, pz, x, y, z, count, nearest)
    members = np.zeros(count, np.int64)
    for k in range(px.size):
        members[nearest[k, 0]] += 1
    used = members > 0
    kept = _keep(x, y, z, adjacent, members, used, count)
    if kept < 3:
        return 0, adjacent[:0, :0]
    if kept < count:
        _three_nearest(px, py, pz, x, y, z, kept, nearest)
    # 2.
    limit = np.float32((3 * 1.15 * _mean_gap(x, y, z, kept)) ** 2)
    for k in range(px.size):
        a, b, c = nearest[k]
        adjacent[a, b] = adjacent[b, a] = True
        if not adjacent[a, c] and _squared(x, y, z, a, c) < limit:
            adjacent[a, c] = adjacent[c, a] = True
        if not adjacent[b, c] and _squared(x, y, z, b, c) < limit:
            adjacent[b, c] = adjacent[c, b] = True
    # 3.
    part = np.zeros(kept, np.int64)
    parts = _components(adjacent, kept, part)
    if parts > 1:
        weight = np.zeros(parts, np.int64)
        for i in range(kept):
            weight[part[i]] += members[i]
        largest = np.argmax(weight)
        stays = np.zeros(kept, np.bool_)
        for i in range(kept):
            stays[i] = part[i] == largest or weight[part[i]] >= share * px.size
        kept = _keep(x, y, z, adjacent, members, stays, kept)
        if kept < 3:
            return 0, adjacent[:0, :0]
        # 4.
        while _components(adjacent, kept, part) > 1:
            _bridge(x, y, z, adjacent, kept, part)
    return kept, adjacent[:kept, :kept]


@kernel
def _squared(x: F4, y: F4, z: F4, i: int, j: int) -> float:
    return (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 + (z[i] - z[j]) ** 2


@kernel
def _keep(x: F4, y: F4, z: F4, adjacent: Bool, members: I4, stays: Bool, count: int) -> int:
    """Move the neurons that stay to the front; return their number."""
    kept = 0
    for i in range(count):
        if not stays[i]:
            continue
        if kept < i:
            x[kept], y[kept], z[kept] = x[i], y[i], z[i]
            members[kept] = members[i]
            for j in range(count):
                adjacent[kept, j] = adjacent[i, j]
            for j in range(count):
                adjacent[j, kept] = adjacent[j, i]
        kept += 1
    x[kept:count] = FAR
    y[kept:count] = FAR
    z[kept:count] = FAR
    return kept


@kernel
def _components(adjacent: Bool, count: int, part: I4) -> int:
    """Label the connected parts from 0 in the order of their first neuron; return their number."""
    part[:count] = -1
    stack = np.zeros(count, np.int64)
    parts = 0
    for first in range(count):
        if part[first] >= 0:
            continue
        part[first] = parts
        stack[0] = first
        size = 1
        while size > 0:
            size -= 1
            i = stack[size]
            for j in range(count):
                if adjacent[i, j] and part[j] < 0:
                    part[j] = parts
                    stack[size] = j
                    size += 1
        parts += 1
    return parts


@kernel
def _bridge(x: F4, y: F4, z: F4, adjacent: Bool, count: int, part: I4) -> None:
    """Link the two nearest neurons of different parts."""
    best = np.inf
    a, b = 0, 0
    for i in range(count):
        for j in range(i + 1, count):
            if part[i] != part[j]:
                gap = _squared(x, y, z, i, j)
                if gap < best:
                    best, a, b = gap, i, j
    adjacent[a, b] = adjacent[b, a] = True
