"""Calibration of confidences by one temperature, fitted on held-out instances."""

import numpy as np
from scipy.optimize import minimize_scalar

from shapecat.arrays import F8, I4

__all__ = ["fit_temperature", "softmax"]


def softmax(logits: F8) -> F8:
    """Return the posteriors (n, c) of logits (n, c)."""
    shifted = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(shifted / shifted.sum(axis=1, keepdims=True))


def fit_temperature(logits: F8, labels: I4) -> float:
    """Return the temperature T that makes ``softmax(logits / T)`` fit the labels best.

    T minimises the negative log-likelihood in [0.05, 20]. It does not change the order of the
    categories of a view.

    Parameters
    ----------
    logits : (n, c).
    labels : (n,) true column of each row.

    Source: Guo et al. 2017, section 4.2.

    Examples
    --------
    >>> logits = np.log([[0.8, 0.2]] * 5)
    >>> round(fit_temperature(3 * logits, np.array([0, 0, 0, 0, 1])), 2)
    3.0
    """
    rows = np.arange(len(labels))

    def loss(log_temperature: float) -> float:
        scaled = logits / np.exp(log_temperature)
        scaled = scaled - scaled.max(axis=1, keepdims=True)
        return float(np.mean(np.log(np.exp(scaled).sum(axis=1)) - scaled[rows, labels]))

    bounds = (np.log(0.05), np.log(20.0))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    return float(np.exp(found.x))
