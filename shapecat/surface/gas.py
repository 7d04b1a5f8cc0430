"""Surface reconstruction: from the points of an object to a graph of neurons."""

import numpy as np

from shapecat.arrays import F4, F8, U2
from shapecat.config import SurfaceSettings
from shapecat.jit import kernel
from shapecat.surface.graph import GRID_SPACING, edge_list, finish_graph
from shapecat.surface.growth import Cloud, Rates, grow_fritzke, grow_thesis
from shapecat.surface.neurons import FAR, Gas, connect, empty_gas
from shapecat.surface.voxels import read_only
from shapecat.types import NeuralGas

__all__ = ["MIN_POINTS", "reconstruct"]

MIN_POINTS = 24
"""Minimum number of points from which a surface is learned."""
_MAX_POINTS = 1200
"""Maximum number of points used, every k-th of a larger cloud. More points only take longer."""
_NEURONS_PER_POINT = 0.45
"""Maximum number of neurons per point."""
_FEWEST_NEURONS = 12
"""Lower bound of that maximum number of neurons, for small clouds."""
_SPACING_SAMPLES = 64
"""Approximate number of points whose distance to the nearest other point is averaged."""
_RATES = Rates(winner=0.1, neighbour=0.006, oldest=30)
_GROWTH = 0.6
"""Fraction of the signals after which all neurons have been inserted."""
_EPOCHS = 8
"""Maximum number of epochs of Algorithm 4, which rarely reaches its distance limit sooner."""
_ERROR_LIMIT = 3.0
"""Error limit (t_gamma in the thesis), relative to the error that a neuron collects in an epoch if
all neurons have equal shares of the surface."""
_DISTANCE_LIMIT = 0.7
"""Distance limit (t_alpha in the thesis), relative to the spacing of the points: smaller distances
are noise."""


def reconstruct(
    points: F4, *, settings: SurfaceSettings, rng: np.random.Generator
) -> NeuralGas | None:
    """Learn the surface of one object as a graph.

    Coordinates are normalised by the size of the object: moving or scaling the points does the
    same to the neurons, up to rounding.

    Parameters
    ----------
    points : (m, 3) metres, finite, evenly spread (see `voxelize`), in any frame. If there are more
        than 1200, every k-th point is used.
    settings : with ``method`` "fritzke" a neuron is inserted at a fixed interval of signals (thesis
        Algorithm 3), with "thesis" where the error is large (Algorithm 4).
    rng : used for one draw; the same points, settings and generator state give the same graph.

    Returns
    -------
    A connected graph of at least 3 neurons, each the mean of some of the points. None if there are
    fewer than `MIN_POINTS` points, or if they lie in so few places that fewer than 3 neurons
    remain.

    Raises
    ------
    ValueError : the points are not (m, 3) or not finite.

    Notes
    -----
    Time grows with the product of signals and neurons, and hardly depends on the number of points.
    Sources: Fritzke, *A growing neural gas network learns topologies*, 1995; thesis ch. 5.
    Deviations are marked ``differs:`` in the kernels.
    """
    points = read_only(points)
    if len(points) < MIN_POINTS:
        return None
    if not np.isfinite(points).all():
        msg = "points must be finite"
        raise ValueError(msg)
    seed = int(rng.integers(1 << 62))
    if settings.method == "thesis":
        neurons, edges = _by_thesis(points, seed, settings.neurons, settings.component_share)
    else:
        neurons, edges = _by_fritzke(
            points, seed, settings.neurons, settings.signals, settings.component_share
        )
    return NeuralGas(neurons, edges) if len(neurons) else None


@kernel
def _by_fritzke(points: F4, seed: int, neurons: int, signals: int, share: float) -> tuple[F4, U2]:
    """Grow a gas on points (m, 3), metres, by Algorithm 3 of the thesis.

    ``neurons``, ``signals`` and ``share`` (``component_share``) are as in `SurfaceSettings`;
    ``seed`` starts the random generator. Returns the neurons (k, 3), metres, and the edges (e, 2),
    pairs of their indices; both are empty if fewer than 3 neurons remain.
    """
    cloud, shift_scale = _normalise(points)
    target = _target_size(cloud, neurons)
    gas = empty_gas(target)
    state = np.uint64(seed)
    interval = int(_GROWTH * signals) // target
    _link_two_points(cloud, gas, state)
    count = grow_fritzke(cloud, state, gas, target, signals, max(interval, 1), _RATES)
    adjacent = finish_graph(cloud, gas, int(count), share)  # int(): else numba compiles it twice
    return _in_metres(gas, adjacent.shape[0], shift_scale), edge_list(adjacent)


