"""Accuracy of several fused views of one object (thesis 7.5.2)."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.evaluation import metrics
from shapecat.tracking import fuse

__all__ = ["FUSED", "Fused", "fuse_views"]

FUSED = (3, 10, 30)
"""Numbers of views to fuse."""


class Fused(NamedTuple):
    """Accuracy and calibration error (ECE) of ``groups`` groups of ``views`` fused views each."""

    views: int
    groups: int
    accuracy: float
    ece: float


def fuse_views(truth: I4, posteriors: F4, objects: np.ndarray) -> tuple[Fused, ...]:
    """Fuse the views of each object in groups of consecutive views, and measure the accuracy.

    Views that do not fill a group are not used. The errors of an object's views are correlated, so
    the product of their posteriors is tempered by their number, as in tracks. A plain product would
    be overconfident, a mean underconfident.

    Parameters
    ----------
    truth : (n,) true column of each view.
    posteriors : (n, c).
    objects : (n,) name of each view's object.

    Returns
    -------
    One result for each number in `FUSED` for which at least one object has enough views.
    """
    result = []
    for count in FUSED:
        groups = [
            members[k : k + count]
            for members in (np.flatnonzero(objects == name) for name in np.unique(objects))
            for k in range(0, len(members) - count + 1, count)
        ]
        if groups:
            fused = np.array([fuse(posteriors[group], "product") for group in groups])
            true_codes = truth[[group[0] for group in groups]]
            right = metrics.accuracy(true_codes, fused.argmax(axis=1))
            ece = metrics.expected_calibration_error(true_codes, fused)
            result.append(Fused(count, len(groups), right, ece))
    return tuple(result)
