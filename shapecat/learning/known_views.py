"""The views that a model stores as negative examples for new categories."""

import numpy as np

from shapecat.arrays import I4

__all__ = ["KNOWN_VIEWS", "choose_evenly"]

KNOWN_VIEWS = 3000
"""Maximum number of views that a model stores."""


def choose_evenly(codes: I4, count: int, rng: np.random.Generator) -> I4:
    """Return up to ``count`` indices of views, ascending, drawn evenly from all categories.

    Parameters
    ----------
    codes : (n,) index of the true logit of each view.
    """
    order = rng.permutation(len(codes))
    rank = np.zeros(len(order), np.int64)
    for code in np.unique(codes[order]):
        of_code = codes[order] == code
        rank[of_code] = np.arange(np.count_nonzero(of_code))
    return np.sort(order[np.argsort(rank, kind="stable")][:count])
