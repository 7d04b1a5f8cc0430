"""Metrics of posteriors against the truth, in plain NumPy.

A label is the index of a category: its column in the posterior. Where it matters, functions take
the number of categories, so that categories without views appear in the result.
"""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4

__all__ = [
    "Bin",
    "accuracy",
    "auroc",
    "balanced_accuracy",
    "calibration_curve",
    "confusion",
    "expected_calibration_error",
    "recall",
]

_BINS = 15
"""Number of bins of confidence, from 0 to 1."""


class Bin(NamedTuple):
    """Views of similar confidence: their number, mean confidence and accuracy."""

    views: int
    confidence: float
    accuracy: float


def accuracy(truth: I4, predicted: I4) -> float:
    """Return the fraction of views with the right category; NaN without views.

    ``truth`` and ``predicted`` (n,) are indices of categories.
    """
    return float(np.mean(truth == predicted)) if len(truth) else float("nan")


def confusion(truth: I4, predicted: I4, categories: int) -> I4:
    """Return the confusion matrix (c, c): views by true category (row) and predicted one (column).

    ``truth`` and ``predicted`` (n,) are indices of categories, ``categories`` is c.

    Examples
    --------
    >>> confusion(np.array([0, 0, 1]), np.array([0, 1, 1]), 2)
    array([[1, 1],
           [0, 1]])
    """
    flat = np.asarray(truth) * categories + np.asarray(predicted)
    return np.bincount(flat, minlength=categories**2).reshape(categories, categories)


def recall(table: I4) -> F8:
    """Return the recall (c,) of each category; NaN for categories without views.

    ``table`` is a confusion matrix (c, c) with one row per true category.
    """
    totals = table.sum(axis=1)
    return np.where(totals > 0, np.diag(table) / np.maximum(totals, 1), np.nan)


def balanced_accuracy(table: I4) -> float:
    """Return the mean recall of the categories with views; NaN without views.

    ``table`` (c, c) is as for `recall`.
    """
    shares = recall(table)
    return float(np.nanmean(shares)) if np.any(table) else float("nan")


def calibration_curve(truth: I4, posteriors: F4) -> tuple[Bin, ...]:
    """Return the calibration curve: bins of equal width in confidence, without the empty ones.

    The confidence of a view is its largest posterior. ``truth`` (n,) are the columns of the true
    categories in ``posteriors`` (n, c).
    """
    confidence = np.asarray(posteriors, np.float64).max(axis=1, initial=0.0)
    right = np.asarray(posteriors).argmax(axis=1) == truth if len(truth) else np.zeros(0, bool)
    place = np.minimum((confidence * _BINS).astype(np.int64), _BINS - 1)
    return tuple(
        Bin(int(in_bin.sum()), float(confidence[in_bin].mean()), float(right[in_bin].mean()))
        for in_bin in (place == k for k in range(_BINS))
        if in_bin.any()
    )


def expected_calibration_error(truth: I4, posteriors: F4) -> float:
    """Return the mean absolute difference between confidence and accuracy of the bins.

    Bins are weighted by their numbers of views. ``truth`` and ``posteriors`` are as for
    `calibration_curve`. The result is NaN without views.

    Source: Naeini et al. 2015; Guo et al. 2017, eq. 3.
    """
    curve = calibration_curve(truth, posteriors)
    if not curve:
        return float("nan")
    counts = np.array([item.views for item in curve])
    gaps = np.array([abs(item.confidence - item.accuracy) for item in curve])
    return float(counts @ gaps / counts.sum())


def auroc(positive: F4, negative: F4) -> float:
    """Return the probability that a positive scores higher than a negative; ties count half.

    ``positive`` (m,) and ``negative`` (n,) are scores. The result is NaN if either is empty.

    Examples
    --------
    >>> auroc([2.0, 3.0], [1.0, 2.0])
    0.875
    """
    positive, negative = np.asarray(positive, np.float64), np.sort(np.asarray(negative, np.float64))
    if not (positive.size and negative.size):
        return float("nan")
    below = np.searchsorted(negative, positive, "left")
    not_above = np.searchsorted(negative, positive, "right")
    return float((below + not_above).mean() / (2 * negative.size))
