"""Adding categories to a model without changing its trees or its old categories (thesis 7.5.3)."""

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
from shapecat.learning.known_views import KNOWN_VIEWS, choose_evenly
from shapecat.system import stopping

__all__ = ["add_categories"]

_L2 = 1e-2
"""Strength of the L2 regularisation; the loss is a mean over the views."""
_FOLDS = 4
_STEPS = 150
"""Maximum number of iterations of the minimiser if it starts from zero weights."""
_FEW_STEPS = 40
"""Maximum number of iterations if it starts from weights fitted to all views, as for each fold."""
_LOST = 0.004
"""Fraction of the correctly categorized known views that new categories may take over."""


class _Inputs(NamedTuple):
    """Inputs of the new classifiers for n views.

    Attributes
    ----------
    features : (n, f).
    leaf_indicators : sparse (n, l): 1 at the leaves that a view reaches, 0 elsewhere.
    """

    features: F8
    leaf_indicators: sparse.csr_array

    def where(self, chosen: Bool) -> "_Inputs":
        return _Inputs(self.features[chosen], self.leaf_indicators[chosen])


def add_categories(
    categorizer: Categorizer,
    descriptors: F4,
    labels: Sequence[str],
    *,
    rng: np.random.Generator,
) -> Categorizer:
    """Add new categories to a model from a few views of each.

    Each new category gets its own linear classifier on the leaves and the descriptor. The trees,
    the classifiers and the temperature of the old categories do not change. The known views stored
    in the model are the negative examples.

    Parameters
    ----------
    descriptors : (n, d) views of the new categories; views of old categories are further negative
        examples.
    labels : (n,) category names.

    Returns
    -------
    A model with the new categories, sorted by name, after the old ones.

    Raises
    ------
    ValueError : there is no new category, or a new name is invalid, or there are too many.
    ModelError : the model holds no known views.

    Notes
    -----
    The class-balanced cross-entropy of the joint posterior is minimised over the weights of the new
    categories alone, which is a convex problem. Classifiers learned from few views give logits that
    are too low; a constant raises them until they begin to take held-out known views from the old
    categories.
    """
    names = np.asarray(labels, str)
    added = sorted(set(names.tolist()) - set(categorizer.categories))
    if not added:
        msg = f"no new category among {', '.join(sorted(set(names.tolist())))}"
        raise ValueError(msg)
    known = _known_views(categorizer)
    categories = (*categorizer.categories, *added)
    codes = np.array([categories.index(name) for name in names])
    z = np.concatenate([known, categorizer.standardisation.standardise(descriptors)])
    # During the fit, the new logits come last, after the one for unknown shapes.
    count, old_count = len(added), len(categorizer.categories)
    order = _order(old_count, count, unknown=categorizer.knows_unknown)
    truth = np.concatenate([categorizer.known_category.astype(np.int64), order[codes]])
    indicators = _leaf_indicators(categorizer.forest.apply(z), categorizer.forest.leaf_count)
    inputs = _Inputs(z.astype(np.float64), indicators)
    old = _old_logits(categorizer, inputs)
    cold = old / categorizer.temperature
    learned = _fit_new(inputs, cold, truth, np.zeros((_width(inputs), count)), _L2, _STEPS)
    learned[-1] += _shift(inputs, cold, truth, learned, _L2, rng)
    learned *= categorizer.temperature
    linear = np.concatenate([categorizer.linear, learned[: z.shape[1]].T])
    leaf_values = np.concatenate([categorizer.leaf_values, learned[z.shape[1] : -1]], axis=1)
    columns = np.argsort(order)[truth]
    stored = choose_evenly(columns, KNOWN_VIEWS, rng)
    earlier = categorizer.notes.get("added")
    earlier = earlier if isinstance(earlier, list) else []  # the file may hold anything
    return replace(
        categorizer,
        categories=categories,
        leaf_values=leaf_values[:, order],
        linear=linear[order],
        bias=np.concatenate([categorizer.bias, learned[-1]])[order],
        known_descriptors=z[stored],
        known_category=columns[stored],
        notes={**categorizer.notes, "added": [*earlier, *added]},
    )


def _order(old: int, new: int, *, unknown: bool) -> I4:
    """Return, for each logit of the extended model (n,), its column during the fit.

    The model has ``old`` and ``new`` categories, and then, if ``unknown``, the logit for unknown
    shapes. During the fit, the new categories come last.
    """
    first = old + unknown
    return np.concatenate([np.arange(old), np.arange(first, first + new), np.arange(old, first)])


