"""Surface reconstruction: from the points of an object to a graph of neurons."""

import numpy as np

from shapecat.arrays import F4, I4, U2
from shapecat.config import SurfaceSettings
from shapecat.jit import kernel
from shapecat.surface.graph import link
from shapecat.surface.growth import (
    ABSENT,
    FAR,
    grow_fritzke,
    grow_thesis,
    nearest_spacing,
)
from shapecat.surface.lanes import LANES
from shapecat.types import NeuralGas

__all__ = ["MIN_POINTS", "reconstruct"]

MIN_POINTS = 24
"""Clouds with fewer points have no surface to speak of."""
MAX_NEURONS = 512
"""Most neurons that can be asked for: winner search keeps the index in 9 or 10 bits of a float."""
_MAX_POINTS = 1200
"""Of more points every k-th is fired: the result does not get better, only slower."""
_FEWEST_NEURONS = 12
_POINTS_PER_NEURON = 1 / 0.45
_RATE_NEIGHBOUR = 0.06
"""Learning rate of the neighbours as a share of the winner's."""
_EPOCHS = 8
"""Most epochs of the thesis's rule."""


def reconstruct(
    points: F4,
    *,
    settings: SurfaceSettings,
    rng: np.random.Generator,
    start: NeuralGas | None = None,
) -> NeuralGas | None:
    """Learn the surface of one object as a graph.

    The gas is computed in units of the cloud's own size: scaling or moving the points does the
    same to the neurons, up to rounding.

    Parameters
    ----------
    points : (m, 3) metres, finite, evenly spread (see `voxelize`). Of more than 1200 every k-th
        is used.
    rng : draws one number; the same points, settings and generator give the same graph.
    start : an earlier graph of the same object, near the points, in their frame. It is adapted
        with ``settings.warm_signals`` signals instead of growing from two neurons; only with
        ``method="fritzke"``.

    Returns
    -------
    A connected graph of 3 or more neurons, each the nearest of some point, without isolated
    neurons; within the hull of the points, unless a warm start left some beside it. None for fewer
    than `MIN_POINTS` points, or where they lie in fewer than three places.

    Raises
    ------
    ValueError : the points are not finite or not (m, 3), or the settings ask for more than 512
        neurons.

    Notes
    -----
    Sources: Fritzke, *A growing neural gas network learns topologies*, 1995; thesis ch. 5.
    Time is proportional to signals times neurons and hardly depends on the number of points.
    """
    points = np.ascontiguousarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        msg = f"expected points of shape (m, 3), got {points.shape}"
        raise ValueError(msg)
    if settings.neurons > MAX_NEURONS:
        msg = f"at most {MAX_NEURONS} neurons, got {settings.neurons}"
        raise ValueError(msg)
    if len(points) < MIN_POINTS:
        return None
    warm = start is not None and settings.method == "fritzke"
    neurons, edges, finite = _reconstruct(
        points,
        int(rng.integers(1 << 62)),
        settings.method == "thesis",
        settings.neurons,
        settings.warm_signals if warm else settings.signals,
        settings.component_share,
        start.neurons if start is not None and warm else _NO_NEURONS,
        start.edges if start is not None and warm else _NO_EDGES,
    )
    if not finite:
        msg = "points must be finite"
        raise ValueError(msg)
    return NeuralGas(neurons, edges) if len(neurons) else None


_NO_NEURONS = np.zeros((0, 3), np.float32)
_NO_EDGES = np.zeros((0, 2), np.uint16)
for _constant in (_NO_NEURONS, _NO_EDGES):
    _constant.flags.writeable = False  # as the arrays of a NeuralGas: one compiled signature


