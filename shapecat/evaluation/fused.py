"""Scores of several fused views of one object (thesis 7.5.2)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.evaluation import metrics
from shapecat.tracking import fuse

__all__ = ["FUSED", "Fused", "fuse_views"]

FUSED = (3, 10, 30)
"""Numbers of views that are fused."""


class Fused(NamedTuple):
    """Scores of ``groups`` of ``views`` views each, by their fused posterior."""

    views: int
    groups: int
    accuracy: float
    ece: float


def fuse_views(
    truth: I4, posteriors: F4, objects: np.ndarray, *, counts: Sequence[int] = FUSED
) -> tuple[Fused, ...]:
    """Fuse the views of each object in groups, in their order.

    Views of one placement of an object err alike, so the product of their posteriors is tempered
    by their number, as tracks are fused by default: their plain product is far too sure of
    itself, their mean not sure enough.

    Parameters
    ----------
    truth : (n,) the true column of each view; posteriors : (n, c); objects : (n,) names.
    counts : views per group. What is left over of an object is not used.

    Returns
    -------
    One for each count that some object has enough views for.
    """
    result = []
    for count in counts:
        groups = [
            members[k : k + count]
            for members in (np.flatnonzero(objects == name) for name in np.unique(objects))
            for k in range(0, len(members) - count + 1, count)
        ]
        if groups:
            fused = np.array([fuse(posteriors[group], "product") for group in groups])
            own = truth[[group[0] for group in groups]]
            right = metrics.accuracy(own, fused.argmax(axis=1))
            ece = metrics.expected_calibration_error(own, fused)
            result.append(Fused(count, len(groups), right, ece))
    return tuple(result)
