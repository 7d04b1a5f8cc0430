"""Features of a descriptor: its standardised values."""

from functools import partial

import numpy as np

from shapecat.arrays import F4, I4, U2, Record, array

__all__ = ["Standardisation", "fit_standardisation"]

_CLIP = 8.0
"""Standardised values are clipped to this many standard deviations."""
_NONE = partial(np.zeros, 0)


class Standardisation(Record):
    """Standardisation of descriptors.

    Attributes
    ----------
    columns : (d,) indices of the used components of the descriptor.
    mean, inverse_scale : (d,) standardisation; a constant component has inverse scale 0.
    starts, kernels, spans, bandwidth, level, spread : parts of model files for Parzen densities,
        which no model has (docs/decisions/0008-boosted-dictionary.md): zeros, one more than
        categories, and empty arrays.

    Raises
    ------
    ValueError : a number is not finite, or there are densities.
    """

    columns: U2 = array("d", "u2")
    mean: F4 = array("d", "f4")
    inverse_scale: F4 = array("d", "f4")
    starts: I4 = array("s", "i4")
    kernels: F4 = array("k d", "f2")
    spans: U2 = array("b 2", "u2", default_factory=partial(np.zeros, (0, 2)))
    bandwidth: F4 = array("b", "f4", default_factory=_NONE)
    level: F4 = array("b", "f4", default_factory=_NONE)
    spread: F4 = array("b", "f4", default_factory=_NONE)

    def __post_init__(self) -> None:
        """Check the numbers, so that kernels need no checks."""
        super().__post_init__()
        if self.bandwidth.size or self.kernels.size or np.any(self.starts):
            msg = "it has Parzen densities, which this version does not support"
            raise ValueError(msg)
        if not (np.all(np.isfinite(self.mean)) and np.all(np.isfinite(self.inverse_scale))):
            msg = "the standardisation of the descriptor is not finite"
            raise ValueError(msg)

    def standardise(self, descriptors: F4) -> F4:
        """Return the used components of whole descriptors, standardised and clipped, (n, d)."""
        z = np.asarray(descriptors, np.float32).take(self.columns, axis=1)
        z -= self.mean
        z *= self.inverse_scale
        return z.clip(-_CLIP, _CLIP, out=z)


def fit_standardisation(x: F4, categories: int) -> Standardisation:
    """Fit the standardisation of descriptors ``x`` (n, d) for a number of categories."""
    columns = np.arange(x.shape[1])
    mean = x.mean(axis=0, dtype=np.float64)
    scale = x.std(axis=0, dtype=np.float64)
    used = scale > 1e-7 * np.maximum(1.0, np.abs(mean))
    inverse = np.where(used, 1.0 / np.where(used, scale, 1.0), 0.0)
    return Standardisation(
        columns, mean, inverse, np.zeros(categories + 1, np.int32), np.zeros((0, columns.size))
    )
