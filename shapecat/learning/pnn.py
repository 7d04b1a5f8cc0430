"""Probabilistic neural networks as features (thesis 7.2; Specht 1990)."""

import itertools
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, ClassifierMixin, TransformerMixin
from sklearn.utils import check_random_state
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from shapecat.arrays import F4, F8, I4
from shapecat.learning.calibration import softmax
from shapecat.learning.features import FeatureBank, log_density_levels

__all__ = ["ProbabilisticNeuralNetwork", "known_labels", "parzen_level", "spread_kernels"]

_MULTIPLES = np.exp2(np.arange(-2.0, 2.6, 0.5))
_JUDGES = 60
"""Number of views per category on which a bandwidth is fitted."""


@dataclass(eq=False, repr=False)
class ProbabilisticNeuralNetwork(
    ClassifierMixin,  # type: ignore[misc]  # sklearn is untyped
    TransformerMixin,  # type: ignore[misc]
    BaseEstimator,  # type: ignore[misc]
):
    """A Parzen density for each category and block of the descriptor.

    As a transformer, it returns the standardised descriptor followed by the class-conditional log
    densities, all blocks of one category after the other. As a classifier, it multiplies the
    densities (a baseline).

    Parameters
    ----------
    blocks : half-open range of components of each block, by name; components outside all blocks
        are not used. None makes all components one block.
    kernels : Gaussians per category, drawn at random from its views; 0 leaves the densities out.
        differs: Specht keeps every training view.
    unknown : label of shapes that belong to no category and get no density; None if there are none.
    random_state : seed of the random choice of kernels.

    Attributes
    ----------
    bank_ : the fitted `FeatureBank`.
    classes_ : the categories, without ``unknown``.

    Notes
    -----
    The bandwidth of a block is a multiple of the typical distance between nearest kernels: the one
    that maximises the likelihood of views under their own category, each view left out.
    """

    blocks: Mapping[str, tuple[int, int]] | None = None
    _: KW_ONLY
    kernels: int = 100
    unknown: Any = None
    random_state: int | None = None

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to descriptors X (n, d) and labels y (n,)."""
        x, y = validate_data(self, X, y, dtype=np.float32)
        self.classes_, labels = known_labels(y, self.unknown)
        rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31))
        blocks = {"all": (0, x.shape[1])} if self.blocks is None else self.blocks
        columns = np.concatenate([np.arange(first, last) for first, last in blocks.values()])
        ends = np.cumsum([last - first for first, last in blocks.values()]).tolist()
        spans = list(zip([0, *ends[:-1]], ends, strict=True)) if self.kernels else []
        self.bank_ = _fit_bank(x, labels, columns, spans, self.kernels, rng)
        return self

    def transform(self, X: ArrayLike) -> F4:
        """Return the features (n, f) of descriptors (n, d): standardised values, log densities."""
        check_is_fitted(self)
        return self.bank_.features(validate_data(self, X, dtype=np.float32, reset=False))

    def predict_proba(self, X: ArrayLike) -> F8:
        """Return posteriors (n, c) from the product of the blocks' densities."""
        features = self.transform(X)
        bank = self.bank_
        densities = features[:, bank.mean.size :].reshape(
            len(features), bank.categories, bank.bandwidth.size
        )
        return softmax(densities.astype(np.float64) @ bank.spread.astype(np.float64))

    def predict(self, X: ArrayLike) -> Any:
        """Return the most probable label (n,) of each view, from descriptors X (n, d)."""
        posteriors = self.predict_proba(X)
        return self.classes_[posteriors.argmax(axis=1)]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float32"]
        return tags


def known_labels(y: ArrayLike, unknown: Any) -> tuple[Any, I4]:
    """Return the sorted categories (c,), and the column (n,) of each label, -1 for ``unknown``.

    Raises
    ------
    ValueError : the labels are not categories, or fewer than two categories are left.
    """
    check_classification_targets(y)
    y = np.asarray(y)
    known = np.ones(y.shape, bool) if unknown is None else y != unknown
    classes = np.unique(y[known])
    if classes.size < 2:
        msg = f"a classifier needs at least 2 classes, got {classes.size} class"
        raise ValueError(msg)
    return classes, np.where(known, np.searchsorted(classes, y), -1)


def spread_kernels(z: F4, count: int, rng: np.random.Generator) -> F4:
    """Return at most ``count`` rows of z (n, d), drawn at random, in half precision."""
    chosen = np.sort(rng.permutation(len(z))[:count])
    return z[chosen].astype(np.float16)


def parzen_level(
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


def _fit_bank(
    x: F4,
    labels: I4,
    columns: I4,
    spans: list[tuple[int, int]],
    count: int,
    rng: np.random.Generator,
) -> FeatureBank:
    x = x[:, columns]
    mean = x.mean(axis=0, dtype=np.float64)
    scale = x.std(axis=0, dtype=np.float64)
    used = scale > 1e-7 * np.maximum(1.0, np.abs(mean))
    inverse = np.where(used, 1.0 / np.where(used, scale, 1.0), 0.0)
    z = np.clip((x - mean.astype(np.float32)) * inverse.astype(np.float32), -8.0, 8.0)
    kernels = [spread_kernels(z[labels == c], count, rng) for c in range(labels.max() + 1)]
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in kernels])])
    rows = np.concatenate(kernels)
    judges = np.concatenate(
        [rng.permutation(np.flatnonzero(labels == c))[:_JUDGES] for c in range(len(kernels))]
    )
    bandwidth = [_fit_bandwidth(z[judges], labels[judges], starts, rows, span) for span in spans]
    levels = [
        parzen_level(z[judges], labels[judges], starts, rows, span, width)
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
