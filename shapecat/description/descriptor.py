"""The shape descriptor of an object: a vector of fixed length."""

import numpy as np

from shapecat.arrays import F4, F8, I4, U2
from shapecat.description.blocks import BLOCKS, DESCRIPTOR_NAMES
from shapecat.description.context import context
from shapecat.description.curvature import assign, fit_surfaces
from shapecat.description.distances import euclidean_distances, geodesic_distances, mean_gap
from shapecat.description.distributions import distributions
from shapecat.description.outline import outline
from shapecat.description.profile import profile, vertical_axis
from shapecat.description.ranges import outer_range
from shapecat.description.revolution import revolution
from shapecat.description.rotation_axis import rotation_axis
from shapecat.description.solids import solids
from shapecat.description.surface import Surface
from shapecat.jit import kernel
from shapecat.types import NeuralGas

__all__ = ["describe"]

_MAX_POINTS = 1200
_GRID_SPACING = 1.15
"""Spacing of a square grid with the same density of neurons, relative to their mean gap."""
_RADIUS = 2.2 * _GRID_SPACING
"""Radius of the neighbourhoods in which curvature is fitted, in mean gaps between neurons."""
_REACH = 3 * _GRID_SPACING
"""Maximum distance of a point from its nearest neuron, in mean gaps between neurons; farther points
are ignored."""
_FAR = 1e6
"""Largest coordinate of a point or the sensor, in mean distances between neurons."""


# kernels read numbers, not dictionaries
_CONTEXT, _CURVED = BLOCKS["context"].start, BLOCKS["curvature"].start
_PROFILE, _REVOLUTION, _SOLIDS, _OUTLINE = (
    BLOCKS[name].start for name in ("profile", "revolution", "solids", "outline")
)
_METRIC = BLOCKS["metric"].start  # up to the end: the view is last


