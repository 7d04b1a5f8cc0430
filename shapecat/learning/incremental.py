"""New categories on a fixed dictionary, without learning the old ones again (thesis 7.5.3)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.optimize import minimize

from shapecat.arrays import F4, F8, I4
from shapecat.errors import ModelError
from shapecat.learning.categorizer import Categorizer
from shapecat.learning.features import FeatureBank
from shapecat.learning.words import bag_of_words

__all__ = ["add_categories"]

_KERNELS = 100
"""Parzen kernels of a new category."""


def add_categories(
    categorizer: Categorizer,
    descriptors: F4,
    labels: Sequence[str],
    *,
    rng: np.random.Generator,
    ridge: float = 3e-3,
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
    categories alone: a convex problem.
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
    inputs = sparse.hstack(
        [bag_of_words(words, categorizer.forest.words), sparse.csr_array(features)], format="csr"
    )
    old = _old_logits(categorizer, words, features)
    weights, bias = _fit_new(inputs, old / categorizer.temperature, truth, count, ridge)
    weights, bias = weights * categorizer.temperature, bias * categorizer.temperature
    vocabulary = categorizer.forest.words
    linear = np.zeros((old.shape[1] + count, bank.width), np.float32)
    linear[: old.shape[1], : categorizer.linear.shape[1]] = categorizer.linear
    linear[old.shape[1] :] = weights[:, vocabulary:]
    votes = np.concatenate([categorizer.votes, weights[:, :vocabulary].T], axis=1)
    return replace(
        categorizer,
        categories=categories,
        bank=bank,
        votes=votes[:, order],
        linear=linear[order],
        bias=np.concatenate([categorizer.bias, bias])[order],
        known_descriptors=z,
        known_category=np.argsort(order)[truth],
        notes={**categorizer.notes, "added": [*categorizer.notes.get("added", []), *added]},
    )


def _order(old: int, new: int, *, unknown: bool) -> I4:
    """Return where each column of the final logits stands while the new learners are fitted."""
    first = old + unknown
    return np.concatenate([np.arange(old), np.arange(first, first + new), np.arange(old, first)])


def _known_views(categorizer: Categorizer) -> F4:
    if not len(categorizer.known_descriptors):
        msg = f"model {categorizer.model_id} holds no known views to learn new categories against"
        raise ModelError(msg)
    return categorizer.known_descriptors.astype(np.float32)


def _extend_bank(bank: FeatureBank, x: F4, codes: I4, rng: np.random.Generator) -> FeatureBank:
    """Give each new category its own column of densities, with the bandwidths of the others."""
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


def _old_logits(categorizer: Categorizer, words: I4, features: F4) -> F8:
    votes = categorizer.votes.astype(np.float64)[words].sum(axis=1)
    width = categorizer.linear.shape[1]
    linear = features[:, :width].astype(np.float64) @ categorizer.linear.T
    return np.asarray(votes + linear + categorizer.bias)


def _fit_new(
    inputs: sparse.csr_array, old: F8, truth: I4, count: int, ridge: float
) -> tuple[F8, F8]:
    """Return weights (count, inputs) and biases (count,) of the new logits."""
    views, width = inputs.shape
    first = old.shape[1]
    share = 1.0 / (np.bincount(truth, minlength=first + count)[truth] * np.unique(truth).size)
    target = np.zeros((views, count))
    rows = np.flatnonzero(truth >= first)
    target[rows, truth[rows] - first] = 1.0
    offset = np.logaddexp.reduce(old, axis=1, keepdims=True)
    own_old = np.where(truth < first, old[np.arange(views), np.minimum(truth, first - 1)], 0.0)

    def loss(flat: F8) -> tuple[float, F8]:
        weights = flat[: width * count].reshape(count, width)
        new = np.asarray(inputs @ weights.T) + flat[width * count :]
        total = np.logaddexp.reduce(np.concatenate([offset, new], axis=1), axis=1)
        own = np.where(truth < first, own_old, (new * target).sum(axis=1))
        residual = share[:, None] * (np.exp(new - total[:, None]) - target)
        gradient = np.asarray(inputs.T @ residual).T + ridge * weights
        value = float(share @ (total - own)) + 0.5 * ridge * float((weights**2).sum())
        return value, np.concatenate([gradient.reshape(-1), residual.sum(axis=0)])

    start = np.zeros((width + 1) * count)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 300})
    return found.x[: width * count].reshape(count, width), found.x[width * count :]
