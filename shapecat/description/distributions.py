"""Histograms of distances and curvatures on an object, its rings and its bands (thesis ch. 6)."""

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.description.blocks import (
    BANDS,
    BLOCKS,
    CURVED_BINS,
    DISTANCE_BINS,
    MEAN_BINS,
    RINGS,
    SHAPE_BINS,
    UP_BINS,
)
from shapecat.description.ranges import outer_range
from shapecat.description.surface import Surface
from shapecat.jit import kernel

__all__ = ["distributions"]

_DISTANCE_RANGE = 2.6
"""End of the distance histograms, in mean distances between neurons."""
_CURVATURE = SHAPE_BINS + CURVED_BINS + MEAN_BINS  # bins
# kernels read numbers, not dictionaries
_CURVED, _UP = BLOCKS["curvature"].start, BLOCKS["up"].start
_RING_GEODESIC, _RING_EUCLIDEAN, _RING_CURVED = (
    BLOCKS[f"ring_{name}"].start for name in ("geodesic", "euclid", "curvature")
)
_BAND_GEODESIC, _BAND_EUCLIDEAN, _BAND_CURVED = (
    BLOCKS[f"band_{name}"].start for name in ("geodesic", "euclid", "curvature")
)


@kernel(inner=True)
def _count(row: F4, start: int, bins: int, place: float, weight: float) -> None:
    """Add ``weight`` to a histogram at ``place`` (0 to 1), split between the two nearest bins.

    The histogram is ``bins`` elements of ``row``, beginning at ``start``.
    """
    at = min(max(place * bins - 0.5, 0.0), bins - 1.0)
    k = min(int(at), bins - 2)
    row[start + k] += weight * (k + 1 - at)
    row[start + k + 1] += weight * (at - k)


@kernel(inner=True)
def _find_bins(
    lengths: F4, i: int, scale: float, distance_weight: float, bins: I4, shares: F4
) -> None:
    """Split each length in row i between the two nearest bins of a histogram.

    Writes the first bin of each to ``bins`` (n,), and the weight of the second to ``shares`` (n,);
    both weights add up to ``distance_weight``. ``lengths`` is (n, n), ``scale`` is bins per unit of
    length.
    """
    last = np.float32(DISTANCE_BINS - 1)
    for j in range(lengths.shape[1]):
        place = lengths[i, j] * scale - np.float32(0.5)
        place = place if place > 0 else np.float32(0)
        place = place if place < last else last
        k = min(np.int32(place), np.int32(DISTANCE_BINS - 2))
        bins[j] = k
        shares[j] = (place - np.float32(k)) * distance_weight


@kernel
def distributions(surface: Surface, normals: F4, curvatures: F4, out: F4) -> None:
    """Write histograms of curvature, normals and distances: whole object, rings and bands.

    Rings are intervals of the mean geodesic distance to the other neurons; bands are intervals of
    height. ``normals`` (3, k) and ``curvatures`` (2, k) of the k neurons are from `fit_surfaces`;
    ``out`` is the whole descriptor; its blocks ``curvature`` to ``band_curvature`` are written, and
    must be zeros before.
    """
    euclidean, geodesic, weight = surface.euclidean, surface.geodesic, surface.weight
    z = surface.neurons[2]
    count = z.size
    width = 1 + _CURVATURE + 2 * DISTANCE_BINS
    rows = np.zeros((count, width), np.float32)
    sums = np.zeros(count, np.float32)
    for j in range(count):
        for i in range(count):  # column by column: the sums of all rows grow side by side
            sums[i] += geodesic[j, i]
    total = 0.0
    for i in range(count):
        total += sums[i]
    pairs = count * (count - 1)
    scale = np.float32(DISTANCE_BINS / _DISTANCE_RANGE)
    per_geodesic = scale * np.float32(pairs / max(total, 1e-9))
    per_euclidean = scale  # the mean is the unit
    distance_weight = np.float32(1.0 / (count - 1))
    bins, shares = np.zeros((2, count), np.int32), np.zeros((2, count), np.float32)
    for i in range(count):
        row = rows[i]
        _find_bins(geodesic, i, per_geodesic, distance_weight, bins[0], shares[0])
        _find_bins(euclidean, i, per_euclidean, distance_weight, bins[1], shares[1])
        for j in range(count):
            if i == j:
                continue
            k, share = 1 + _CURVATURE + bins[0, j], shares[0, j]
            row[k] += distance_weight - share
            row[k + 1] += share
            k, share = 1 + _CURVATURE + DISTANCE_BINS + bins[1, j], shares[1, j]
            row[k] += distance_weight - share
            row[k + 1] += share
        first, second = curvatures[0, i], curvatures[1, i]
        _curvature_row(row, first, second)
    curvature = out[_CURVED:_UP]
    up = out[_UP:_RING_GEODESIC]
    for i in range(count):
        for k in range(_CURVATURE):
            curvature[k] += weight[i] * rows[i, 1 + k]
        place = (np.float64(normals[2, i]) + 1) / 2
        _count(up, 0, UP_BINS, place, np.float64(weight[i]))
    _partition(rows, sums, weight, RINGS, out, _RING_GEODESIC, _RING_EUCLIDEAN, _RING_CURVED)
    _partition(rows, z, weight, BANDS, out, _BAND_GEODESIC, _BAND_EUCLIDEAN, _BAND_CURVED)


@kernel(inline=True)
def _curvature_row(row: F4, first: float, second: float) -> None:
    """Write the histograms of one neuron with the principal curvatures ``first`` and ``second``.

    The first elements of ``row``, zeros, become a 1 and the histograms of shape index, curvedness
    and mean curvature.
    """
    row[0] = 1
    spread = first - second
    index = 2 / np.pi * np.arctan2(first + second, spread)
    _count(row, 1, SHAPE_BINS, (index + 1) / 2, 1.0)
    curved = np.sqrt((first * first + second * second) / 2)
    place = (np.log2(curved + 1e-6) + 3) / 7
    _count(row, 1 + SHAPE_BINS, CURVED_BINS, place, 1.0)
    mean = (first + second) / 2
    place = (mean / (1 + abs(mean)) + 1) / 2
    _count(row, 1 + SHAPE_BINS + CURVED_BINS, MEAN_BINS, place, 1.0)


@kernel(inner=True)
def _partition(
    rows: F4,
    order: F4,
    weight: F4,
    parts: int,
    out: F4,
    at_geodesic: int,
    at_euclidean: int,
    at_curvature: int,
) -> None:
    """Write the fraction of the points and the mean histograms of each of ``parts`` intervals.

    ``rows`` (n, k) are a 1 and the histograms of each neuron. Equal intervals divide the range of
    ``order`` (n,); ``weight`` (n,) is each neuron's fraction of the points. The blocks of geodesic
    distances, Euclidean distances and curvature begin at ``at_geodesic``, ``at_euclidean`` and
    ``at_curvature`` in the descriptor ``out``. A neuron counts in the two intervals whose middles
    are nearest, so that a small change of the graph changes the descriptor little.
    """
    low, high = outer_range(order)
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
        for k in range(DISTANCE_BINS):
            out[at_geodesic + part * DISTANCE_BINS + k] = sums[part, 1 + _CURVATURE + k] * norm
            out[at_euclidean + part * DISTANCE_BINS + k] = (
                sums[part, 1 + _CURVATURE + DISTANCE_BINS + k] * norm
            )
