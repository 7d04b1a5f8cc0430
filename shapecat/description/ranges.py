"""Ranges of values, with or without outliers."""

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel

__all__ = ["inner_range", "outer_range"]

_BINS = 64
_OUTSIDE = 0.02
"""Fraction of the values below, and above, the inner range."""
_LEAST = 1e-30
"""Smallest range that is divided into bins; a smaller one is returned whole."""


@kernel(fast=True)
def inner_range(values: F4) -> tuple[float, float]:
    """Return the 2nd and 98th percentiles of values (n,), interpolated in a histogram."""
    low = high = values[0]
    for k in range(values.size):
        low = values[k] if values[k] < low else low
        high = values[k] if values[k] > high else high
    if not high - low > _LEAST:
        return low, high
    bins = np.zeros(_BINS, np.int32)
    scale = np.float32(_BINS * 0.9999) / (high - low)
    for k in range(values.size):
        bins[int((values[k] - low) * scale)] += 1
    limit = _OUTSIDE * values.size
    first, last = 0, _BINS - 1
    cumulative = bins[0]
    while cumulative < limit:
        first += 1
        cumulative += bins[first]
    below = first + 1 - (cumulative - limit) / bins[first]
    cumulative = bins[last]
    while cumulative < limit:
        last -= 1
        cumulative += bins[last]
    above = last + (cumulative - limit) / bins[last]
    return low + below / scale, low + above / scale


@kernel(fast=True)
def outer_range(values: F4) -> tuple[float, float]:
    """Return the smallest and the largest of values (n,), n >= 1."""
    low = high = values[0]
    for value in values:
        low = value if value < low else low
        high = value if value > high else high
    return low, high
