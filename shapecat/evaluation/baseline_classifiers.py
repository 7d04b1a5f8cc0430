"""Baseline classifiers, to which shapecat's classifier is compared."""

from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import logsumexp
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import OneHotEncoder, StandardScaler

from shapecat.arrays import F4, F8
from shapecat.learning.calibration import softmax

__all__ = ["Densities", "make_baselines"]

_MULTIPLES = np.exp2(np.arange(-2.0, 2.6, 0.5))
"""Bandwidths to choose from, relative to the typical distance between kernels."""
_VALIDATION_VIEWS = 60
"""Maximum number of views per category on which a bandwidth is fitted."""
_CLIP = 8.0
"""Maximum magnitude of standardised values and densities; larger ones are clipped."""


def make_baselines(blocks: Sequence[slice]) -> dict[str, Callable[[], Any]]:
    """Return, by name, functions that make untrained classifiers of descriptors.

    ``forest`` is a random forest; ``linear`` is logistic regression on the standardised descriptor;
    ``pnn`` multiplies the Parzen densities of the blocks; ``forest leaves (thesis)`` are
    linear one-versus-rest classifiers on the leaves of a forest that is trained on the descriptor
    and its densities.

    ``blocks`` is the range of each block in the descriptor.
    """
    return {
        "forest": lambda: _forest(400),
        "linear": lambda: make_pipeline(
            StandardScaler(), LogisticRegression(C=0.1, class_weight="balanced", max_iter=2000)
        ),
        "pnn": lambda: _DensityProduct(blocks),
        "forest leaves (thesis)": lambda: _ForestLeaves(blocks),
    }


def _forest(trees: int) -> RandomForestClassifier:
    return RandomForestClassifier(
        trees, min_samples_leaf=2, class_weight="balanced", random_state=0
    )


class Densities:
    """Parzen densities of each category in each block of a descriptor, in standardised units.

    Parameters
    ----------
    x : (n, d) descriptors.
    y : (n,) categories.
    blocks : range of each block in the descriptor.
    kernels : maximum number of Gaussians per category; each is centred on a view drawn at random.

    Attributes
    ----------
    widths : bandwidth of each block.
    mean, deviation : (blocks,) of the log densities of training views under their own category.

    Notes
    -----
    The bandwidth of a block is a multiple of the typical distance between nearest kernels. It
    maximises the leave-one-out likelihood of views under their own category.

    Source: Specht 1990, eq. 12; differs: Specht keeps every training view.
    """

    def __init__(self, x: F4, y: np.ndarray, blocks: Sequence[slice], kernels: int) -> None:
        """Fit densities to descriptors ``x`` (n, d) with labels ``y`` (n,), block by block."""
        rng = np.random.default_rng(0)
        self._scaler = StandardScaler().fit(x)
        self._blocks = blocks
        z = self.standardise(x)
        of_category = [rng.permutation(z[y == name]) for name in np.unique(y)]
        self._kernels = [views[:kernels] for views in of_category]
        chosen = [rng.permutation(views)[:_VALIDATION_VIEWS] for views in of_category]
        self.widths = [self._fit_width(chosen, block) for block in blocks]
        own = [self._own_densities(chosen, *pair) for pair in zip(blocks, self.widths, strict=True)]
        self.mean = np.array([values.mean() for values in own])
        self.deviation = np.array([max(values.std(), 1e-3) for values in own])

    def standardise(self, x: F4) -> F8:
        """Return the standardised descriptors (n, d)."""
        return np.asarray(np.clip(self._scaler.transform(np.asarray(x, np.float64)), -_CLIP, _CLIP))

    def log_densities(self, x: F4) -> F8:
        """Return the log densities (n, categories, blocks) of descriptors (n, d).

        They are standardised, so that in each block training views have mean 0 and standard
        deviation 1 under their own category, and then clipped.
        """
        z = self.standardise(x)
        densities = [
            [_log_density(z[:, block], kernels[:, block], width) for kernels in self._kernels]
            for block, width in zip(self._blocks, self.widths, strict=True)
        ]
        values = (np.transpose(densities) - self.mean) / self.deviation
        return np.asarray(np.clip(values, -_CLIP, _CLIP))

    def _own_densities(self, views: Sequence[F8], block: slice, width: float) -> F8:
        """Return the finite log densities (n,) of views in a block, under their own categories.

        ``views`` are (k, d) for each category; ``width`` is the bandwidth of the block. The result
        is a single 0 if no density is finite.
        """
        pairs = zip(views, self._kernels, strict=True)
        values = [_log_density(z[:, block], own[:, block], width) for z, own in pairs]
        found = np.concatenate(values)
        found = found[np.isfinite(found)]
        return found if found.size else np.zeros(1)  # each category has a single view

    def _fit_width(self, views: Sequence[F8], block: slice) -> float:
        """Return the bandwidth of a block that maximises the likelihood of ``views``.

        ``views`` holds the standardised descriptors (n, d) of each category.
        """
        nearest = []
        for kernels in self._kernels:
            distances = cdist(kernels[:, block], kernels[:, block])
            np.fill_diagonal(distances, np.inf)
            nearest.append(distances.min(axis=1))
        dimensions, gaps = block.stop - block.start, np.concatenate(nearest)
        typical = max(float(np.median(gaps)) / np.sqrt(dimensions), 1e-2)
        typical = typical if np.isfinite(typical) else 1.0  # most categories have a single view
        likelihoods = [
            self._own_densities(views, block, width).mean() - dimensions * np.log(width)
            for width in typical * _MULTIPLES
        ]
        return float(typical * _MULTIPLES[int(np.argmax(likelihoods))])


