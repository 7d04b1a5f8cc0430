"""The descriptor: what the shape of an object looks like, as a fixed list of numbers."""

from collections.abc import Iterator

import numpy as np

from shapecat.arrays import F4, F8, I4, U2
from shapecat.description.context import CONTEXT_NAMES, context
from shapecat.description.curvature import assign, fit_surfaces
from shapecat.description.distances import euclidean, geodesic, mean_gap
from shapecat.description.outline import OUTLINE_NAMES, outline
from shapecat.description.profile import PROFILE_NAMES, profile, vertical_axis
from shapecat.description.revolution import REVOLUTION_NAMES, revolution, rotation_axis
from shapecat.description.solids import SOLID_NAMES, solids
from shapecat.jit import kernel
from shapecat.types import NeuralGas

__all__ = ["BLOCKS", "DESCRIPTOR_NAMES", "describe"]

_RINGS, _BANDS = 3, 4
_DISTANCE_BINS = 12
_DISTANCE_RANGE = 2.6
"""Distances between neurons are counted up to this many times their mean."""
_SHAPE_BINS, _CURVED_BINS, _MEAN_BINS = 8, 6, 6
_CURVATURE = _SHAPE_BINS + _CURVED_BINS + _MEAN_BINS
_UP_BINS = 8
_MAX_POINTS = 1200
_RADIUS = 2.2 * 1.15
"""Radius of the neighbourhoods in which curvature is fitted, in spacings of the neurons."""
_REACH = 3 * 1.15
"""Points farther than this from every neuron are not described, in the same spacings."""
_FAR = 1e6


def _bins(name: str, count: int) -> Iterator[str]:
    return (f"{name}_{k}" for k in range(count))