def _known_views(categorizer: Categorizer) -> F4:
    if not len(categorizer.known_descriptors):
        msg = f"model {categorizer.model_id} holds no known views, which new categories need"
        raise ModelError(msg)
    return categorizer.known_descriptors.astype(np.float32)


def _leaf_indicators(leaf_ids: I4, leaf_count: int) -> sparse.csr_array:
    """Return sparse rows (n, leaf_count), one per view: 1 at its leaf ids (n, t), 0 elsewhere."""
    views, trees = leaf_ids.shape
    starts = np.arange(views + 1, dtype=np.int32) * trees
    columns = leaf_ids.reshape(-1).astype(np.int32)
    return sparse.csr_array((np.ones(leaf_ids.size), columns, starts), shape=(views, leaf_count))


def _old_logits(categorizer: Categorizer, inputs: _Inputs) -> F8:
    of_leaves = inputs.leaf_indicators @ categorizer.leaf_values.astype(np.float64)
    linear = inputs.features @ categorizer.linear.T
    return np.asarray(of_leaves + linear + categorizer.bias)


def _width(inputs: _Inputs) -> int:
    """Return the number of weights per new category: features, leaves, constant."""
    return int(inputs.features.shape[1] + inputs.leaf_indicators.shape[1] + 1)


def _logits(inputs: _Inputs, weights: F8) -> F8:
    width = inputs.features.shape[1]
    linear_part = np.einsum("nf,cf->nc", inputs.features, np.ascontiguousarray(weights[:width].T))
    return np.asarray(linear_part + inputs.leaf_indicators @ weights[width:-1] + weights[-1])


def _fit_new(inputs: _Inputs, old: F8, truth: I4, start: F8, l2: float, steps: int) -> F8:
    """Return the weights (`_width`, new categories) of the new logits.

    ``old`` (n, k) are the old logits, divided by the temperature. ``truth`` (n,) is the column of
    each view's true category, where new columns follow the old ones. ``start`` are initial weights,
    ``l2`` is the factor of the L2 penalty, and ``steps`` limits the iterations.
    """
    views, first = old.shape
    count = start.shape[1]
    share = 1.0 / (np.bincount(truth, minlength=first + count)[truth] * np.unique(truth).size)
    target = np.zeros((views, count))
    rows = np.flatnonzero(truth >= first)
    target[rows, truth[rows] - first] = 1.0
    offset = np.logaddexp.reduce(old, axis=1, keepdims=True)
    own_old = np.where(truth < first, old[np.arange(views), np.minimum(truth, first - 1)], 0.0)

    def loss(flat: F8) -> tuple[float, F8]:
        """Return the loss of the flattened weights, and its gradient."""
        stopping.check()
        weights = flat.reshape(start.shape)
        new = _logits(inputs, weights)
        total = np.logaddexp.reduce(np.concatenate([offset, new], axis=1), axis=1)
        chosen = np.where(truth < first, own_old, (new * target).sum(axis=1))
        residual = share[:, None] * (np.exp(new - total[:, None]) - target)
        of_features = np.einsum("nf,nc->cf", inputs.features, residual).T
        of_leaves = inputs.leaf_indicators.T @ residual
        gradient = np.concatenate([of_features, of_leaves, residual.sum(axis=0)[None]])
        gradient[:-1] += l2 * weights[:-1]
        value = float(share @ (total - chosen)) + 0.5 * l2 * float((weights[:-1] ** 2).sum())
        return value, gradient.reshape(-1)

    # For such short sums, threads spend most of the time waiting for each other.
    with threadpool_limits(1):
        result = minimize(
            loss, start.reshape(-1), jac=True, method="L-BFGS-B", options={"maxiter": steps}
        )
    return np.asarray(result.x.reshape(start.shape))


def _shift(
    inputs: _Inputs, old: F8, truth: I4, learned: F8, l2: float, rng: np.random.Generator
) -> float:
    """Return the constant to add to the new logits, at least 0.

    It is the largest with which the new categories take over at most a fraction `_LOST` of the
    views that the old logits categorize correctly. The new logits of a view come from a fit without
    the view. The parameters are as for `_fit_new`; ``learned`` are its weights for all views.
    """
    fold = rng.permutation(len(truth)) % _FOLDS
    new = np.zeros((len(truth), learned.shape[1]))
    for k in range(_FOLDS):
        test = fold == k
        fitted = _fit_new(inputs.where(~test), old[~test], truth[~test], learned, l2, _FEW_STEPS)
        new[test] = _logits(inputs.where(test), fitted)
    right = old.argmax(axis=1) == truth
    margin = (old.max(axis=1) - new.max(axis=1))[right]
    return max(float(np.quantile(margin, _LOST)), 0.0) if margin.size else 0.0
