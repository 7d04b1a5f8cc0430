"""Random errors with spatial correlation."""

from functools import lru_cache

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F4, F8, U1
from shapecat.jit import kernel

__all__ = ["fixed_error", "noise"]


def noise(
    shape: tuple[int, int],
    window: tuple[int, int],
    deviation: float,
    rng: Generator,
    *,
    smoothings: int = 1,
) -> F4:
    """Draw nearly normal noise (h, w) of mean 0, correlated over a window (across, down) in pixels.

    The noise is a sum of random bytes, which are many times faster to draw than normal numbers;
    with a window of one pixel, it is uniform.

    Parameters
    ----------
    shape : (h, w).
    deviation : standard deviation of the noise.
    smoothings : number of times that the noise is averaged over the window.
    """
    wide, tall = window
    height, width = (n + smoothings * (k - 1) for n, k in zip(shape, (tall, wide), strict=True))
    result = rng.integers(0, 256, (height, width), np.uint8)
    for k in range(smoothings - 1, -1, -1):
        size = shape[0] + k * (tall - 1), shape[1] + k * (wide - 1)
        raw, result = result, np.zeros(size, np.float32)
        _box_sum(raw, wide, tall, result)
    byte = np.sqrt((256**2 - 1) / 12)
    gain = _gain(wide, smoothings) * _gain(tall, smoothings)
    result -= np.float32(127.5 * (wide * tall) ** smoothings)
    result *= np.float32(deviation / (byte * gain))
    return result


def _gain(width: int, times: int) -> float:
    """Return the factor by which moving sums raise the standard deviation of white noise.

    Each of the ``times`` successive sums is over ``width`` samples.
    """
    weights = np.ones(1)
    for _ in range(times):
        weights = np.convolve(weights, np.ones(width))
    return float(np.linalg.norm(weights))


@lru_cache(maxsize=8)
def fixed_error(shape: tuple[int, int], deviation: float, spacing: int, device: int) -> F4:
    """Return the smooth, fixed error (h, w) of a device's inverse depth, 1/m.

    Parameters
    ----------
    deviation : standard deviation, 1/m.
    spacing : distance over which the error varies, pixels.
    device : seed, which determines the error.
    """
    knots = (shape[0] // spacing + 2, shape[1] // spacing + 2)
    heights = np.random.default_rng(device).normal(0, 1.5 * deviation, knots)
    result = np.zeros(shape, np.float32)
    _interpolate(heights, spacing, result)
    return result


@kernel
def _box_sum(raw: U1 | F4, wide: int, tall: int, out: F4) -> None:
    """Write sums over windows, ``wide`` columns by ``tall`` rows, of ``raw`` to ``out`` (h, w).

    ``raw`` is larger than ``out`` by the window, less one row and column.
    """
    height, width = out.shape
    column = np.zeros(raw.shape[1], np.float32)
    for v in range(height):
        for u in range(column.size):
            column[u] = raw[v, u]
        for k in range(1, tall):
            for u in range(column.size):
                column[u] += raw[v + k, u]
        for u in range(width):
            out[v, u] = column[u]
        for k in range(1, wide):
            for u in range(width):
                out[v, u] += column[u + k]


@kernel
def _interpolate(knots: F8, spacing: int, out: F4) -> None:
    """Interpolate ``knots`` (k, m), ``spacing`` pixels apart, bilinearly into ``out`` (h, w)."""
    height, width = out.shape
    for v in range(height):
        i = v // spacing
        t = (v - i * spacing) / spacing
        for u in range(width):
            j = u // spacing
            s = (u - j * spacing) / spacing
            low = knots[i, j] + s * (knots[i, j + 1] - knots[i, j])
            high = knots[i + 1, j] + s * (knots[i + 1, j + 1] - knots[i + 1, j])
            out[v, u] = low + t * (high - low)
