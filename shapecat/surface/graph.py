"""Turn a grown gas into a connected graph without unused neurons."""

import numpy as np

from shapecat.arrays import I4, U2, Bool
from shapecat.jit import kernel
from shapecat.surface.growth import Cloud
from shapecat.surface.neurons import FAR, Gas, index_mask, is_edge
from shapecat.surface.simd import LANES, three_nearest

__all__ = ["GRID_SPACING", "edge_list", "finish_graph"]

GRID_SPACING = 1.15
"""Spacing of a square grid with the same density of points, relative to the mean distance from a
point to its nearest neighbour."""
_LONGEST = 3.0
"""Maximum length, in grid spacings, of an edge that step 3 adds for the third nearest neuron."""


@kernel
def finish_graph(cloud: Cloud, gas: Gas, count: int, share: float) -> Bool:
    """Finish the graph of a gas; return the adjacency (n, n) of the n neurons that are kept.

    1. Remove neurons that are nearest to no point.
    2. Move each neuron to the mean of the points it is nearest to (one step of Lloyd 1982). This
       removes the pull of the last signals, and keeps neurons within the convex hull.
    3. Link two neurons if the gas linked them, if they were the two nearest to some point before
       step 2 (competitive Hebbian learning, Martinetz and Schulten 1994), or if they were among the
       three nearest and are not far apart. With the links of the gas alone, a third of the neurons
       are in no triangle.
    4. Remove components with less than a minimum fraction of the points, but never the largest.
    5. Connect the remaining components where they are nearest to each other.

    Parameters
    ----------
    cloud : the points.
    gas : the neurons, changed in place: those that are kept come first, in their old order.
    count : number of neurons in ``gas``.
    share : minimum fraction of the points in a component that is kept.

    Returns
    -------
    The adjacency (n, n); empty, (0, 0), if fewer than 3 neurons are kept.
    """
    adjacent = np.zeros((count, count), np.bool_)
    for i in range(count):
        for j in range(count):
            adjacent[i, j] = is_edge(gas, i, j)
    # 1.
    nearest = np.zeros((cloud.x.size, 3), np.int32)
    _three_nearest(cloud, gas, count, nearest)
    members = np.zeros(count, np.int64)
    for k in range(cloud.x.size):
        members[nearest[k, 0]] += 1
    stays = np.zeros(count, np.bool_)
    for i in range(count):
        stays[i] = members[i] > 0
    n = _compact(gas, adjacent, members, stays, count)
    if n < 3:
        return adjacent[:0, :0]
    if n < count:
        _three_nearest(cloud, gas, n, nearest)
    # 2.
    _move_to_means(cloud, gas, n, nearest)
    # 3.
    limit = (_LONGEST * GRID_SPACING * _mean_spacing(gas, n)) ** 2
    for k in range(cloud.x.size):
        a, b, c = np.int64(nearest[k, 0]), np.int64(nearest[k, 1]), np.int64(nearest[k, 2])
        adjacent[a, b] = adjacent[b, a] = True
        if not adjacent[a, c] and _squared_distance(gas, a, c) < limit:
            adjacent[a, c] = adjacent[c, a] = True
        if not adjacent[b, c] and _squared_distance(gas, b, c) < limit:
            adjacent[b, c] = adjacent[c, b] = True
    # 4.
    part = np.zeros(n, np.int64)
    parts = _components(adjacent, n, part)
    if parts > 1:
        weight = np.zeros(parts, np.int64)
        for i in range(n):
            weight[part[i]] += members[i]
        heaviest = 0
        for k in range(1, parts):
            heaviest = k if weight[k] > weight[heaviest] else heaviest
        for i in range(n):
            stays[i] = part[i] == heaviest or weight[part[i]] >= share * cloud.x.size
        n = _compact(gas, adjacent, members, stays, n)
        if n < 3:
            return adjacent[:0, :0]
        # 5.
        while _components(adjacent, n, part) > 1:
            _bridge(gas, adjacent, n, part)
    return adjacent[:n, :n]


