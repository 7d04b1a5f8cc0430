"""Features of a descriptor: its standardised values."""

import numpy as np

from shapecat.arrays import F4, Record, array

__all__ = ["Standardisation", "fit_standardisation"]

_CLIP = 8.0
"""Maximum magnitude of a standardised value; larger ones are clipped."""


class Standardisation(Record):
    """Standardisation of descriptors.

    Attributes
    ----------
    mean, inverse_scale : (d,) mean of each component, and 1 / its standard deviation, or 0 if the
        component is constant.

    Raises
    ------
    ValueError : a number is not finite.
    """

    mean: F4 = array("d", "f4")
    inverse_scale: F4 = array("d", "f4")

    def __post_init__(self) -> None:
        """Check the numbers, so that kernels need no checks."""
        super().__post_init__()
        if not (np.all(np.isfinite(self.mean)) and np.all(np.isfinite(self.inverse_scale))):
            msg = "the standardisation of the descriptor is not finite"
            raise ValueError(msg)

    def standardise(self, descriptors: F4) -> F4:
        """Return descriptors (n, d), standardised and clipped."""
        z = np.asarray(descriptors, np.float32) - self.mean
        z *= self.inverse_scale
        return z.clip(-_CLIP, _CLIP, out=z)


def fit_standardisation(x: F4) -> Standardisation:
    """Fit the standardisation of descriptors ``x`` (n, d)."""
    mean = x.mean(axis=0, dtype=np.float64)
    scale = x.std(axis=0, dtype=np.float64)
    used = scale > 1e-7 * np.maximum(1.0, np.abs(mean))
    inverse = np.where(used, 1.0 / np.where(used, scale, 1.0), 0.0)
    return Standardisation(mean, inverse)
