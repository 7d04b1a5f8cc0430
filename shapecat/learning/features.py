"""Features of a descriptor: its standardised values and their Parzen densities."""

import numpy as np

from shapecat.arrays import F4, F8, I4, U2, Record, array
from shapecat.jit import kernel

__all__ = ["FeatureBank"]

_CLIP = 8.0
"""Standardised values are clipped to this many standard deviations."""


class FeatureBank(Record):
    """Standardisation and Parzen densities of descriptors, as in a probabilistic neural network.

    The density of a category in a block is a sum of Gaussians with the block's bandwidth around the
    kernels of the category (Specht 1990, eq. 12).

    Attributes
    ----------
    columns : (d,) indices of the used components of the descriptor, block after block.
    mean, inverse_scale : (d,) standardisation; a constant component has inverse scale 0.
    spans : (b, 2) half-open range in ``columns`` of each block with densities.
    bandwidth : (b,) standard deviation of the Gaussians of a block, in standardised units.
    level, spread : (b,) mean and standard deviation of a view's log density under its own category.
    starts : (s,) ``kernels[starts[c] : starts[c + 1]]`` belong to category c.
    kernels : (k, d) standardised descriptors in half precision.

    Raises
    ------
    ValueError : spans, starts or scales do not fit together.
    """

    columns: U2 = array("d", "u2")
    mean: F4 = array("d", "f4")
    inverse_scale: F4 = array("d", "f4")
    spans: U2 = array("b 2", "u2")
    bandwidth: F4 = array("b", "f4")
    level: F4 = array("b", "f4")
    spread: F4 = array("b", "f4")
    starts: I4 = array("s", "i4")
    kernels: F4 = array("k d", "f2")

    def __post_init__(self) -> None:
        """Check every index and number, so that kernels need no checks."""
        super().__post_init__()
        starts, spans = self.starts, self.spans.astype(np.int64)
        good = (
            starts.size >= 1
            and starts[0] == 0
            and starts[-1] == len(self.kernels)
            and bool(np.all(np.diff(starts) >= 0))
            and bool(np.all(spans[:, 0] <= spans[:, 1]))
            and bool(np.all(spans <= self.mean.size))
            and all(
                bool(np.all(np.isfinite(values)))
                for values in (self.mean, self.inverse_scale, self.level, self.kernels)
            )
            and all(
                bool(np.all(np.isfinite(values) & (values > 0)))
                for values in (self.bandwidth, self.spread)
            )
        )
        if not good:
            msg = "the Parzen kernels, their blocks and their scales do not fit together"
            raise ValueError(msg)

    @property
    def categories(self) -> int:
        """Number of categories."""
        return int(self.starts.size) - 1

    @property
    def width(self) -> int:
        """Number of features: d standardised values, then a density per category and block."""
        return int(self.mean.size) + self.categories * int(self.bandwidth.size)

    def standardise(self, descriptors: F4) -> F4:
        """Return the used components of whole descriptors, standardised and clipped, (n, d)."""
        used = np.asarray(descriptors, np.float32)[:, self.columns]
        z = (used - self.mean) * self.inverse_scale
        return np.asarray(np.clip(z, -_CLIP, _CLIP), np.float32)

    def features(self, descriptors: F4) -> F4:
        """Return the features (n, width) of whole descriptors."""
        x = np.require(descriptors, np.float32, ["C", "W"])  # one compiled version
        result = np.zeros((len(x), self.width), np.float32)
        write_features(x, *self.parameters, result)
        return result

    @property
    def parameters(self) -> tuple[np.ndarray, ...]:
        """The arrays for `write_features`, with the types of the kernel."""
        return (
            self.columns.astype(np.int64),
            self.mean,
            self.inverse_scale,
            self.spans.astype(np.int64),
            self.bandwidth,
            self.level,
            self.spread,
            self.starts.astype(np.int64),
            self.kernels.astype(np.float32),
        )


@kernel
def write_features(
    x: F4,
    columns: I4,
    mean: F4,
    inverse_scale: F4,
    spans: I4,
    bandwidth: F4,
    level: F4,
    spread: F4,
    starts: I4,
    kernels: F4,
    result: F4,
) -> None:
    """Write the features of whole descriptors ``x`` (n, components) into ``result`` (n, width).

    The other arrays are the fields of a `FeatureBank`, in the types of `FeatureBank.parameters`.
    """
    width, blocks = columns.size, bandwidth.size
    clip = np.float32(_CLIP)
    exponents = np.zeros(kernels.shape[0], np.float32)
    for i in range(x.shape[0]):
        z = result[i, :width]
        for j in range(width):
            value = (x[i, columns[j]] - mean[j]) * inverse_scale[j]
            z[j] = -clip if value < -clip else (clip if value > clip else value)
        for b in range(blocks):
            first, last = spans[b, 0], spans[b, 1]
            _squared_distances(z[first:last], kernels[:, first:last], exponents)
            own_distance = np.float32(1e-4 * (last - first))
            for c in range(starts.size - 1):
                value = _log_density(
                    exponents[starts[c] : starts[c + 1]], own_distance, bandwidth[b]
                )
                value = (value - level[b]) / spread[b]
                value = -clip if value < -clip else (clip if value > clip else value)
                result[i, width + c * blocks + b] = value


@kernel(fast=True)
def _squared_distances(z: F4, kernels: F4, result: F4) -> None:
    for k in range(kernels.shape[0]):
        total = np.float32(0.0)
        for j in range(z.size):
            difference = z[j] - kernels[k, j]
            total += difference * difference
        result[k] = total


@kernel
def _log_density(squared: F4, own_distance: float, bandwidth: float) -> float:
    """Return the log of the mean Gaussian over kernels at squared distances (k,).

    The factor that is the same for every category is left out; -1e9 if no kernel counts.

    differs: a kernel within the squared distance ``own_distance`` is taken for the view itself, met
    in training, and does not count; otherwise the densities of training views would be too high.
    """
    scale = -0.5 / (bandwidth * bandwidth)
    nearest = np.inf
    count = 0
    for value in squared:
        if value > own_distance:
            count += 1
            nearest = value if value < nearest else nearest
    if count == 0:
        return -1e9
    total = 0.0
    for value in squared:
        if value > own_distance:
            exponent = scale * (value - nearest)
            if exponent > -20.0:
                total += np.exp(exponent)
    return float(scale * nearest + np.log(total / count))


def log_density_levels(
    z: F4, labels: I4, bank_starts: I4, kernels: F4, span: tuple[int, int], bandwidth: float
) -> F8:
    """Return the log density (n,) of each view in one block under its own category.

    Parameters
    ----------
    z : (n, d) standardised descriptors.
    labels : (n,) category of each view.
    bank_starts, kernels : as ``starts`` and ``kernels`` of a `FeatureBank`.
    span : half-open range of the block's columns.
    bandwidth : standard deviation of the Gaussians, in standardised units.
    """
    first, last = span
    own_distance = np.float32(1e-4 * (last - first))
    distances = np.zeros(len(kernels), np.float32)
    result = np.zeros(len(z))
    block = np.ascontiguousarray(kernels[:, first:last], np.float32)
    for i, (row, label) in enumerate(zip(z, labels, strict=True)):
        _squared_distances(np.ascontiguousarray(row[first:last]), block, distances)
        own_block = distances[bank_starts[label] : bank_starts[label + 1]]
        result[i] = _log_density(own_block, own_distance, bandwidth)
    return result