def _parts(kind: str, parts: int, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{kind}{part}_{name}" for part in range(parts) for name in names)


_CURVATURE_NAMES = (
    *_bins("shape", _SHAPE_BINS),
    *_bins("curvedness", _CURVED_BINS),
    *_bins("mean", _MEAN_BINS),
)
_DISTANCE_NAMES = tuple(_bins("bin", _DISTANCE_BINS))
_BLOCK_NAMES: dict[str, tuple[str, ...]] = {
    "context": CONTEXT_NAMES,
    "curvature": _CURVATURE_NAMES,
    "up": tuple(_bins("bin", _UP_BINS)),
    "ring_geodesic": _parts("ring", _RINGS, _DISTANCE_NAMES),
    "ring_euclid": _parts("ring", _RINGS, _DISTANCE_NAMES),
    "ring_curvature": _parts("ring", _RINGS, ("share", *_CURVATURE_NAMES)),
    "band_geodesic": _parts("band", _BANDS, _DISTANCE_NAMES),
    "band_euclid": _parts("band", _BANDS, _DISTANCE_NAMES),
    "band_curvature": _parts("band", _BANDS, ("share", *_CURVATURE_NAMES)),
    "profile": PROFILE_NAMES,
    "revolution": REVOLUTION_NAMES,
    "solids": SOLID_NAMES,
    "outline": OUTLINE_NAMES,
    "metric": ("height", "low", "wide", "across", "along", "spacing"),
    "view": ("elevation", "distance"),
}


def _slices() -> dict[str, slice]:
    ends = np.cumsum([len(names) for names in _BLOCK_NAMES.values()]).tolist()
    return {
        block: slice(end - len(names), end)
        for (block, names), end in zip(_BLOCK_NAMES.items(), ends, strict=True)
    }


BLOCKS: dict[str, slice] = _slices()
"""Where each block of the descriptor is. ``metric`` and ``view`` depend on the scale."""

DESCRIPTOR_NAMES: tuple[str, ...] = tuple(
    f"{block}.{name}" for block, names in _BLOCK_NAMES.items() for name in names
)
"""The name of each number, ``block.name``."""
# kernels read numbers, not dictionaries
_CONTEXT, _CURVED, _UP = (BLOCKS[name].start for name in ("context", "curvature", "up"))
_RING_PATHS, _RING_STRAIGHT, _RING_CURVED = (
    BLOCKS[f"ring_{name}"].start for name in ("geodesic", "euclid", "curvature")
)
_BAND_PATHS, _BAND_STRAIGHT, _BAND_CURVED = (
    BLOCKS[f"band_{name}"].start for name in ("geodesic", "euclid", "curvature")
)
_PROFILE, _REVOLUTION, _SOLIDS, _OUTLINE = (
    BLOCKS[name].start for name in ("profile", "revolution", "solids", "outline")
)
_METRIC, _VIEW = BLOCKS["metric"].start, BLOCKS["view"].start


def describe(points: F4, gas: NeuralGas, eye: F4) -> F4:
    """Describe the shape of one object seen from one side.

    Parameters
    ----------
    points : (m, 3) metres, finite, level frame: z up, the support at z = 0; where x and y are 0
        does not matter. Of more than 1200 every k-th is used.
    gas : the graph of the points, in the same frame, with at least 2 neurons.
    eye : (3,) metres, the place of the sensor in the same frame.

    Returns
    -------
    (d,) finite numbers named by `DESCRIPTOR_NAMES`, in the blocks `BLOCKS`. They do not change
    when everything turns about z or moves along x and y; nor, but for the blocks ``metric`` and
    ``view``, when everything grows about the origin.

    Raises
    ------
    ValueError : an array has the wrong shape or is not finite, or the graph has fewer than 2
        neurons or an edge to none of them.

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
    if not _describe(points, gas.neurons, gas.edges, eye, result):
        msg = "points, neurons and eye must be finite"
        raise ValueError(msg)
    return result


@kernel
def _describe(points: F4, neurons: F4, edges: U2, eye: F4, out: F4) -> bool:
    """Write the descriptor; return whether the input was finite."""
    if not (_finite(neurons) and _finite(points) and _finite(eye.reshape(1, 3))):
        return False
    count = neurons.shape[0]
    x, y, z, straight, middle, unit = _own_units(neurons)
    step = (points.shape[0] + _MAX_POINTS - 1) // _MAX_POINTS
    total = (points.shape[0] + step - 1) // step
    cloud = np.zeros((3, total), np.float32)
    for k in range(total):
        for axis in range(3):
            # so far away only from neurons that do not belong to these points; squares stay finite
            value = (points[k * step, axis] - middle[axis]) / unit
            cloud[axis, k] = min(max(value, -_FAR), _FAR)
    away = 0.0
    for axis in range(3):
        away += (eye[axis] - middle[axis]) ** 2
    away = np.sqrt(away)
    place = np.zeros(3, np.float32)
    for axis in range(3):
        place[axis] = (eye[axis] - middle[axis]) / max(unit, away / _FAR)
    gap = max(mean_gap(straight), 1e-3)
    paths = geodesic(straight, edges)
    cloud, starts = assign(cloud, x, y, z, np.float32(_REACH * gap))
    if cloud.shape[1] == 0:
        # none is near: describe the neurons themselves
        cloud = _in_rows(x, y, z)
        for i in range(count):
            starts[i + 1] = i + 1
    weight = np.zeros(count, np.float32)
    for i in range(count):
        weight[i] = (starts[i + 1] - starts[i]) / cloud.shape[1]
    normals, curvatures = fit_surfaces(
        cloud, starts, x, y, z, straight, np.float32(_RADIUS * gap), place
    )
    low, high = _height_range(cloud[2])
    wide, across, along = context(
        cloud, x, y, z, -middle[2] / unit, weight, normals, curvatures, straight, paths, place,
        low, high, out[_CONTEXT:_CURVED],
    )  # fmt: skip
    _distributions(z, straight, paths, weight, normals, curvatures, out)
    profile(x, y, z, weight, normals, curvatures, low, high, out[_PROFILE:_REVOLUTION])
    owner = _owners(starts)
    cx, cy, _ = vertical_axis(x, y, normals, weight)
    axis, point, _ = rotation_axis(x, y, z, weight, normals)
    turned = out[_REVOLUTION:_SOLIDS]
    foot = np.zeros(3)
    foot[0], foot[1] = cx, cy
    revolution(
        cloud, owner, _in_rows(x, y, z), weight, normals, place, axis, point, foot, turned,
    )  # fmt: skip
    solids(cloud, owner, x, y, normals, place, low, high, turned, out[_SOLIDS:_OUTLINE])
    outline(cloud, place, out[_OUTLINE:_METRIC])
    out[_METRIC] = (high - low) * unit
    out[_METRIC + 1] = low * unit + middle[2]
    out[_METRIC + 2], out[_METRIC + 3], out[_METRIC + 4] = (
        wide * unit,
        across * unit,
        along * unit,
    )
    out[_METRIC + 5] = gap * unit
    out[_VIEW] = (eye[2] - middle[2]) / away if away > 0 else 0.0
    out[_VIEW + 1] = away
    return True


@kernel
def _in_rows(x: F4, y: F4, z: F4) -> F4:
    """Return coordinates as one array (3, n)."""
    rows = np.zeros((3, x.size), np.float32)
    for i in range(x.size):
        rows[0, i], rows[1, i], rows[2, i] = x[i], y[i], z[i]
    return rows


@kernel
def _owners(starts: I4) -> I4:
    """Return the neuron of each point, of points that are sorted by neuron."""
    owner = np.zeros(starts[-1], np.int64)
    for k in range(starts.size - 1):
        for i in range(starts[k], starts[k + 1]):
            owner[i] = k
    return owner


@kernel
def _finite(rows: F4) -> bool:
    for i in range(rows.shape[0]):
        for axis in range(3):
            if not abs(rows[i, axis]) < np.inf:
                return False
    return True


@kernel
def _own_units(neurons: F4) -> tuple[F4, F4, F4, F4, F8, float]:
    """Return coordinates in the unit of the mean distance between neurons, about their mean.

    Then the distances in these units, the mean, and the unit in metres (1 where all is one place).
    """
    count = neurons.shape[0]
    middle = np.zeros(3)
    for i in range(count):
        for axis in range(3):
            middle[axis] += neurons[i, axis] / count
    unit = 0.0
    for i in range(count):
        for axis in range(3):
            unit = max(unit, abs(neurons[i, axis] - middle[axis]))
    unit = unit if unit > 0 else 1.0
    x = np.zeros(count, np.float32)
    y = np.zeros(count, np.float32)
    z = np.zeros(count, np.float32)
    straight = np.zeros((count, count), np.float32)
    for _ in range(2):  # first by the greatest coordinate, so that squares stay finite
        for i in range(count):
            x[i] = (neurons[i, 0] - middle[0]) / unit
            y[i] = (neurons[i, 1] - middle[1]) / unit
            z[i] = (neurons[i, 2] - middle[2]) / unit
        straight = euclidean(x, y, z)
        mean = _sum(straight) / (count * (count - 1))
        unit *= mean if mean > 0 else 1.0
    return x, y, z, straight, middle, unit


@kernel
def _sum(rows: F4) -> float:
    total = np.float32(0.0)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            total += rows[i, j]
    return float(total)


@kernel(fast=True)
def _range(values: F4) -> tuple[float, float]:
    low = high = values[0]
    for value in values:
        low = value if value < low else low
        high = value if value > high else high
    return low, high


@kernel
def _height_range(z: F4) -> tuple[float, float]:
    """Return the 2 % and 98 % quantile of ``z``, by a histogram of 256 bins."""
    low, high = _range(z)
    if not high > low:
        return low, high
    scale = 256 / (high - low)
    bins = np.zeros(256, np.int64)
    for k in range(z.size):
        bins[min(int((z[k] - low) * scale), 255)] += 1
    limit = z.size * 0.02
    first, last = 0, 255
    seen = bins[0]
    while seen <= limit:
        first += 1
        seen += bins[first]
    seen = bins[255]
    while seen <= limit:
        last -= 1
        seen += bins[last]
    return low + first / scale, low + (last + 1) / scale


@kernel
def _count(row: F4, start: int, bins: int, place: float, weight: float) -> None:
    """Add ``weight`` at ``place`` (0 to 1) of a histogram, shared between the two nearest bins."""
    at = min(max(place * bins - 0.5, 0.0), bins - 1.0)
    k = min(int(at), bins - 2)
    row[start + k] += weight * (k + 1 - at)
    row[start + k + 1] += weight * (at - k)


@kernel
def _find_bins(lengths: F4, i: int, scale: float, one: float, bins: I4, shares: F4) -> None:
    """Write for row i of ``lengths`` the first of the two bins a length is shared between.

    And the share of the second, of a count of ``one``.
    """
    last = np.float32(_DISTANCE_BINS - 1)
    for j in range(lengths.shape[1]):
        place = lengths[i, j] * scale - np.float32(0.5)
        place = place if place > 0 else np.float32(0)
        place = place if place < last else last
        k = min(np.int32(place), np.int32(_DISTANCE_BINS - 2))
        bins[j] = k
        shares[j] = (place - np.float32(k)) * one


@kernel
def _distributions(
    z: F4, straight: F4, paths: F4, weight: F4, normals: F4, curvatures: F4, out: F4
) -> None:
    """Write the histograms over the whole object, its rings and its bands."""
    count = z.size
    width = 1 + _CURVATURE + 2 * _DISTANCE_BINS
    rows = np.zeros((count, width), np.float32)
    sums = np.zeros(count, np.float32)
    for j in range(count):
        for i in range(count):  # column by column: the sums of all rows grow side by side
            sums[i] += paths[j, i]
    total = 0.0
    for i in range(count):
        total += sums[i]
    pairs = count * (count - 1)
    scale = np.float32(_DISTANCE_BINS / _DISTANCE_RANGE)
    per_path = scale * np.float32(pairs / max(total, 1e-9))
    per_straight = scale  # the mean is the unit
    one = np.float32(1.0 / (count - 1))
    bins, shares = np.zeros((2, count), np.int32), np.zeros((2, count), np.float32)
    for i in range(count):
        row = rows[i]
        _find_bins(paths, i, per_path, one, bins[0], shares[0])
        _find_bins(straight, i, per_straight, one, bins[1], shares[1])
        for j in range(count):
            if i == j:
                continue
            k, share = 1 + _CURVATURE + bins[0, j], shares[0, j]
            row[k] += one - share
            row[k + 1] += share
            k, share = 1 + _CURVATURE + _DISTANCE_BINS + bins[1, j], shares[1, j]
            row[k] += one - share
            row[k + 1] += share
        first, second = curvatures[0, i], curvatures[1, i]
        _curvature_row(row, first, second)
    curvature = out[_CURVED:_UP]
    up = out[_UP:_RING_PATHS]
    for i in range(count):
        for k in range(_CURVATURE):
            curvature[k] += weight[i] * rows[i, 1 + k]
        place = (np.float64(normals[2, i]) + 1) / 2
        _count(up, np.int64(0), np.int64(_UP_BINS), place, np.float64(weight[i]))
    # numba compiles anew for every number that stands in a call, but not for these
    rings, bands = np.int64(_RINGS), np.int64(_BANDS)
    at, straight_at, curved_at = (
        np.int64(_RING_PATHS), np.int64(_RING_STRAIGHT), np.int64(_RING_CURVED),
    )  # fmt: skip
    _partition(rows, sums, weight, rings, out, at, straight_at, curved_at)
    at, straight_at, curved_at = (
        np.int64(_BAND_PATHS), np.int64(_BAND_STRAIGHT), np.int64(_BAND_CURVED),
    )  # fmt: skip
    _partition(rows, z, weight, bands, out, at, straight_at, curved_at)


@kernel
def _curvature_row(row: F4, first: float, second: float) -> None:
    row[0] = 1
    spread = first - second
    index = 2 / np.pi * np.arctan2(first + second, spread)
    _count(row, np.int64(1), np.int64(_SHAPE_BINS), (index + 1) / 2, 1.0)
    curved = np.sqrt((first * first + second * second) / 2)
    place = (np.log2(curved + 1e-6) + 3) / 7
    _count(row, np.int64(1 + _SHAPE_BINS), np.int64(_CURVED_BINS), place, 1.0)
    mean = (first + second) / 2
    place = (mean / (1 + abs(mean)) + 1) / 2
    _count(row, np.int64(1 + _SHAPE_BINS + _CURVED_BINS), np.int64(_MEAN_BINS), place, 1.0)


@kernel
def _partition(
    rows: F4,
    order: F4,
    weight: F4,
    parts: int,
    out: F4,
    at_paths: int,
    at_straight: int,
    at_curvature: int,
) -> None:
    """Average ``rows`` over the parts in which ``order`` is cut at equal distances.

    A neuron counts in the two parts whose middles it lies between, so that a small change of the
    graph changes the descriptor little.
    """
    low, high = _range(order)
    sums = np.zeros((parts, rows.shape[1]))
    for i in range(rows.shape[0]):
        place = np.float64(order[i] - low) / (high - low) if high > low else 0.5
        at = min(max(place * parts - 0.5, 0.0), parts - 1.0)
        first = min(int(at), parts - 2)
        for side in range(2):
            share = weight[i] * (at - first if side == 1 else first + 1 - at)
            for k in range(rows.shape[1]):
                sums[first + side, k] += share * rows[i, k]
    for part in range(parts):
        share = sums[part, 0]
        norm = 1.0 / (share + 1e-3)
        base = at_curvature + part * (1 + _CURVATURE)
        out[base] = share
        for k in range(_CURVATURE):
            out[base + 1 + k] = sums[part, 1 + k] * norm
        for k in range(_DISTANCE_BINS):
            out[at_paths + part * _DISTANCE_BINS + k] = sums[part, 1 + _CURVATURE + k] * norm
            out[at_straight + part * _DISTANCE_BINS + k] = (
                sums[part, 1 + _CURVATURE + _DISTANCE_BINS + k] * norm
            )
