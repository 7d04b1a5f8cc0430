"""Boosted trees as a dictionary of words, with a classifier per category (thesis 7.3, 7.4)."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import ClassifierMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import validate_data

from shapecat.arrays import F4, F8, I4
from shapecat.learning.boosting import Bins, Tree, TreeSettings, grow_tree, make_bins
from shapecat.learning.calibration import softmax
from shapecat.learning.forest import FlatForest
from shapecat.learning.pnn import known_labels
from shapecat.learning.tree_dictionary import TreeDictionary

__all__ = ["BoostedDictionary"]

_L2 = 2.0
_MIN_HESSIAN = 1.0
_FEWEST_COLUMNS = 10
_FEWEST_ROWS = 100


@dataclass(kw_only=True, eq=False, repr=False)
class BoostedDictionary(ClassifierMixin, TreeDictionary):  # type: ignore[misc]  # sklearn is untyped
    """Gradient-boosted trees whose leaves are words; a category's logit is the sum of word values.

    Each round grows one tree per category against the rest, on the residual of its posterior. The
    dictionary and the classifiers on its words are thus learned together.

    Parameters
    ----------
    rounds : trees per category.
    leaves : maximum number of words (leaves) per tree.
    rate : learning rate.
    columns, rows : fraction of the features and of the views, drawn at random for each tree.
    unknown : label of shapes that belong to no category; None if there are none. They get trees
        and a logit of their own, after those of the categories.
    jobs : number of trees grown at the same time; it does not affect the result.
    random_state : seed of the random choices.

    Attributes
    ----------
    classes_ : the categories, without ``unknown``.
    forest_ : the `FlatForest` of all trees.
    votes_ : (words, k) the value that each word adds to each logit, rounded to half precision; k is
        one more than the categories if there were unknown shapes.
    bias_ : (k,) constants of the logits.

    Source: thesis 7.3, 7.4; differs: the trees are boosted, instead of a random forest with linear
    classifiers on top, see docs/decisions/0008-boosted-dictionary.md.
    """

    rounds: int = 100
    leaves: int = 16
    rate: float = 0.1
    columns: float = 0.08
    rows: float = 0.5
    unknown: Any = None
    jobs: int | None = None
    random_state: int | None = None

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Grow the trees on features X (n, f) and labels y (n,); unknown shapes are included."""
        x, y = validate_data(self, X, y, dtype=np.float32)
        self.classes_, labels = known_labels(y, self.unknown)
        labels = np.where(labels < 0, len(self.classes_), labels)
        self.bias_ = np.log(np.bincount(labels) / labels.size)
        scores = np.repeat(self.bias_[:, None], labels.size, axis=1).astype(np.float32)
        trees = self._boost(make_bins(x), labels, scores)
        self.forest_, self.votes_ = _join(trees, self.bias_.size)
        return self

    def logits(self, X: ArrayLike) -> F8:
        """Return the logits (n, k) of features X (n, f)."""
        words = self.words(X)
        return np.asarray(self.votes_[words].sum(axis=1) + self.bias_)

    def decision_function(self, X: ArrayLike) -> F8:
        """Return the logits (n, c) of the categories; for two, their difference (n,)."""
        logits = self.logits(X)[:, : len(self.classes_)]
        return logits[:, 1] - logits[:, 0] if len(self.classes_) == 2 else logits

    def predict_proba(self, X: ArrayLike) -> F8:
        """Return the posteriors of the categories (n, c)."""
        return softmax(self.logits(X)[:, : len(self.classes_)])

    def predict(self, X: ArrayLike) -> Any:
        """Return the most probable label (n,) of each view, from features X (n, f)."""
        logits = self.logits(X)[:, : len(self.classes_)]
        return self.classes_[logits.argmax(axis=1)]

    def _boost(self, bins: Bins, labels: I4, scores: F4) -> list[Tree]:
        """Grow one tree per category in each round; return them round by round.

        The leaf values of all trees are added to ``scores`` (k, n).
        """
        rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31))
        truth = labels == np.arange(len(scores))[:, None]
        # One of K logits is free, so each moves (K - 1) / K of the way (Friedman 2001, eq. 36).
        freedom = np.float32(len(scores) / (len(scores) - 1))
        trees: list[Tree] = []
        with ThreadPoolExecutor(self.jobs or 1) as pool:
            for _ in range(self.rounds):
                posterior = np.exp(scores - scores.max(axis=0))
                posterior /= posterior.sum(axis=0)
                draws = [self._draw(bins, rng) for _ in scores]
                grow = [
                    pool.submit(self._grow, bins, draw, p - t, freedom * p * (1 - p), score)
                    for draw, p, t, score in zip(draws, posterior, truth, scores, strict=True)
                ]
                trees += [tree.result() for tree in grow]
        return trees

    def _draw(self, bins: Bins, rng: np.random.Generator) -> tuple[I4, I4]:
        """Draw the columns and the rows of one tree; return their indices."""
        features, views = bins.binned.shape
        width = max(round(self.columns * features), min(features, _FEWEST_COLUMNS))
        height = max(round(self.rows * views), min(views, _FEWEST_ROWS))
        columns = np.sort(rng.permutation(features)[:width])
        return columns, np.sort(rng.permutation(views)[:height]).astype(np.int32)

    def _grow(self, bins: Bins, draw: tuple[I4, I4], gradient: F4, hessian: F4, score: F4) -> Tree:
        columns, rows = draw
        settings = TreeSettings(self.leaves, self.rate, _L2, _MIN_HESSIAN)
        return grow_tree(bins, columns, rows, gradient, np.maximum(hessian, 1e-6), settings, score)


def _join(trees: Sequence[Tree], categories: int) -> tuple[FlatForest, F4]:
    """Return the trees as one forest, and the values (words, categories) of its leaves."""
    sizes = np.array([tree.left.size for tree in trees])
    roots = np.cumsum(sizes) - sizes
    base = np.repeat(roots, sizes)
    left = np.concatenate([tree.left for tree in trees])
    leaf = left == 0
    forest = FlatForest(
        roots,
        np.where(leaf, 0, np.concatenate([tree.feature for tree in trees])),
        np.where(leaf, 0, np.concatenate([tree.threshold for tree in trees])),
        np.where(leaf, 0, left + base),
    )
    owner = np.repeat(np.arange(len(trees)) % categories, sizes)[leaf]
    value = np.concatenate([tree.value for tree in trees])[leaf]
    votes = np.zeros((forest.words, categories), np.float16)
    votes[np.arange(forest.words), owner] = value
    return forest, votes.astype(np.float32)