@kernel
def _reconstruct(
    points: F4,
    seed: int,
    thesis: bool,
    neurons: int,
    signals: int,
    share: float,
    start_neurons: F4,
    start_edges: U2,
) -> tuple[F4, U2, bool]:
    """Return neurons, edges, and whether the points were finite."""
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.uint16)
    step = (points.shape[0] + _MAX_POINTS - 1) // _MAX_POINTS
    size = (points.shape[0] + step - 1) // step
    mean_x = mean_y = mean_z = 0.0
    for i in range(0, points.shape[0], step):
        mean_x += points[i, 0] / size
        mean_y += points[i, 1] / size
        mean_z += points[i, 2] / size
    extent = 0.0
    for i in range(0, points.shape[0], step):
        extent = max(extent, abs(points[i, 0] - mean_x))
        extent = max(extent, abs(points[i, 1] - mean_y))
        extent = max(extent, abs(points[i, 2] - mean_z))
    if not extent < np.inf:
        return nothing[0], nothing[1], False
    if extent == 0.0:
        return nothing[0], nothing[1], True
    px = np.zeros(size, np.float32)
    py = np.zeros(size, np.float32)
    pz = np.zeros(size, np.float32)
    for i in range(size):
        px[i] = (points[i * step, 0] - mean_x) / extent
        py[i] = (points[i * step, 1] - mean_y) / extent
        pz[i] = (points[i * step, 2] - mean_z) / extent

    wanted = max(3, min(neurons, max(_FEWEST_NEURONS, int(size / _POINTS_PER_NEURON))))
    most = 2 * wanted if thesis else wanted
    capacity = (max(most, start_neurons.shape[0]) + LANES) // LANES * LANES
    x = np.full(capacity, FAR, np.float32)
    y = np.full(capacity, FAR, np.float32)
    z = np.full(capacity, FAR, np.float32)
    born = np.full(capacity * capacity, ABSENT, np.int32)
    degree = np.zeros(capacity, np.int32)
    state = np.uint64(seed)

    count = 0
    if start_neurons.shape[0] > 2:
        count = start_neurons.shape[0]
        for i in range(count):
            x[i] = (start_neurons[i, 0] - mean_x) / extent
            y[i] = (start_neurons[i, 1] - mean_y) / extent
            z[i] = (start_neurons[i, 2] - mean_z) / extent
        count = _adopt(px, py, pz, x, y, z, born, degree, count, start_edges)
    if count > 2:
        missing = max(1, wanted - count)
        interval = max(1, min(60, int(0.6 * signals) // missing))
        count = grow_fritzke(
            px,
            py,
            pz,
            state,
            x,
            y,
            z,
            born,
            degree,
            count,
            wanted,
            signals,
            interval,
            0.15,
            0.15 * _RATE_NEIGHBOUR,
            50,
        )
    else:
        count = 2
        # 1. to 3. two of the points, linked
        for i in range(2):
            k = i * (size // 2) + np.int64((state >> np.uint64(20 * i)) % np.uint64(size // 2))
            x[i], y[i], z[i] = px[k], py[k], pz[k]
        born[1] = 0
        born[capacity] = 0
        degree[:2] = 1
        if thesis:
            # differs: thresholds are relative to the object. A neuron's share of the surface is
            # a square of side h with mean squared distance h**2 / 6 to its centre.
            spacing = nearest_spacing(px, py, pz, 64)
            h2 = size * (1.15 * spacing) ** 2 / wanted
            count = grow_thesis(
                px,
                py,
                pz,
                state,
                x,
                y,
                z,
                born,
                degree,
                count,
                most,
                _EPOCHS,
                3.0 * (size / wanted) * h2 / 6.0,
                0.7 * spacing,
                0.1,
                0.1 * _RATE_NEIGHBOUR,
                30,
            )
        else:
            interval = max(1, int(0.6 * signals) // wanted)
            count = grow_fritzke(
                px,
                py,
                pz,
                state,
                x,
                y,
                z,
                born,
                degree,
                count,
                wanted,
                signals,
                interval,
                0.1,
                0.1 * _RATE_NEIGHBOUR,
                30,
            )
    count, adjacent = link(px, py, pz, x, y, z, born, count, share)
    result = np.zeros((count, 3), np.float32)
    for i in range(count):
        result[i, 0] = x[i] * extent + mean_x
        result[i, 1] = y[i] * extent + mean_y
        result[i, 2] = z[i] * extent + mean_z
    edges = np.zeros((count * count // 2, 2), np.uint16)
    found = 0
    for i in range(count):
        for j in range(i + 1, count):
            if adjacent[i, j]:
                edges[found, 0] = i
                edges[found, 1] = j
                found += 1
    return result, edges[:found].copy(), True


@kernel
def _adopt(
    px: F4,
    py: F4,
    pz: F4,
    x: F4,
    y: F4,
    z: F4,
    born: I4,
    degree: I4,
    count: int,
    edges: U2,
) -> int:
    """Take over an earlier graph without the neurons that are nearest to no point.

    Returns the number of neurons that stay, 0 where fewer than 3 do. A neuron that loses its last
    neighbour is linked to the one before it.
    """
    members = np.zeros(count, np.int64)
    for k in range(px.size):
        best = np.inf
        nearest = 0
        for i in range(count):
            squared = (x[i] - px[k]) ** 2 + (y[i] - py[k]) ** 2 + (z[i] - pz[k]) ** 2
            if squared < best:
                best, nearest = squared, i
        members[nearest] += 1
    stride = x.size
    place = np.full(count, -1, np.int64)
    kept = 0
    for i in range(count):
        if members[i] > 0:
            place[i] = kept
            x[kept], y[kept], z[kept] = x[i], y[i], z[i]
            kept += 1
    x[kept:count] = FAR
    y[kept:count] = FAR
    z[kept:count] = FAR
    if kept < 3:
        return 0
    for e in range(edges.shape[0]):
        i, j = np.int64(edges[e, 0]), np.int64(edges[e, 1])
        if i < count and j < count and place[i] >= 0 and place[j] >= 0 and i != j:
            _link_fresh(born, degree, stride, place[i], place[j])
    for i in range(kept):
        if degree[i] == 0:
            _link_fresh(born, degree, stride, i, i - 1 if i > 0 else 1)
    return kept


@kernel
def _link_fresh(born: I4, degree: I4, stride: int, i: int, j: int) -> None:
    if born[i * stride + j] == ABSENT:
        degree[i] += 1
        degree[j] += 1
    born[i * stride + j] = 0
    born[j * stride + i] = 0
