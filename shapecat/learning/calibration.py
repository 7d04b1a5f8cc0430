"""Calibration of confidences by one temperature, fitted on held-out instances."""

from collections.abc import Iterable

import numpy as np
from scipy.optimize import minimize_scalar

from shapecat.arrays import F8, I4

__all__ = ["can_calibrate", "fit_temperature", "softmax"]


def can_calibrate(held_out: Iterable[str], categories: Iterable[str]) -> bool:
    """Return whether the labels of held-out views cover at least half of the categories."""
    names = set(categories)
    return 2 * len(names & set(held_out)) >= len(names)


def softmax(logits: F8) -> F8:
    """Return the posteriors (n, c) of logits (n, c)."""
    shifted = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(shifted / shifted.sum(axis=1, keepdims=True))


def fit_temperature(logits: F8, labels: I4, objects: int) -> float:
    """Return the temperature T that makes ``softmax(logits / T)`` fit the labels best.

    T minimises the negative log-likelihood in [0.05, 20]. It does not change the order of the
    categories of a view. If all views are categorized correctly, the likelihood would be largest
    for a confidence of 1. The true category then has the target (k + 1) / (k + 2), where k is the
    number of objects.

    Parameters
    ----------
    logits : (n, c).
    labels : (n,) true column of each view.
    objects : number of objects that the views show.

    Sources: Guo et al. 2017, section 4.2; targets: Platt 1999.

    Examples
    --------
    >>> logits = np.log([[0.8, 0.2]] * 5)
    >>> round(fit_temperature(3 * logits, np.array([0, 0, 0, 0, 1]), 5), 2)
    3.0
    """
    targets = np.eye(logits.shape[1])[labels]
    if np.all(logits.argmax(axis=1) == labels):
        doubt = 1.0 / (objects + 2)
        targets = np.where(targets > 0, 1.0 - doubt, doubt / (logits.shape[1] - 1))

    def loss(log_temperature: float) -> float:
        scaled = logits / np.exp(log_temperature)
        scaled = scaled - scaled.max(axis=1, keepdims=True)
        true_logit = (targets * scaled).sum(axis=1)
        return float(np.mean(np.log(np.exp(scaled).sum(axis=1)) - true_logit))

    bounds = (np.log(0.05), np.log(20.0))
    result = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    return float(np.exp(result.x))
