"""The arrays of a growing neural gas: neurons and edges that are added, moved and removed."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.jit import kernel
from shapecat.surface.simd import LANES

__all__ = [
    "ABSENT",
    "FAR",
    "Gas",
    "connect",
    "disconnect",
    "empty_gas",
    "index_mask",
    "insert",
    "is_edge",
    "move",
    "refresh",
]

ABSENT = np.int32(1 << 29)
"""Element of `Gas.edge_birth` without an edge: larger than any sum of wins."""
FAR = np.float32(1e18)
"""Coordinate of an element of `Gas` without a neuron: farther away than any neuron."""


class Gas(NamedTuple):
    """A gas with room for more neurons than it has; its arrays are padded to whole vectors.

    Attributes
    ----------
    x, y, z : (n,) positions; `FAR` where there is no neuron.
    error : (n,) accumulated squared distances.
    degree : (n,) number of edges of each neuron.
    wins : (n,) number of signals for which each neuron was the nearest.
    edge_birth : (n * n,) for the edge i-j, element ``i * n + j`` is the sum ``wins[i] + wins[j]``
        when the edge was last refreshed; `ABSENT` without an edge. The age of an edge is the growth
        of that sum, so one increment ages all edges of the winner, and its neighbours are in one
        row.
    """

    x: F4
    y: F4
    z: F4
    error: F4
    degree: I4
    wins: I4
    edge_birth: I4


@kernel(inner=True)
def empty_gas(room: int) -> Gas:
    """Return a gas without neurons, with room for at least ``room`` of them."""
    size = (room + LANES - 1) // LANES * LANES
    gas = Gas(
        np.zeros(size, np.float32),
        np.zeros(size, np.float32),
        np.zeros(size, np.float32),
        np.zeros(size, np.float32),
        np.zeros(size, np.int32),
        np.zeros(size, np.int32),
        np.zeros(size * size, np.int32),
    )
    gas.x[:] = gas.y[:] = gas.z[:] = FAR
    gas.edge_birth[:] = ABSENT
    return gas


@kernel(inner=True)
def index_mask(count: int) -> int:
    """Return the ``mask`` of `two_nearest`: the smallest 2**k - 1 of at least ``count - 1``."""
    mask = 1
    while mask < count:
        mask <<= 1
    return mask - 1


@kernel(inner=True)
def is_edge(gas: Gas, i: int, j: int) -> bool:
    """Return whether two neurons are linked."""
    return bool(gas.edge_birth[i * gas.x.size + j] < ABSENT)


@kernel(inner=True)
def connect(gas: Gas, i: int, j: int) -> None:
    """Link neurons i and j, or reset the age of their edge."""
    refresh(gas.degree, gas.wins, gas.edge_birth, i, j)


@kernel(inner=True)
def refresh(degree: I4, wins: I4, edge_birth: I4, i: int, j: int) -> None:
    """Link neurons i and j, or reset the age of their edge; the arrays are from a `Gas`."""
    if edge_birth[i * degree.size + j] == ABSENT:
        degree[i] += 1
        degree[j] += 1
    birth = wins[i] + wins[j]
    edge_birth[i * degree.size + j] = birth
    edge_birth[j * degree.size + i] = birth


@kernel(inner=True)
def disconnect(degree: I4, edge_birth: I4, i: int, j: int) -> None:
    """Remove the edge between neurons i and j; the arrays are from a `Gas`."""
    edge_birth[i * degree.size + j] = ABSENT
    edge_birth[j * degree.size + i] = ABSENT
    degree[i] -= 1
    degree[j] -= 1


@kernel(inner=True)
def insert(gas: Gas, count: int, q: int) -> int:
    """Insert neuron ``count`` between neuron q and its neighbour f of largest error; return f."""
    f = -1
    for j in range(count):
        if is_edge(gas, q, j) and (f < 0 or gas.error[j] > gas.error[f]):
            f = j
    half = np.float32(0.5)
    gas.x[count] = half * (gas.x[q] + gas.x[f])
    gas.y[count] = half * (gas.y[q] + gas.y[f])
    gas.z[count] = half * (gas.z[q] + gas.z[f])
    disconnect(gas.degree, gas.edge_birth, q, np.int64(f))
    connect(gas, q, count)
    connect(gas, np.int64(f), count)
    return f


@kernel(inline=True)
def move(gas: Gas, last: int, place: int) -> None:
    """Move neuron ``last``, the last one, to the free index ``place``; its error is not moved."""
    size = gas.x.size
    if last != place:
        gas.x[place], gas.y[place], gas.z[place] = gas.x[last], gas.y[last], gas.z[last]
        gas.wins[place], gas.degree[place] = gas.wins[last], gas.degree[last]
        for j in range(last):
            gas.edge_birth[place * size + j] = gas.edge_birth[j * size + place] = gas.edge_birth[
                last * size + j
            ]
        gas.edge_birth[place * size + place] = ABSENT
    for j in range(size):
        gas.edge_birth[last * size + j] = gas.edge_birth[j * size + last] = ABSENT
    gas.x[last] = gas.y[last] = gas.z[last] = FAR
    gas.wins[last] = gas.degree[last] = 0
