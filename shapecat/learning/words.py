"""Words of views as sparse rows, for the learners."""

import numpy as np
from scipy import sparse

from shapecat.arrays import I4

__all__ = ["bag_of_words"]


def bag_of_words(words: I4, vocabulary: int) -> sparse.csr_array:
    """Return words (n, t) as rows of zeros and ones (n, vocabulary)."""
    views, trees = words.shape
    starts = np.arange(views + 1) * trees
    ones = np.ones(words.size)
    return sparse.csr_array((ones, words.reshape(-1), starts), shape=(views, vocabulary))
