"""The ensemble of boosted trees that computes the logits of all categories (thesis 7.3, 7.4)."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.learning.boosting import Bins, Tree, TreeSettings, grow_tree, joined, make_bins
from shapecat.learning.forest import FlatForest
from shapecat.system import stopping

__all__ = ["BoostedEnsemble", "grow_ensemble"]

_L2 = 2.0
_MIN_HESSIAN = 1.0
"""L2 regularisation and minimum sum of second derivatives, as in `TreeSettings`."""
_COLUMNS, _ROWS = 0.08, 0.5
"""Fractions of the features and of the views that are drawn at random for each tree."""
_FEWEST_COLUMNS = 10
_FEWEST_ROWS = 100
"""Minimum numbers of features and views that are drawn, or all if there are fewer."""


class BoostedEnsemble(NamedTuple):
    """Boosted trees, and the values of their leaves.

    In the thesis, the ensemble is the *dictionary*, and its leaves are the *words*.

    Attributes
    ----------
    leaf_values : (l, k) the value that each of l leaves adds to each of k logits, rounded to half
        precision.
    bias : (k,) constants of the logits.
    """

    forest: FlatForest
    leaf_values: F4
    bias: F8


def grow_ensemble(
    features: F4,
    labels: I4,
    *,
    rounds: int,
    leaves: int,
    rate: float,
    jobs: int,
    rng: np.random.Generator,
) -> BoostedEnsemble:
    """Grow gradient-boosted trees; a logit is a bias plus the values of the leaves a view reaches.

    Each round grows one tree for each category, on the residual of its posterior. Thus the trees
    and the classifiers, which sum the leaf values, are learned together.

    Parameters
    ----------
    features : (n, f) standardised features of n views.
    labels : (n,) index of each view's true logit; each logit is true for at least one view.
    rounds : trees per category.
    leaves : maximum number of leaves per tree.
    rate : learning rate.
    jobs : number of trees grown at the same time; it does not affect the result.

    Raises
    ------
    Stopped : a signal asked the process to stop.

    Source: thesis 7.3, 7.4; differs: the trees are boosted, instead of a random forest with linear
    classifiers on top, see docs/decisions/0008-boosted-dictionary.md.
    """
    bias = np.log(np.bincount(labels) / labels.size)
    scores = np.repeat(bias[:, None], labels.size, axis=1).astype(np.float32)
    settings = TreeSettings(leaves, rate, _L2, _MIN_HESSIAN)
    trees = _boost(make_bins(features), labels, scores, rounds, settings, jobs, rng)
    return BoostedEnsemble(*_join(trees, bias.size), bias)


def _boost(
    bins: Bins,
    labels: I4,
    scores: F4,
    rounds: int,
    settings: TreeSettings,
    jobs: int,
    rng: np.random.Generator,
) -> list[Tree]:
    """Grow one tree per category in each round; return them round by round.

    ``scores`` (k, n) are the initial logits of the n views; the leaf values are added in place.
    ``labels``, ``rounds`` and ``jobs`` are as for `grow_ensemble`.
    """
    truth = labels == np.arange(len(scores))[:, None]
    # Only K - 1 of K logits are independent: each moves (K - 1) / K as far (Friedman 2001, eq. 36).
    freedom = np.float32(len(scores) / (len(scores) - 1))
    trees: list[Tree] = []
    with ThreadPoolExecutor(jobs) as pool:
        for _ in range(rounds):
            stopping.check()
            posterior = np.exp(scores - scores.max(axis=0))
            posterior /= posterior.sum(axis=0)
            draws = [_draw(bins, rng) for _ in scores]
            hessian = np.maximum(freedom * posterior * (1 - posterior), 1e-6)
            grow = [
                pool.submit(grow_tree, bins, *draw, p - t, h, settings, score)
                for draw, p, t, h, score in zip(
                    draws, posterior, truth, hessian, scores, strict=True
                )
            ]
            trees += [tree.result() for tree in grow]
    return trees


def _draw(bins: Bins, rng: np.random.Generator) -> tuple[I4, I4]:
    """Draw the features and the views to grow one tree from; return their indices, ascending."""
    features, views = bins.binned.shape
    width = max(round(_COLUMNS * features), min(features, _FEWEST_COLUMNS))
    height = max(round(_ROWS * views), min(views, _FEWEST_ROWS))
    columns = np.sort(rng.permutation(features)[:width])
    return columns, np.sort(rng.permutation(views)[:height]).astype(np.int32)


def _join(trees: Sequence[Tree], categories: int) -> tuple[FlatForest, F4]:
    """Return the trees as one forest, and the values (l, categories) of its l leaves.

    ``trees`` are from `_boost`. A leaf has a value for the category of its tree only, else 0.
    """
    (roots, feature, threshold, left), value = joined(trees)
    leaf = left == 0
    forest = FlatForest(roots, feature, np.where(leaf, 0, threshold), left)
    sizes = np.diff(roots, append=left.size)
    owner = np.repeat(np.arange(len(trees)) % categories, sizes)[leaf]
    leaf_values = np.zeros((forest.leaf_count, categories), np.float16)
    leaf_values[np.arange(forest.leaf_count), owner] = value[leaf]
    return forest, leaf_values.astype(np.float32)
