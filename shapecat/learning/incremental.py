"""New categories on a fixed dictionary, without learning the old ones again (thesis 7.5.3)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # has no types

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.errors import ModelError
from shapecat.learning.categorizer import Categorizer
from shapecat.learning.features import FeatureBank
from shapecat.learning.words import bag_of_words

__all__ = ["add_categories"]

_KERNELS = 100
"""Parzen kernels of a new category."""
_FOLDS = 4
_STEPS, _FEW_STEPS = 150, 40
"""Of the minimiser: from nothing, and from a solution for a little more data."""
_LOST = 0.006
"""Share of the known views that new categories may take from old ones."""
_LARGEST_SHIFT = 2.0


class _Inputs(NamedTuple):
    """Inputs of the new learners: ``features`` (n, f) and sparse ``words`` (n, w) of n views."""

    features: F8
    words: sparse.csr_array

    def where(self, chosen: Bool) -> "_Inputs":
        return _Inputs(self.features[chosen], self.words[chosen])


def add_categories(
    categorizer: Categorizer,
    descriptors: F4,
    labels: Sequence[str],
    *,
    rng: np.random.Generator,
    ridge: float = 1e-2,
) -> Categorizer:
    """Learn categories a model does not have from a few views of each.

    Each new category gets its own densities and its own learner on the words, the densities and
    the descriptor; dictionary, learners and temperature of the old categories stay as they are.
    The known views inside the model are the examples of what the new categories are not.

    Parameters
    ----------
    descriptors : (n, d) views of the new categories; views of old ones are examples against.
    labels : (n,) category names.
    ridge : strength of the regularisation, per view.

    Returns
    -------
    A model with the new categories behind the old ones, in the order of their names.

    Raises
    ------
    ValueError : there is no new category.
    ModelError : the model holds no known views.

    Notes
    -----
    Minimises the class-balanced cross entropy of the joint posterior over the weights of the new
    categories alone: a convex problem. Learned from few views, new learners are too timid; they are
    raised to where they begin to take known views of other folds from old categories.
    """
    names = np.asarray(labels, str)
    added = sorted(set(names.tolist()) - set(categorizer.categories))
    if not added:
        msg = f"no new category among {', '.join(sorted(set(names.tolist())))}"
        raise ValueError(msg)
    known = _known_views(categorizer)
    categories = (*categorizer.categories, *added)
    codes = np.array([categories.index(name) for name in names])
    bank = _extend_bank(categorizer.bank, descriptors, codes, rng)
    z = np.concatenate([known, bank.standardise(descriptors)])
    # while the new learners are fitted they stand last, behind the one of unknown shapes
    count, old_count = len(added), len(categorizer.categories)
    order = _order(old_count, count, unknown=categorizer.knows_unknown)
    truth = np.concatenate([categorizer.known_category.astype(np.int64), order[codes]])
    features = _features_of_standardised(bank, z)
    words = categorizer.forest.fall(features)
    inputs = _Inputs(features.astype(np.float64), bag_of_words(words, categorizer.forest.words))
    old = _old_logits(categorizer, inputs)
    cold = old / categorizer.temperature
    learned = _fit_new(inputs, cold, truth, np.zeros((_width(inputs), count)), ridge, _STEPS)
    learned[-1] += _shift(inputs, cold, truth, learned, ridge, rng)
    learned *= categorizer.temperature
    linear = np.zeros((old.shape[1] + count, bank.width), np.float32)
    linear[: old.shape[1], : categorizer.linear.shape[1]] = categorizer.linear
    linear[old.shape[1] :] = learned[: bank.width].T
    votes = np.concatenate([categorizer.votes, learned[bank.width : -1]], axis=1)
    return replace(
        categorizer,
        categories=categories,
        bank=bank,
        votes=votes[:, order],
        linear=linear[order],
        bias=np.concatenate([categorizer.bias, learned[-1]])[order],
        known_descriptors=z,
        known_category=np.argsort(order)[truth],
        notes={**categorizer.notes, "added": [*categorizer.notes.get("added", []), *added]},
    )


def _order(old: int, new: int, *, unknown: bool) -> I4:
    """Return the column of each final logit during the fit of the new learners."""
    first = old + unknown
    return np.concatenate([np.arange(old), np.arange(first, first + new), np.arange(old, first)])


def _known_views(categorizer: Categorizer) -> F4:
    if not len(categorizer.known_descriptors):
        msg = f"model {categorizer.model_id} holds no known views to learn new categories against"
        raise ModelError(msg)
    return categorizer.known_descriptors.astype(np.float32)


def _extend_bank(bank: FeatureBank, x: F4, codes: I4, rng: np.random.Generator) -> FeatureBank:
    """Add a density column per new category, with the bandwidths of the others."""
    z = bank.standardise(x)
    new = [
        np.sort(rng.permutation(np.flatnonzero(codes == code))[:_KERNELS])
        for code in range(bank.categories, int(codes.max()) + 1)
    ]
    if bank.bandwidth.size == 0:
        new = [rows[:0] for rows in new]
    ends = bank.starts[-1] + np.cumsum([len(rows) for rows in new])
    return replace(
        bank,
        starts=np.concatenate([bank.starts, ends]),
        kernels=np.concatenate([bank.kernels, *(z[rows].astype(np.float16) for rows in new)]),
    )


def _features_of_standardised(bank: FeatureBank, z: F4) -> F4:
    """Return the features of descriptors that are standardised already."""
    width = z.shape[1]
    plain = replace(
        bank, columns=np.arange(width), mean=np.zeros(width), inverse_scale=np.ones(width)
    )
    return plain.features(z)


def _old_logits(categorizer: Categorizer, inputs: _Inputs) -> F8:
    votes = inputs.words @ categorizer.votes.astype(np.float64)
    linear = inputs.features[:, : categorizer.linear.shape[1]] @ categorizer.linear.T
    return np.asarray(votes + linear + categorizer.bias)


def _width(inputs: _Inputs) -> int:
    """Return the number of weights of a learner: features, words, constant."""
    return int(inputs.features.shape[1] + inputs.words.shape[1] + 1)


def _logits(inputs: _Inputs, weights: F8) -> F8:
    width = inputs.features.shape[1]
    own = np.einsum("nf,cf->nc", inputs.features, np.ascontiguousarray(weights[:width].T))
    return np.asarray(own + inputs.words @ weights[width:-1] + weights[-1])


def _fit_new(inputs: _Inputs, old: F8, truth: I4, start: F8, ridge: float, steps: int) -> F8:
    """Return the weights (`_width`, new categories) of the new logits."""
    views, first = old.shape
    count = start.shape[1]
    share = 1.0 / (np.bincount(truth, minlength=first + count)[truth] * np.unique(truth).size)
    target = np.zeros((views, count))
    rows = np.flatnonzero(truth >= first)
    target[rows, truth[rows] - first] = 1.0
    offset = np.logaddexp.reduce(old, axis=1, keepdims=True)
    own_old = np.where(truth < first, old[np.arange(views), np.minimum(truth, first - 1)], 0.0)
    by_word = inputs.words.T.tocsr()

    def loss(flat: F8) -> tuple[float, F8]:
        weights = flat.reshape(start.shape)
        new = _logits(inputs, weights)
        total = np.logaddexp.reduce(np.concatenate([offset, new], axis=1), axis=1)
        own = np.where(truth < first, own_old, (new * target).sum(axis=1))
        residual = share[:, None] * (np.exp(new - total[:, None]) - target)
        own_slope = np.einsum("nf,nc->cf", inputs.features, residual).T
        slope = np.concatenate([own_slope, by_word @ residual, residual.sum(axis=0)[None]])
        slope[:-1] += ridge * weights[:-1]
        value = float(share @ (total - own)) + 0.5 * ridge * float((weights[:-1] ** 2).sum())
        return value, slope.reshape(-1)

    # threads gain nothing on sums so short; they wait for each other most of the time
    with threadpool_limits(1):
        found = minimize(
            loss, start.reshape(-1), jac=True, method="L-BFGS-B", options={"maxiter": steps}
        )
    return np.asarray(found.x.reshape(start.shape))


def _shift(
    inputs: _Inputs, old: F8, truth: I4, learned: F8, ridge: float, rng: np.random.Generator
) -> float:
    """Return the largest offset of the new logits that takes few known views from old categories.

    Judged by learners of the other folds, on the known views that are right now.
    """
    fold = rng.permutation(len(truth)) % _FOLDS
    new = np.zeros((len(truth), learned.shape[1]))
    for k in range(_FOLDS):
        held = fold == k
        fitted = _fit_new(inputs.where(~held), old[~held], truth[~held], learned, ridge, _FEW_STEPS)
        new[held] = _logits(inputs.where(held), fitted)
    right = old.argmax(axis=1) == truth
    margin = (old.max(axis=1) - new.max(axis=1))[right]
    most = float(np.quantile(margin, _LOST)) if margin.size else 0.0
    return float(np.clip(most, 0.0, _LARGEST_SHIFT))