def describe(points: F4, gas: NeuralGas, eye: F4) -> F4:
    """Describe the shape of one object seen from one side.

    Parameters
    ----------
    points : (m, 3) metres, finite, level frame: z up, the support at z = 0, and the origin anywhere
        on it. If there are more than 1200, every k-th point is used.
    gas : the graph of the points, in the same frame, with at least 2 neurons.
    eye : (3,) metres, the position of the sensor in the same frame.

    Returns
    -------
    (d,) finite float32 features, named by `DESCRIPTOR_NAMES`, in the blocks `BLOCKS`. They are
    invariant to rotations about z and to translations along x and y. All but the blocks ``metric``
    and ``view`` are also invariant to scaling about the origin.

    Raises
    ------
    ValueError : an array has the wrong shape or is not finite, or the graph has fewer than 2
        neurons or an edge to a neuron that does not exist.

    Notes
    -----
    Sources: thesis ch. 6; shape distributions: Osada et al. 2002; shape index and curvedness:
    Koenderink and van Doorn 1992.
    """
    points = np.ascontiguousarray(points, np.float32)
    eye = np.ascontiguousarray(eye, np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or eye.shape != (3,):
        msg = f"expected points (m, 3) and eye (3,), got {points.shape} and {eye.shape}"
        raise ValueError(msg)
    if len(gas.neurons) < 2:
        msg = f"a descriptor needs at least 2 neurons, got {len(gas.neurons)}"
        raise ValueError(msg)
    points, eye = points.view(), eye.view()
    points.flags.writeable = eye.flags.writeable = False  # one compiled version
    result = np.zeros(len(DESCRIPTOR_NAMES), np.float32)
    if gas.edges.size and int(gas.edges.max()) >= len(gas.neurons):
        msg = f"edge to neuron {gas.edges.max()} of {len(gas.neurons)}"
        raise ValueError(msg)
    if not all(np.isfinite(values).all() for values in (points, gas.neurons, eye)):
        msg = "points, neurons and eye must be finite"
        raise ValueError(msg)
    _describe(points, gas.neurons, gas.edges, eye, result)
    return result


def _describe(points: F4, neurons: F4, edges: U2, eye: F4, out: F4) -> None:
    """Write the descriptor to ``out`` (d,).

    ``points`` and ``eye`` are as in `describe`; ``neurons`` (k, 3) and ``edges`` (e, 2) are the
    graph of the points. Each block is a kernel of its own: a single kernel would take two seconds
    more to compile.
    """
    surface = _prepare(points, neurons, edges, eye)
    cloud, weight, unit = surface.points, surface.weight, surface.unit
    x, y, z = surface.neurons
    radius = np.float32(_RADIUS * surface.spacing)
    normals, curvatures = fit_surfaces(
        cloud, surface.starts, x, y, z, surface.euclidean, radius, surface.eye
    )
    low, high = _height_range(cloud[2])
    upright = vertical_axis(x, y, normals, weight)
    wide, across, along = context(
        surface, normals, curvatures, upright, low, high, out[_CONTEXT:_CURVED]
    )
    distributions(surface, normals, curvatures, out)
    profile(surface, normals, curvatures, upright, low, high, out[_PROFILE:_REVOLUTION])
    axis, point = rotation_axis(x, y, z, weight, normals)
    revolved, foot = out[_REVOLUTION:_SOLIDS], np.array((upright.x, upright.y, 0.0))
    revolution(surface, normals, axis, point, foot, revolved)
    solids(
        cloud, surface.nearest, x, y, normals, surface.eye, low, high, revolved,
        out[_SOLIDS:_OUTLINE],
    )  # fmt: skip
    outline(cloud, surface.eye, out[_OUTLINE:_METRIC])
    away_m = surface.eye_distance_m
    out[_METRIC:] = (
        (high - low) * unit,
        low * unit + surface.center[2],
        wide * unit,
        across * unit,
        along * unit,
        surface.spacing * unit,
        (eye[2] - surface.center[2]) / away_m if away_m > 0 else 0.0,
        away_m,
    )


@kernel
def _prepare(points: F4, neurons: F4, edges: U2, eye: F4) -> Surface:
    """Return the object as a `Surface`; the parameters are as in `_describe`."""
    rows, euclidean, center, unit = _own_units(neurons)
    x, y, z = rows[0], rows[1], rows[2]
    away = 0.0
    for axis in range(3):
        away += (eye[axis] - center[axis]) ** 2
    away = np.sqrt(away)
    place = np.zeros(3, np.float32)
    for axis in range(3):
        place[axis] = (eye[axis] - center[axis]) / max(unit, away / _FAR)
    spacing = max(mean_gap(euclidean), 1e-3)
    geodesic = geodesic_distances(euclidean, edges)
    cloud, starts = assign(_cloud_of(points, center, unit), x, y, z, np.float32(_REACH * spacing))
    if cloud.shape[1] == 0:
        # no point is near: describe the neurons themselves
        cloud = rows
        for i in range(x.size):
            starts[i + 1] = i + 1
    weight = np.zeros(x.size, np.float32)
    for i in range(x.size):
        weight[i] = (starts[i + 1] - starts[i]) / cloud.shape[1]
    nearest = _nearest_neurons(starts)
    return Surface(
        cloud,
        starts,
        nearest,
        rows,
        euclidean,
        geodesic,
        weight,
        spacing,
        place,
        away,
        center,
        unit,
    )


@kernel(inline=True)
def _cloud_of(points: F4, center: F8, unit: float) -> F4:
    """Return at most `_MAX_POINTS` points (3, n), relative to ``center``, in units of ``unit``.

    ``points`` (m, 3), ``center`` (3,) and ``unit`` are in metres.
    """
    step = (points.shape[0] + _MAX_POINTS - 1) // _MAX_POINTS
    total = (points.shape[0] + step - 1) // step
    cloud = np.zeros((3, total), np.float32)
    for k in range(total):
        for axis in range(3):
            # points this far away belong to no neuron: the bound keeps squares finite
            value = (points[k * step, axis] - center[axis]) / unit
            cloud[axis, k] = min(max(value, -_FAR), _FAR)
    return cloud


@kernel(inline=True)
def _nearest_neurons(starts: I4) -> I4:
    """Return the neuron (n,) of each point; points and ``starts`` are from `assign`."""
    owner = np.zeros(starts[-1], np.int64)
    for k in range(starts.size - 1):
        for i in range(starts[k], starts[k + 1]):
            owner[i] = k
    return owner


@kernel(inline=True)
def _own_units(neurons: F4) -> tuple[F4, F4, F8, float]:
    """Return the neurons relative to their mean, in units of the mean distance between them.

    ``neurons`` (n, 3) are in metres. The result is the neurons (3, n) and their distances (n, n) in
    this unit, the mean (3,) in metres, and the unit in metres, which is 1 if all neurons coincide.
    """
    count = neurons.shape[0]
    center = np.zeros(3)
    for i in range(count):
        for axis in range(3):
            center[axis] += neurons[i, axis] / count
    unit = 0.0
    for i in range(count):
        for axis in range(3):
            unit = max(unit, abs(neurons[i, axis] - center[axis]))
    unit = unit if unit > 0 else 1.0
    rows = np.zeros((3, count), np.float32)
    euclidean = np.zeros((count, count), np.float32)
    for _ in range(2):  # first by the largest coordinate, so that squares stay finite
        for i in range(count):
            for axis in range(3):
                rows[axis, i] = (neurons[i, axis] - center[axis]) / unit
        euclidean = euclidean_distances(rows[0], rows[1], rows[2])
        mean = float(np.sum(euclidean)) / (count * (count - 1))
        unit *= mean if mean > 0 else 1.0
    return rows, euclidean, center, unit


@kernel
def _height_range(z: F4) -> tuple[float, float]:
    """Return the 2nd and 98th percentiles of ``z`` (n,), from a histogram of 256 bins."""
    low, high = outer_range(z)
    if not high > low:
        return low, high
    scale = 256 / (high - low)
    bins = np.zeros(256, np.int64)
    for k in range(z.size):
        bins[min(int((z[k] - low) * scale), 255)] += 1
    limit = z.size * 0.02
    first, last = 0, 255
    cumulative = bins[0]
    while cumulative <= limit:
        first += 1
        cumulative += bins[first]
    cumulative = bins[255]
    while cumulative <= limit:
        last -= 1
        cumulative += bins[last]
    return low + first / scale, low + (last + 1) / scale
