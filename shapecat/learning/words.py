"""Bags of words: the leaves that a view reaches in the trees, as a sparse row."""

import numpy as np
from scipy import sparse

from shapecat.arrays import I4

__all__ = ["bag_of_words"]


def bag_of_words(words: I4, vocabulary: int) -> sparse.csr_array:
    """Return sparse rows (n, vocabulary), one per view: 1 at its words (n, t), 0 elsewhere."""
    views, trees = words.shape
    starts = np.arange(views + 1, dtype=np.int32) * trees
    columns = words.reshape(-1).astype(np.int32)
    return sparse.csr_array((np.ones(words.size), columns, starts), shape=(views, vocabulary))
