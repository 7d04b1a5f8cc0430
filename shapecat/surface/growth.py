"""The kernels that grow a neural gas: Fritzke's rule and the thesis's.

State of the gas, in flat arrays padded to whole vectors of 16 numbers:

- ``x, y, z`` positions; unused places are far away.
- ``error`` accumulated squared distance.
- ``wins`` how often a neuron was the nearest: the clock of its edges.
- ``born[i * stride + j]`` is ``ABSENT``, or ``wins[i] + wins[j]`` when edge i-j was last refreshed,
  so that its age is ``wins[i] + wins[j] - born``: ageing all edges of the winner (step 6) is one
  increment, and adapting its neighbours (step 8) is one loop over a row without a branch.
"""

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.jit import kernel
from shapecat.surface.lanes import LANES, adapt, two_nearest

__all__ = ["ABSENT", "FAR", "grow_fritzke", "grow_thesis", "index_mask", "nearest_spacing"]

ABSENT = np.int32(1 << 29)
FAR = np.float32(1e18)


@kernel
def index_mask(count: int) -> int:
    """Return the least 2**k - 1 that is at least ``count - 1``."""
    mask = 1
    while mask < count:
        mask <<= 1
    return mask - 1


@kernel
def _connect(born: I4, wins: I4, degree: I4, stride: int, a: int, b: int) -> None:
    if born[a * stride + b] == ABSENT:
        degree[a] += 1
        degree[b] += 1
    age_zero = wins[a] + wins[b]
    born[a * stride + b] = age_zero
    born[b * stride + a] = age_zero


@kernel
def _disconnect(born: I4, degree: I4, stride: int, a: int, b: int) -> None:
    born[a * stride + b] = ABSENT
    born[b * stride + a] = ABSENT
    degree[a] -= 1
    degree[b] -= 1


@kernel
def _drop_old_edges(
    born: I4, wins: I4, degree: I4, stride: int, count: int, a: int, oldest: int
) -> None:
    for j in range(count):
        edge = born[a * stride + j]
        # differs: an edge stays when it is the last of either end, so that no neuron is ever
        # isolated and none has to be removed.
        if edge < ABSENT and wins[a] + wins[j] - edge > oldest and degree[a] > 1 and degree[j] > 1:
            _disconnect(born, degree, stride, a, j)


@kernel
def _insert(
    x: F4,
    y: F4,
    z: F4,
    error: F4,
    born: I4,
    wins: I4,
    degree: I4,
    stride: int,
    count: int,
    q: int,
) -> int:
    """Insert neuron ``count`` between q and its worst neighbour f; return f."""
    f = -1
    for j in range(count):
        if born[q * stride + j] < ABSENT and (f < 0 or error[j] > error[f]):
            f = j
    x[count] = np.float32(0.5) * (x[q] + x[f])
    y[count] = np.float32(0.5) * (y[q] + y[f])
    z[count] = np.float32(0.5) * (z[q] + z[f])
    _disconnect(born, degree, stride, q, f)
    _connect(born, wins, degree, stride, q, count)
    _connect(born, wins, degree, stride, f, count)
    return f


@kernel
def _shuffle(order: I4, state: int) -> int:
    """Shuffle in place (Fisher-Yates) with a 64-bit linear congruential generator."""
    for i in range(order.size - 1, 0, -1):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        j = np.int64(((state >> np.uint64(32)) * np.uint64(i + 1)) >> np.uint64(32))
        order[i], order[j] = order[j], order[i]
    return state


