"""Fusion of the posteriors and novelties of an object's views (thesis 7.5.2)."""

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8, Bool

__all__ = ["Method", "causal", "fuse", "fuse_novelty", "view_weights"]

Method = Literal["mean", "product", "vote"]

_PARTIAL_WEIGHT = 0.25
"""Weight of a view that is cut by the image border or an occluder, relative to a whole view."""

_LENIENCE = 0.08
"""The novelty limit of many views is higher than that of one view by this, so that simulated
objects of no category are rejected as often from 2 to 30 views as from one. Measurements gave 0.03
to 0.075."""

_FLOOR = 1e-6
"""Smallest probability of a single view in a product, so that no view can veto all others."""

_BLOCK = 2**16
"""Number of views processed at once."""


def view_weights(partial: Bool) -> F8:
    """Return the weights (k,) of views; ``partial`` (k,): whether each is cut off or occluded."""
    return np.where(np.asarray(partial, np.bool_), _PARTIAL_WEIGHT, 1.0)


def fuse(posteriors: ArrayLike, method: Method = "product", weights: ArrayLike | None = None) -> F8:
    """Fuse the posteriors (k, c) of k views into one posterior (c,).

    The errors of an object's views are correlated (an upside-down cup looks like a can from all
    sides), so the number of views alone does not raise the confidence.

    Parameters
    ----------
    posteriors : (k, c) rows that sum to 1.
    method : ``product``, the normalised geometric mean; ``mean``; or ``vote``, the fraction of the
        views in which each category is the most probable one (on ties, the first).
    weights : (k,) weights of the views, the first one positive; equal by default.

    Returns
    -------
    The fused posterior (c,), which sums to 1.

    Raises
    ------
    ValueError : there is no view, or the method does not exist.

    Examples
    --------
    >>> fuse([[0.5, 0.5], [0.9, 0.1]], "mean")
    array([0.7, 0.3])
    >>> fuse([[0.5, 0.5], [0.9, 0.1], [0.2, 0.8]], "vote").round(2)
    array([0.67, 0.33])
    """
    for block in _running(posteriors, method, weights):
        last = block[-1]
    return np.asarray(last)


def causal(
    posteriors: ArrayLike, method: Method = "product", weights: ArrayLike | None = None
) -> F4:
    """Return a float32 array (k, c): row i is `fuse` of the first i + 1 views; O(1) per view."""
    return np.concatenate([b.astype(np.float32) for b in _running(posteriors, method, weights)])


def _running(posteriors: ArrayLike, method: Method, weights: ArrayLike | None) -> Iterator[F8]:
    """Yield the rows of `causal` in blocks, as a track may have a million views."""
    views = np.asarray(posteriors)
    if views.ndim != 2 or len(views) == 0:
        msg = f"fusion needs (k, c) posteriors of at least one view, got shape {views.shape}"
        raise ValueError(msg)
    weight = np.ones(len(views)) if weights is None else np.asarray(weights, np.float64)
    total, sofar = np.zeros(views.shape[1]), np.cumsum(weight)[:, None]
    for first in range(0, len(views), _BLOCK):
        block = slice(first, first + _BLOCK)
        evidence = _evidence(views[block].astype(np.float64), method) * weight[block, None]
        evidence[0] += total
        summed = np.cumsum(evidence, axis=0)
        total = summed[-1]
        running = summed / sofar[block]
        if method == "product":
            running = np.exp(running - running.max(axis=1, keepdims=True))
        yield running / running.sum(axis=1, keepdims=True)


def fuse_novelty(novelties: ArrayLike, weights: ArrayLike) -> float:
    """Fuse the novelties (k,) of k views; above 1, the object belongs to no known category.

    The result is the weighted mean divided by a limit, which grows from 1 to 1.08 with the sum of
    the weights. A mean scatters less than a single view, so with this limit as many unknown objects
    are rejected as from single views, and fewer known ones.

    Examples
    --------
    >>> fuse_novelty([1.03], [1.0])
    1.03
    >>> fuse_novelty([1.03] * 10, [1.0] * 10) < 1
    True
    """
    weight = np.asarray(weights, np.float64)
    limit = 1 + _LENIENCE * (1 - 1 / max(1.0, float(weight.sum())))
    return float(np.average(np.asarray(novelties, np.float64), weights=weight)) / limit


def _evidence(views: F8, method: str) -> F8:
    """Return the terms (k, c) that are summed over the views, given their posteriors (k, c).

    They are the posteriors (``mean``), their logarithms (``product``) or votes (``vote``).
    """
    if method == "mean":
        return views
    if method == "product":
        return np.asarray(np.log(np.maximum(views, _FLOOR)))
    if method == "vote":
        return np.asarray(np.eye(views.shape[1])[views.argmax(axis=1)])
    msg = f"unknown fusion method {method!r}: mean, product or vote"
    raise ValueError(msg)
