"""Base class of the tree dictionaries, as scikit-learn transformers for training."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from shapecat.arrays import I4
from shapecat.learning.forest import FlatForest
from shapecat.learning.words import bag_of_words

__all__ = ["TreeDictionary"]


class TreeDictionary(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # sklearn is untyped
    """A forest as a dictionary: the leaf that a view reaches in each tree is a word (thesis 7.3).

    Attributes
    ----------
    forest_ : the `FlatForest` of all trees, set by fitting.
    """

    forest_: FlatForest

    def words(self, X: ArrayLike) -> I4:
        """Return the words (n, trees) of features X (n, f): the leaf reached in each tree."""
        check_is_fitted(self)
        return self.forest_.apply(validate_data(self, X, dtype=np.float32, reset=False))

    def transform(self, X: ArrayLike) -> sparse.csr_array:
        """Return the sparse bags of words (n, words), zeros and ones, of features X (n, f)."""
        words = self.words(X)  # first, as this checks that the dictionary is fitted
        return bag_of_words(words, self.forest_.words)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []
        tags.target_tags.required = True
        return tags