@kernel(fast=True)
def grow_fritzke(
    px: F4,
    py: F4,
    pz: F4,
    state: int,
    x: F4,
    y: F4,
    z: F4,
    born: I4,
    degree: I4,
    count: int,
    target: int,
    signals: int,
    interval: int,
    rate_winner: float,
    rate_neighbour: float,
    oldest: int,
) -> int:
    """Fire ``signals`` points into a gas of ``count`` >= 2 neurons; return the new count.

    Source: Fritzke 1995, thesis Algorithm 3, whose steps are numbered below (steps 1 to 3 are the
    caller's). A neuron is inserted every ``interval`` signals until there are ``target``. The two
    learning rates fall linearly to a tenth; the error of all neurons decays by 0.0005 a signal.
    """
    capacity = x.size
    stride = capacity
    mask = index_mask(capacity)
    wins = np.zeros(capacity, np.int32)
    error = np.zeros(capacity, np.float32)
    order = np.arange(px.size)
    cursor = px.size
    gain = 1.0  # step 12 lazily: instead of all errors falling, each new one counts more
    fall = np.float32(0.9 / signals)
    anneal = np.float32(1)
    until = interval
    for _ in range(signals):
        if cursor == px.size:
            state = _shuffle(order, state)
            cursor = 0
        # 4. differs: every point once an epoch, in random order, rather than independent draws.
        k = order[cursor]
        cursor += 1
        sx, sy, sz = px[k], py[k], pz[k]
        # 5. the nearest and the second nearest neuron
        padded = (count + LANES - 1) // LANES * LANES
        a, b = two_nearest(x, y, z, padded, sx, sy, sz, mask)
        # 6. the edges of the nearest get older
        wins[a] += 1
        # 7. error
        dx, dy, dz = x[a] - sx, y[a] - sy, z[a] - sz
        error[a] += np.float32(gain) * (dx * dx + dy * dy + dz * dz)
        # 8. adapt. differs: the rates fall, so that the gas comes to rest.
        age = wins[a] + adapt(
            x,
            y,
            z,
            padded,
            sx,
            sy,
            sz,
            born,
            a * stride,
            ABSENT,
            wins,
            a,
            rate_winner * anneal,
            rate_neighbour * anneal,
        )
        anneal -= fall
        # 9. connect the two, or refresh their edge
        _connect(born, wins, degree, stride, a, b)
        # 10. old edges
        if age > oldest:
            _drop_old_edges(born, wins, degree, stride, count, a, oldest)
        # 11. insertion
        until -= 1
        if until == 0 and count < target:
            until = interval
            q = 0
            for i in range(count):
                if error[i] > error[q]:
                    q = i
            f = _insert(x, y, z, error, born, wins, degree, stride, count, q)
            error[q] *= np.float32(0.5)
            error[f] *= np.float32(0.5)
            error[count] = error[q]
            count += 1
        # 12. all errors fall
        gain *= 1.0 / 0.9995
        if gain > 1e6:
            for i in range(count):
                error[i] *= np.float32(1e-6)
            gain *= 1e-6
    # 13. the number of signals is the stopping criterion
    return count


@kernel(fast=True)
def grow_thesis(
    px: F4,
    py: F4,
    pz: F4,
    state: int,
    x: F4,
    y: F4,
    z: F4,
    born: I4,
    degree: I4,
    count: int,
    target: int,
    epochs: int,
    error_limit: float,
    distance_limit: float,
    rate_winner: float,
    rate_neighbour: float,
    oldest: int,
) -> int:
    """Grow the gas epoch by epoch until it is close to the points; return the new count.

    Source: thesis 5.2, Algorithm 4: as Algorithm 3 (see `grow_fritzke` for steps 1 to 10), but
    step 12 inserts a neuron where the error exceeds ``error_limit`` (t_gamma), and step 18 fires
    the cloud again until the mean distance from neurons to their nearest point (psi) is below
    ``distance_limit`` (t_alpha), or for at most ``epochs`` epochs.
    """
    capacity = x.size
    stride = capacity
    mask = index_mask(capacity)
    wins = np.zeros(capacity, np.int32)
    error = np.zeros(capacity, np.float32)
    order = np.arange(px.size)
    fall = np.float32(0.9 / (epochs * px.size))
    anneal = np.float32(1)
    for epoch in range(epochs):
        # differs: errors restart with each epoch; summed over epochs any limit is exceeded and the
        # gas grows without bound.
        error[:] = 0
        before = wins.copy()
        present = count
        pause = 0
        state = _shuffle(order, state)
        for k in order:
            sx, sy, sz = px[k], py[k], pz[k]
            padded = (count + LANES - 1) // LANES * LANES
            a, b = two_nearest(x, y, z, padded, sx, sy, sz, mask)
            wins[a] += 1
            dx, dy, dz = x[a] - sx, y[a] - sy, z[a] - sz
            error[a] += dx * dx + dy * dy + dz * dz
            age = wins[a] + adapt(
                x,
                y,
                z,
                padded,
                sx,
                sy,
                sz,
                born,
                a * stride,
                ABSENT,
                wins,
                a,
                rate_winner * anneal,
                rate_neighbour * anneal,
            )
            anneal -= fall
            _connect(born, wins, degree, stride, a, b)
            if age > oldest:
                _drop_old_edges(born, wins, degree, stride, count, a, oldest)
            # 12. insert where the error is too large. differs: at most once in four signals and
            # with the errors of all three neurons set to zero; with the published halving the
            # first epoch ends with as many neurons as fit.
            pause -= 1
            if error[a] > error_limit and pause <= 0 and count < target:
                pause = 4
                f = _insert(x, y, z, error, born, wins, degree, stride, count, a)
                error[a] = 0
                error[f] = 0
                error[count] = 0
                before[count] = -1
                count += 1
        # differs: neurons that won no signal of an epoch they were there for lie between
        # surfaces; they are removed.
        if present > 2:
            count = _prune(x, y, z, born, wins, degree, stride, count, before)
        # 18. stop when the neurons are close to the points
        if epoch + 1 >= 3 and _mean_distance(px, py, pz, x, y, z, count) < distance_limit:
            break
    return count