@kernel(inner=True)
def edge_list(adjacent: Bool) -> U2:
    """Return the pairs i < j of adjacent neurons, (m, 2), in lexicographic order."""
    count = adjacent.shape[0]
    edges = np.zeros((count * count // 2 + 1, 2), np.uint16)
    n = 0
    for i in range(count):
        for j in range(i + 1, count):
            edges[n, 0], edges[n, 1] = i, j  # overwritten unless adjacent: no branch
            n += adjacent[i, j]
    return edges[:n].copy()


@kernel(inner=True)
def _three_nearest(cloud: Cloud, gas: Gas, count: int, nearest: I4) -> None:
    """Write the three neurons nearest to each point, nearest first, to ``nearest`` (n, 3).

    ``count`` is the number of neurons.
    """
    padded = (count + LANES - 1) // LANES * LANES
    mask = index_mask(padded)
    for k in range(cloud.x.size):
        nearest[k, 0], nearest[k, 1], nearest[k, 2] = three_nearest(
            gas.x, gas.y, gas.z, padded, cloud.x[k], cloud.y[k], cloud.z[k], mask
        )


@kernel(inline=True)
def _move_to_means(cloud: Cloud, gas: Gas, count: int, nearest: I4) -> None:
    """Move each neuron to the mean of the points it is nearest to.

    ``nearest`` (n, 3) is from `_three_nearest`; ``count`` is the number of neurons.
    """
    sums = np.zeros((count, 4))
    for k in range(cloud.x.size):
        i = nearest[k, 0]
        sums[i, 0] += cloud.x[k]
        sums[i, 1] += cloud.y[k]
        sums[i, 2] += cloud.z[k]
        sums[i, 3] += 1
    for i in range(count):
        if sums[i, 3] > 0:
            gas.x[i] = sums[i, 0] / sums[i, 3]
            gas.y[i] = sums[i, 1] / sums[i, 3]
            gas.z[i] = sums[i, 2] / sums[i, 3]


@kernel(fast=True, inner=True)
def _mean_spacing(gas: Gas, count: int) -> float:
    """Return the mean distance from a neuron to the nearest other one of the ``count`` neurons."""
    x, y, z = gas.x, gas.y, gas.z
    total = 0.0
    for i in range(count):
        px, py, pz = x[i], y[i], z[i]
        x[i] = FAR  # out of its own way, so that the loop has no branch
        best = FAR
        for j in range(x.size):
            dx, dy, dz = x[j] - px, y[j] - py, z[j] - pz
            squared = dx * dx + dy * dy + dz * dz
            best = squared if squared < best else best
        x[i] = px
        total += np.sqrt(best)
    return total / count


@kernel(inner=True)
def _squared_distance(gas: Gas, i: int, j: int) -> float:
    """Return the squared distance of neurons i and j."""
    dx, dy, dz = gas.x[i] - gas.x[j], gas.y[i] - gas.y[j], gas.z[i] - gas.z[j]
    return float(dx * dx + dy * dy + dz * dz)


@kernel(inner=True)
def _compact(gas: Gas, adjacent: Bool, members: I4, stays: Bool, count: int) -> int:
    """Drop some of ``count`` neurons and close the gaps, in order; return how many remain.

    ``stays`` (count,) is True for those that remain. Of ``gas``, only the positions are moved.
    ``adjacent`` (count, count) and ``members``, the
    number of points of each neuron (count,), are changed too.
    """
    n = 0
    for i in range(count):
        if not stays[i]:
            continue
        if n < i:
            gas.x[n], gas.y[n], gas.z[n] = gas.x[i], gas.y[i], gas.z[i]
            members[n] = members[i]
            for j in range(count):
                adjacent[n, j] = adjacent[i, j]
            for j in range(count):
                adjacent[j, n] = adjacent[j, i]
        n += 1
    gas.x[n:count] = FAR
    gas.y[n:count] = FAR
    gas.z[n:count] = FAR
    return n


@kernel(inner=True)
def _components(adjacent: Bool, count: int, part: I4) -> int:
    """Label connected components, from 0 in order of their first neuron; return their number.

    ``adjacent`` is (count, count) or larger; the labels are written to ``part`` (count,).
    """
    part[:count] = -1
    unlabelled = np.zeros(count, np.int64)  # neurons that may have no label yet
    for i in range(count):
        unlabelled[i] = i
    remaining = count
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
            kept = 0
            for k in range(remaining):
                j = unlabelled[k]
                if adjacent[i, j] and part[j] < 0:
                    part[j] = parts
                    stack[size] = j
                    size += 1
                elif part[j] < 0:
                    unlabelled[kept] = j
                    kept += 1
            remaining = kept
        parts += 1
    return parts


@kernel(inline=True)
def _bridge(gas: Gas, adjacent: Bool, count: int, part: I4) -> None:
    """Link the two nearest neurons of different components.

    ``adjacent`` and ``part`` are as in `_components`; ``adjacent`` is changed in place.
    """
    best = np.inf
    a, b = 0, 0
    for i in range(count):
        for j in range(i + 1, count):
            if part[i] != part[j] and _squared_distance(gas, i, j) < best:
                best = _squared_distance(gas, i, j)
                a, b = i, j
    adjacent[a, b] = adjacent[b, a] = True
