"""The kernels that grow a neural gas: Fritzke's rule and the thesis's."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.jit import kernel
from shapecat.surface.neurons import (
    ABSENT,
    FAR,
    Gas,
    connect,
    disconnect,
    index_mask,
    insert,
    is_edge,
    move,
    refresh,
)
from shapecat.surface.simd import LANES, adapt, two_nearest

__all__ = ["Cloud", "Rates", "grow_fritzke", "grow_thesis"]


_GAIN = 1 / 0.9995
"""Ratio of the weights of the errors of one signal and of the signal before. It takes the place of
a decay of all earlier errors to 0.9995 of their size."""


class Cloud(NamedTuple):
    """Points, as one array (n,) for each coordinate."""

    x: F4
    y: F4
    z: F4


class Rates(NamedTuple):
    """Learning rates of the neurons, and the maximum age of edges.

    Attributes
    ----------
    winner, neighbour : epsilon_b and epsilon_n at the first signal: the fractions of the distance
        to the signal by which the winner and its neighbours move.
    oldest : age above which an edge is removed (a_max), see `Gas.edge_birth`.
    """

    winner: float
    neighbour: float
    oldest: int


@kernel(inner=True)
def _drop_old_edges(degree: I4, wins: I4, edge_birth: I4, count: int, a: int, oldest: int) -> None:
    """Remove the edges of neuron ``a`` that are older than ``oldest``, but no neuron's last edge.

    The arrays are from a `Gas` of ``count`` neurons.
    """
    for j in range(count):
        age = wins[a] + wins[j] - edge_birth[a * degree.size + j]
        # differs: an edge stays if it is the last edge of one of its neurons, so that no neuron is
        # ever isolated and none has to be removed.
        if age > oldest and degree[a] > 1 and degree[j] > 1:
            disconnect(degree, edge_birth, a, j)


@kernel(inner=True)
def _adapt_to_signal(
    x: F4,
    y: F4,
    z: F4,
    error: F4,
    degree: I4,
    wins: I4,
    edge_birth: I4,
    count: int,
    mask: int,
    sx: float,
    sy: float,
    sz: float,
    gain: float,
    rate_winner: float,
    rate_neighbour: float,
) -> tuple[int, int]:
    """Do steps 5 to 9 of thesis Algorithm 3 for one signal.

    Returns the winner, and the largest age of its edges.

    The signal is (``sx``, ``sy``, ``sz``); ``gain`` is the weight of its error, ``mask`` is from
    `index_mask`, and the rates are as in `Rates`, at this signal. The arrays of a `Gas` with
    ``count`` neurons are passed one by one: unpacking the tuple takes as long as one of the steps.
    Step 10 is the caller's: with a conditional call in here, numba counts references to the arrays
    for each signal, which takes longer than all steps together.
    """
    padded = (count + LANES - 1) // LANES * LANES
    # 5. find the nearest and the second nearest neuron
    a, b = two_nearest(x, y, z, padded, sx, sy, sz, mask)
    # 6. age the edges of the nearest
    wins[a] += 1
    # 7. add the squared distance to its error
    dx, dy, dz = x[a] - sx, y[a] - sy, z[a] - sz
    error[a] += np.float32(gain) * (dx * dx + dy * dy + dz * dz)
    # 8. move it and its neighbours towards the signal
    age = wins[a] + adapt(
        x, y, z, padded, sx, sy, sz, edge_birth, a * x.size, ABSENT, wins, a,
        rate_winner, rate_neighbour,
    )  # fmt: skip
    # 9. link the two, or reset the age of their edge
    refresh(degree, wins, edge_birth, a, b)
    return a, age


@kernel(inner=True)
def _shuffle(order: I4, state: np.uint64) -> np.uint64:
    """Shuffle in place (Fisher-Yates) with a 64-bit linear congruential generator (Knuth).

    ``order`` (n,) is the array, ``state`` the state of the generator; the new state is returned.
    """
    for i in range(order.size - 1, 0, -1):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        j = np.int64(((state >> np.uint64(32)) * np.uint64(i + 1)) >> np.uint64(32))
        order[i], order[j] = order[j], order[i]
    return state


@kernel(inline=True)
def grow_fritzke(
    cloud: Cloud,
    state: np.uint64,
    gas: Gas,
    target: int,
    signals: int,
    interval: int,
    rates: Rates,
) -> int:
    """Grow a gas of two neurons with signals from a cloud; return its number of neurons.

    Source: Fritzke 1995, thesis Algorithm 3, whose steps are numbered here and in
    `_adapt_to_signal`; steps 1 to 3 are the caller's.

    Parameters
    ----------
    cloud : the points.
    state : state of the random generator, from a seed.
    gas : 2 linked neurons, with room for ``target``; changed in place.
    target : number of neurons to grow to.
    signals : number of signals.
    interval : signals between insertions (lambda).
    rates : learning rates, and the maximum age of edges.
    """
    points = cloud.x.size
    px, py, pz = cloud
    x, y, z, error, degree, wins, edge_birth = gas
    count, mask = 2, index_mask(gas.x.size)
    order = np.arange(points)
    cursor = points
    gain = 1.0
    fall = 0.9 / max(signals, 1)
    until = interval
    for signal in range(signals):
        # 4. differs: each point once per epoch, in random order, rather than independent draws.
        if cursor == points:
            state = _shuffle(order, state)
            cursor = 0
        k = order[cursor]
        cursor += 1
        # 5. to 10. differs: the rates fall to a tenth, so that the gas comes to rest.
        cooling = 1.0 - fall * signal
        a, age = _adapt_to_signal(
            x, y, z, error, degree, wins, edge_birth, count, mask, px[k], py[k], pz[k],
            gain, rates.winner * cooling, rates.neighbour * cooling,
        )  # fmt: skip
        # 10. remove edges that are too old
        if age > rates.oldest:
            _drop_old_edges(degree, wins, edge_birth, count, a, rates.oldest)
        # 11. insert a neuron where the error is largest, every ``interval`` signals
        until -= 1
        if until == 0 and count < target:
            until = interval
            q = 0
            for i in range(1, count):
                q = i if error[i] > error[q] else q
            f = insert(gas, count, q)
            gas.error[q] *= np.float32(0.5)
            gas.error[f] *= np.float32(0.5)
            gas.error[count] = gas.error[q]
            count += 1
        # 12. all errors decay: instead, each new one gets more weight
        gain *= _GAIN
        if gain > 1e6:
            for i in range(count):
                error[i] *= np.float32(1e-6)
            gain *= 1e-6
    # 13. stop after the number of signals
    return count


@kernel(inline=True)
def grow_thesis(
    cloud: Cloud,
    state: np.uint64,
    gas: Gas,
    target: int,
    epochs: int,
    error_limit: float,
    distance_limit: float,
    rates: Rates,
) -> int:
    """Grow a gas of two neurons until its neurons are close to the points; return their number.

    Source: thesis 5.2, Algorithm 4, which changes two steps of Algorithm 3. Step 12: a neuron is
    inserted where the error exceeds a limit. Step 18: the cloud is presented at least three times,
    until the mean distance of the neurons to their nearest point (psi) is below a limit.

    Parameters
    ----------
    cloud, state, gas, rates : as in `grow_fritzke`.
    target : maximum number of neurons.
    epochs : maximum number of times that each point is presented.
    error_limit : sum of squared distances, in the squared unit of ``cloud`` (t_gamma).
    distance_limit : distance, in the unit of ``cloud`` (t_alpha).
    """
    points = cloud.x.size
    px, py, pz = cloud
    x, y, z, error, degree, wins, edge_birth = gas
    count, mask = 2, index_mask(gas.x.size)
    order = np.arange(points)
    before = np.zeros(gas.x.size, np.int32)
    fall = 0.9 / (epochs * points)
    cooling = 1.0
    for epoch in range(epochs):
        # differs: errors restart with each epoch; summed over all epochs they exceed any limit
        # and the gas grows without bound.
        gas.error[:] = 0
        before[:] = gas.wins
        pause = 0
        state = _shuffle(order, state)
        for k in order:
            a, age = _adapt_to_signal(
                x, y, z, error, degree, wins, edge_birth, count, mask, px[k], py[k], pz[k],
                1.0, rates.winner * cooling, rates.neighbour * cooling,
            )  # fmt: skip
            # 10. remove edges that are too old
            if age > rates.oldest:
                _drop_old_edges(degree, wins, edge_birth, count, a, rates.oldest)
            cooling -= fall
            # 12. differs: at most once in four signals, and the errors of all three neurons are
            # reset; as published, the gas is full after the first epoch.
            pause -= 1
            if gas.error[a] > error_limit and pause <= 0 and count < target:
                pause = 4
                f = insert(gas, count, a)
                gas.error[a] = gas.error[f] = gas.error[count] = 0
                before[count] = -1
                count += 1
        # differs: neurons that were never nearest in this epoch lie between surfaces: remove them.
        count = _prune(gas, count, before)
        # 18.
        if epoch >= 2 and _mean_distance(cloud, gas, count) < distance_limit:
            break
    return count


@kernel(inline=True)
def _prune(gas: Gas, count: int, before: I4) -> int:
    """Remove neurons whose ``wins`` are still as in ``before``; return how many remain.

    At least 3 remain. One neighbour of a removed neuron takes over its edges. The last neurons,
    with their elements of ``before`` (count,), take the places of removed neurons.
    """
    i = 0
    while i < count:
        if gas.wins[i] != before[i] or count <= 3:
            i += 1
            continue
        heir = -1  # takes over the edges, so that no neighbour is isolated
        for j in range(count):
            if is_edge(gas, i, j):
                if heir >= 0:
                    connect(gas, np.int64(heir), j)
                else:
                    heir = j
                disconnect(gas.degree, gas.edge_birth, i, j)
        if gas.degree[heir] == 0:
            after = (heir + 1) % count
            connect(gas, np.int64(heir), after if after != i else (i + 1) % count)
        count -= 1
        move(gas, count, i)
        before[i] = before[count]
    return count


@kernel(fast=True, inner=True)
def _mean_distance(cloud: Cloud, gas: Gas, count: int) -> float:
    """Return psi: the mean distance from the ``count`` neurons to their nearest point."""
    total = 0.0
    for i in range(count):
        best = FAR
        x, y, z = gas.x[i], gas.y[i], gas.z[i]
        for k in range(cloud.x.size):
            dx, dy, dz = cloud.x[k] - x, cloud.y[k] - y, cloud.z[k] - z
            squared = dx * dx + dy * dy + dz * dz
            best = squared if squared < best else best
        total += np.sqrt(best)
    return total / count