@kernel
def _prune(
    x: F4, y: F4, z: F4, born: I4, wins: I4, degree: I4, stride: int, count: int, before: I4
) -> int:
    """Remove the neurons whose ``wins`` is still ``before``; return how many stay (>= 2)."""
    i = 0
    while i < count and count > 2:
        if wins[i] != before[i]:
            i += 1
            continue
        neighbours = np.zeros(count, np.int64)
        found = 0
        for j in range(count):
            if born[i * stride + j] < ABSENT:
                neighbours[found] = j
                found += 1
        for k in range(found):
            # Its neighbours are linked to the first of them, so that none is left alone.
            if k > 0:
                _connect(born, wins, degree, stride, neighbours[0], neighbours[k])
        for k in range(found):
            _disconnect(born, degree, stride, i, neighbours[k])
        if found == 1 and degree[neighbours[0]] == 0:
            other = 0
            while other == i or other == neighbours[0]:
                other += 1
            _connect(born, wins, degree, stride, other, neighbours[0])
        count -= 1
        _move(x, y, z, born, wins, degree, before, stride, count, i)
    return count


@kernel
def _move(
    x: F4,
    y: F4,
    z: F4,
    born: I4,
    wins: I4,
    degree: I4,
    before: I4,
    stride: int,
    source: int,
    place: int,
) -> None:
    """Give the last neuron, ``source``, the free ``place``."""
    if source != place:
        x[place], y[place], z[place] = x[source], y[source], z[source]
        wins[place], before[place], degree[place] = wins[source], before[source], degree[source]
        for j in range(source):
            edge = born[source * stride + j]
            if j != place:
                born[place * stride + j] = edge
                born[j * stride + place] = edge
            born[source * stride + j] = ABSENT
            born[j * stride + source] = ABSENT
    x[source] = FAR
    y[source] = FAR
    z[source] = FAR
    wins[source] = 0
    degree[source] = 0


@kernel(fast=True)
def _mean_distance(px: F4, py: F4, pz: F4, x: F4, y: F4, z: F4, count: int) -> float:
    """Return psi: the mean distance from the neurons to their nearest point."""
    total = 0.0
    for i in range(count):
        total += np.sqrt(_nearest_squared(px, py, pz, x[i], y[i], z[i]))
    return total / count


@kernel(fast=True)
def _nearest_squared(px: F4, py: F4, pz: F4, x: float, y: float, z: float) -> float:
    best = FAR
    for k in range(px.size):
        dx, dy, dz = px[k] - x, py[k] - y, pz[k] - z
        squared = dx * dx + dy * dy + dz * dz
        best = squared if squared < best else best
    return best


@kernel(fast=True)
def nearest_spacing(px: F4, py: F4, pz: F4, samples: int) -> float:
    """Return the mean distance to the nearest other point, over a sample of the points."""
    step = max(1, px.size // samples)
    total = 0.0
    taken = 0
    for i in range(0, px.size, step):
        best = FAR
        for k in range(px.size):
            dx, dy, dz = px[k] - px[i], py[k] - py[i], pz[k] - pz[i]
            squared = dx * dx + dy * dy + dz * dz
            squared = squared if k != i else FAR
            best = squared if squared < best else best
        total += np.sqrt(best)
        taken += 1
    return total / taken
