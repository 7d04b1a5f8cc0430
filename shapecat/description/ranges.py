"""Ranges that a few stray values do not widen."""

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel

__all__ = ["inner_range"]

_BINS = 64
_OUTSIDE = 0.02
_LEAST = 1e-30


@kernel
def inner_range(values: F4) -> tuple[float, float]:
    """Return the 2 % and the 98 % quantile of values (n,), interpolated in a histogram."""
    low, high = values[0], values[0]
    for value in values:
        low, high = min(low, value), max(high, value)
    if not high - low > _LEAST:
        return low, high
    bins = np.zeros(_BINS)
    scale = np.float32(_BINS * 0.9999) / (high - low)
    for value in values:
        bins[int((value - low) * scale)] += 1
    limit = _OUTSIDE * values.size
    first, last = 0, _BINS - 1
    seen = bins[0]
    while seen < limit:
        first += 1
        seen += bins[first]
    below = first + 1 - (seen - limit) / bins[first]
    seen = bins[last]
    while seen < limit:
        last -= 1
        seen += bins[last]
    above = last + (seen - limit) / bins[last]
    return low + below / scale, low + above / scale