def _log_density(z: F8, kernels: F8, width: float) -> F8:
    """Return the log density (n,), at views ``z`` (n, d), of the mean of Gaussians.

    They have their centres at ``kernels`` (k, d), and the standard deviation ``width``.
    The factor that is the same for every category is left out. A kernel that coincides with a view
    does not count: it probably is that view, and would make the densities of training views too
    high. The result is -inf if no kernel counts.
    """
    squared = cdist(z, kernels, "sqeuclidean")
    other = squared > 1e-4 * z.shape[1]
    exponents = np.where(other, -0.5 * squared / width**2, -np.inf)
    return np.asarray(logsumexp(exponents, axis=1) - np.log(np.maximum(other.sum(axis=1), 1)))


class _DensityProduct:
    """A probabilistic neural network, which classifies by the product of the blocks' densities."""

    def __init__(self, blocks: Sequence[slice]) -> None:
        self._blocks = blocks

    def fit(self, x: F4, y: np.ndarray) -> Self:
        self.classes_ = np.unique(y)
        self._densities = Densities(x, y, self._blocks, 300)
        return self

    def predict_proba(self, x: F4) -> F8:
        """Return the posteriors (n, c) of descriptors (n, d)."""
        return softmax(self._densities.log_densities(x) @ self._densities.deviation)


class _ForestLeaves:
    """Linear classifiers on the words of a view: the leaves it reaches in a forest (thesis 7.3)."""

    def __init__(self, blocks: Sequence[slice]) -> None:
        self._blocks = blocks
        self._forest, self._encoder = _forest(100), OneHotEncoder()

    def fit(self, x: F4, y: np.ndarray) -> Self:
        self.classes_ = np.unique(y)
        self._densities = Densities(x, y, self._blocks, 50)
        features = self._features(x)
        words = self._encoder.fit_transform(self._forest.fit(features, y).apply(features))
        self._learners = [
            LogisticRegression(C=0.03, class_weight="balanced", max_iter=1000).fit(words, y == name)
            for name in self.classes_
        ]
        return self

    def predict_proba(self, x: F4) -> F8:
        """Return the posteriors (n, c) of descriptors (n, d)."""
        words = self._encoder.transform(self._forest.apply(self._features(x)))
        logits = [learner.decision_function(words) for learner in self._learners]
        return softmax(np.stack(logits, axis=1))

    def _features(self, x: F4) -> F8:
        densities = self._densities.log_densities(x).reshape(len(x), -1)
        return np.hstack([self._densities.standardise(x), densities])
