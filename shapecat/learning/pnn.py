"""Probabilistic neural networks as features (thesis 7.2; Specht 1990)."""

import itertools
from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.learning.features import FeatureBank, log_density_levels

__all__ = ["fit_bank"]

_MULTIPLES = np.exp2(np.arange(-2.0, 2.6, 0.5))
_JUDGES = 60
"""Number of views per category on which a bandwidth is fitted."""


def fit_bank(
    x: F4, labels: I4, blocks: Sequence[slice], *, kernels: int, rng: np.random.Generator
) -> FeatureBank:
    """Fit the standardisation of descriptors, and a Parzen density per category and block.

    Parameters
    ----------
    x : (n, d) descriptors.
    labels : (n,) category of each view, from 0; -1 for shapes of no category, which get no density.
    blocks : range of each block in the descriptor; components outside all blocks are not used.
    kernels : Gaussians per category, drawn at random from its views; 0 leaves the densities out.
        differs: Specht keeps every training view.

    Notes
    -----
    The bandwidth of a block is a multiple of the typical distance between nearest kernels: the one
    that maximises the likelihood of views under their own category, each view left out.
    """
    columns = np.concatenate([np.arange(block.start, block.stop) for block in blocks])
    ends = np.cumsum([block.stop - block.start for block in blocks]).tolist()
    spans = list(zip([0, *ends[:-1]], ends, strict=True)) if kernels else []
    x = x[:, columns]
    mean = x.mean(axis=0, dtype=np.float64)
    scale = x.std(axis=0, dtype=np.float64)
    used = scale > 1e-7 * np.maximum(1.0, np.abs(mean))
    inverse = np.where(used, 1.0 / np.where(used, scale, 1.0), 0.0)
    z = np.clip((x - mean.astype(np.float32)) * inverse.astype(np.float32), -8.0, 8.0)
    chosen = [_draw_kernels(z[labels == c], kernels, rng) for c in range(labels.max() + 1)]
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in chosen])])
    rows = np.concatenate(chosen)
    judges = np.concatenate(
        [rng.permutation(np.flatnonzero(labels == c))[:_JUDGES] for c in range(len(chosen))]
    )
    bandwidth = [_fit_bandwidth(z[judges], labels[judges], starts, rows, span) for span in spans]
    levels = [
        _parzen_level(z[judges], labels[judges], starts, rows, span, width)
        for span, width in zip(spans, bandwidth, strict=True)
    ]
    return FeatureBank(
        columns=columns,
        mean=mean,
        inverse_scale=inverse,
        spans=np.reshape(spans, (-1, 2)),
        bandwidth=np.array(bandwidth),
        level=np.array([level for level, _ in levels]),
        spread=np.array([spread for _, spread in levels]),
        starts=starts,
        kernels=rows,
    )


def _draw_kernels(z: F4, count: int, rng: np.random.Generator) -> F4:
    """Return at most ``count`` rows of z (n, d), drawn at random, in half precision."""
    chosen = np.sort(rng.permutation(len(z))[:count])
    return z[chosen].astype(np.float16)


def _parzen_level(
    z: F4, labels: I4, starts: I4, kernels: F4, span: tuple[int, int], bandwidth: float
) -> tuple[float, float]:
    """Return the mean and standard deviation of views' log densities under their own category.

    The arguments are as for `log_density_levels`. Without any density, the result is 0 and 1.
    """
    levels = log_density_levels(z, labels, starts, kernels, span, bandwidth)
    levels = levels[levels > -1e8]
    if levels.size == 0:
        return 0.0, 1.0
    return float(levels.mean()), max(float(levels.std()), 1e-3)


def _fit_bandwidth(z: F4, labels: I4, starts: I4, kernels: F4, span: tuple[int, int]) -> float:
    """Return the bandwidth with the greatest leave-one-out likelihood of views (n, d)."""
    first, last = span
    block = kernels[:, first:last].astype(np.float32)
    dimensions = max(int(np.count_nonzero(np.ptp(block, axis=0) > 0)), 1)
    typical = _typical_distance(block, starts)

    def likelihood(width: float) -> float:
        levels = log_density_levels(z, labels, starts, kernels, span, width)
        levels = levels[levels > -1e8]
        return float(levels.mean() - dimensions * np.log(width)) if levels.size else -np.inf

    widths = typical * _MULTIPLES
    return float(widths[int(np.argmax([likelihood(width) for width in widths]))])


def _typical_distance(block: F4, starts: I4) -> float:
    """Return the median distance between nearest kernels of a category.

    The distance is divided by the root of the number of dimensions.
    """
    nearest = []
    for first, last in itertools.pairwise(starts):
        rows = block[first:last].astype(np.float64)
        square = (rows**2).sum(axis=1)
        distances = square[:, None] + square - 2 * rows @ rows.T
        np.fill_diagonal(distances, np.inf)
        nearest.append(distances.min(axis=1, initial=np.inf))
    values = np.concatenate(nearest)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return 1.0
    return max(float(np.sqrt(np.median(np.maximum(values, 0.0)) / max(block.shape[1], 1))), 1e-2)
