"""Baseline classifiers."""

from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import OneHotEncoder, StandardScaler
from sklearn.utils import check_random_state

from shapecat.arrays import F4, F8
from shapecat.learning.calibration import softmax
from shapecat.learning.features import FeatureBank
from shapecat.learning.pnn import fit_bank

__all__ = ["make_baselines"]


def make_baselines(blocks: Sequence[slice]) -> dict[str, Callable[[], Any]]:
    """Return functions that make unfitted baselines, by name; all classify whole descriptors.

    ``forest`` is a random forest; ``linear`` is logistic regression on the standardised descriptor;
    ``pnn`` multiplies the Parzen densities of the blocks; ``forest words`` is the method of the
    thesis: linear one-versus-rest classifiers on the leaves of a forest that is grown on the
    descriptor and its densities.

    ``blocks`` is the range of each block in the descriptor.
    """
    return {
        "forest": lambda: _forest(400),
        "linear": lambda: make_pipeline(
            StandardScaler(), LogisticRegression(C=0.1, class_weight="balanced", max_iter=2000)
        ),
        "pnn": lambda: _DensityProduct(blocks),
        "forest words": lambda: _ForestWords(blocks),
    }


def _forest(trees: int) -> RandomForestClassifier:
    return RandomForestClassifier(
        trees, min_samples_leaf=2, class_weight="balanced", random_state=0
    )


def _fit_densities(x: F4, y: np.ndarray, blocks: Sequence[slice], kernels: int) -> FeatureBank:
    codes = np.unique(y, return_inverse=True)[1]
    rng = np.random.default_rng(check_random_state(0).randint(2**31))
    return fit_bank(x, codes, blocks, kernels=kernels, rng=rng)


class _DensityProduct:
    """A probabilistic neural network as a classifier: the product of the blocks' densities."""

    def __init__(self, blocks: Sequence[slice]) -> None:
        self._blocks = blocks

    def fit(self, x: F4, y: np.ndarray) -> Self:
        self.classes_ = np.unique(y)
        self._bank = _fit_densities(x, y, self._blocks, 300)
        return self

    def predict_proba(self, x: F4) -> F8:
        bank = self._bank
        densities = bank.features(x)[:, bank.mean.size :].reshape(
            len(x), bank.categories, bank.bandwidth.size
        )
        return softmax(densities.astype(np.float64) @ bank.spread.astype(np.float64))


class _ForestWords:
    """Linear classifiers on the words of a view: the leaves it reaches in a forest (thesis 7.3)."""

    def __init__(self, blocks: Sequence[slice]) -> None:
        self._blocks = blocks
        self._forest, self._encoder = _forest(100), OneHotEncoder()

    def fit(self, x: F4, y: np.ndarray) -> Self:
        self.classes_ = np.unique(y)
        self._bank = _fit_densities(x, y, self._blocks, 50)
        features = self._bank.features(x)
        words = self._encoder.fit_transform(self._forest.fit(features, y).apply(features))
        self._learners = [
            LogisticRegression(C=0.03, class_weight="balanced", max_iter=1000).fit(words, y == name)
            for name in self.classes_
        ]
        return self

    def predict_proba(self, x: F4) -> F8:
        words = self._encoder.transform(self._forest.apply(self._bank.features(x)))
        logits = [learner.decision_function(words) for learner in self._learners]
        return softmax(np.stack(logits, axis=1))