@kernel
def _by_thesis(points: F4, seed: int, neurons: int, share: float) -> tuple[F4, U2]:
    """Grow a gas on points (m, 3), metres, by Algorithm 4 of the thesis.

    The other parameters and the results are as in `_by_fritzke`, but up to twice as many neurons
    grow.
    """
    cloud, shift_scale = _normalise(points)
    target = _target_size(cloud, neurons)
    # differs: a bound on the neurons, for memory; and thresholds relative to the object. If a
    # neuron's share of the surface is a square of side h, the mean squared distance of its points
    # is h**2 / 6.
    gas = empty_gas(2 * target)
    state = np.uint64(seed)
    _link_two_points(cloud, gas, state)
    spacing = _spacing(cloud)
    each = cloud.x.size / target
    square = each * (GRID_SPACING * spacing) ** 2
    count = grow_thesis(
        cloud, state, gas, 2 * target, _EPOCHS,
        _ERROR_LIMIT * each * square / 6, _DISTANCE_LIMIT * spacing,
        _RATES,
    )  # fmt: skip
    adjacent = finish_graph(cloud, gas, int(count), share)  # int(): else numba compiles it twice
    return _in_metres(gas, adjacent.shape[0], shift_scale), edge_list(adjacent)


@kernel(inner=True)
def _normalise(points: F4) -> tuple[Cloud, F8]:
    """Return at most `_MAX_POINTS` points, normalised to -1 to 1, and the shift and scale (4,).

    The shift is the mean (x, y, z), the scale the largest distance from it along an axis, metres.
    """
    step = (points.shape[0] + _MAX_POINTS - 1) // _MAX_POINTS
    size = (points.shape[0] + step - 1) // step
    shift_scale = np.zeros(4)
    for i in range(0, points.shape[0], step):
        for axis in range(3):
            shift_scale[axis] += points[i, axis] / size
    for i in range(points.shape[0]):
        for axis in range(3):
            shift_scale[3] = max(shift_scale[3], abs(points[i, axis] - shift_scale[axis]))
    unit = shift_scale[3] if shift_scale[3] > 0 else 1.0
    x = np.zeros(size, np.float32)
    y = np.zeros(size, np.float32)
    z = np.zeros(size, np.float32)
    for i in range(size):
        x[i] = (points[i * step, 0] - shift_scale[0]) / unit
        y[i] = (points[i * step, 1] - shift_scale[1]) / unit
        z[i] = (points[i * step, 2] - shift_scale[2]) / unit
    return Cloud(x, y, z), shift_scale


@kernel(inner=True)
def _in_metres(gas: Gas, count: int, shift_scale: F8) -> F4:
    """Return the first ``count`` neurons, (count, 3) metres.

    ``shift_scale`` (4,) is from `_normalise`.
    """
    neurons = np.zeros((count, 3), np.float32)
    for i in range(count):
        neurons[i, 0] = gas.x[i] * shift_scale[3] + shift_scale[0]
        neurons[i, 1] = gas.y[i] * shift_scale[3] + shift_scale[1]
        neurons[i, 2] = gas.z[i] * shift_scale[3] + shift_scale[2]
    return neurons


@kernel(inner=True)
def _target_size(cloud: Cloud, neurons: int) -> int:
    """Return the number of neurons to grow: ``neurons``, or fewer in a small cloud; at least 3."""
    max_neurons = max(_FEWEST_NEURONS, int(_NEURONS_PER_POINT * cloud.x.size))
    return max(3, min(neurons, max_neurons))


@kernel
def _link_two_points(cloud: Cloud, gas: Gas, state: np.uint64) -> None:
    """Do steps 1 to 3 of both algorithms: link two neurons at random points.

    One point is from each half of ``cloud``; ``state`` is 64 random bits.
    """
    half = cloud.x.size // 2
    for i in range(2):
        k = i * half + np.int64((state >> np.uint64(20 * i)) % np.uint64(half))
        gas.x[i], gas.y[i], gas.z[i] = cloud.x[k], cloud.y[k], cloud.z[k]
    connect(gas, 0, 1)


@kernel(fast=True, inner=True)
def _spacing(cloud: Cloud) -> float:
    """Return the mean distance to the nearest other point, over a sample of the points."""
    x, y, z = cloud.x, cloud.y, cloud.z
    step = max(1, x.size // _SPACING_SAMPLES)
    total = 0.0
    samples = 0
    for i in range(0, x.size, step):
        best = FAR
        for k in range(x.size):
            dx, dy, dz = x[k] - x[i], y[k] - y[i], z[k] - z[i]
            squared = dx * dx + dy * dy + dz * dz
            squared = squared if k != i else FAR
            best = squared if squared < best else best
        total += np.sqrt(best)
        samples += 1
    return total / samples
