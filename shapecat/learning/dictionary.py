"""A random forest as a dictionary, and linear classifiers on its words (thesis 7.3, 7.4)."""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.utils.validation import check_is_fitted, validate_data

from shapecat.arrays import F8, I4
from shapecat.learning.calibration import softmax
from shapecat.learning.forest import flatten
from shapecat.learning.pnn import known_labels
from shapecat.learning.tree_dictionary import TreeDictionary

__all__ = ["ForestDictionary", "WordLearner"]


@dataclass(kw_only=True, eq=False, repr=False)
class ForestDictionary(TreeDictionary):
    """A random forest as a dictionary: the leaf that a view reaches in each tree is a word.

    Parameters
    ----------
    trees : number of trees, and thus of words per view.
    min_leaf : minimum number of training views in a leaf.
    jobs : number of trees grown at the same time; it does not affect the result.
    random_state : seed of the forest.

    Attributes
    ----------
    forest_ : the `FlatForest`.

    Source: thesis 7.3; Moosmann et al. 2006 for forests as codebooks.
    """

    trees: int = 100
    min_leaf: int = 2
    jobs: int | None = None
    random_state: int | None = None

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Grow the forest on features X (n, f) and labels y (n,); unknown shapes are included."""
        x, y = validate_data(self, X, y, dtype=np.float32)
        forest = RandomForestClassifier(
            self.trees,
            min_samples_leaf=self.min_leaf,
            class_weight="balanced",
            n_jobs=self.jobs,
            random_state=self.random_state,
        )
        forest.fit(x, y)
        self.forest_ = flatten([tree.tree_ for tree in forest.estimators_])
        return self


@dataclass(kw_only=True, eq=False, repr=False)
class WordLearner(ClassifierMixin, BaseEstimator):  # type: ignore[misc]  # sklearn is untyped
    """Logistic regression on the words of a view.

    Parameters
    ----------
    strategy : ``"multinomial"`` learns all categories together, ``"one_vs_rest"`` one classifier
        per category, as in the thesis.
    C : inverse strength of the regularisation.
    unknown : label of views to leave out; None if there are none.

    Attributes
    ----------
    classes_ : the categories, without ``unknown``.
    coef_ : (c, words) the value that each word adds to each logit, rounded to half precision.
    intercept_ : (c,) constants of the logits.
    temperature_ : divisor of the logits; 1 until calibrated.
    """

    strategy: Literal["multinomial", "one_vs_rest"] = "multinomial"
    C: float = 0.01
    unknown: Any = None

    def fit(self, X: Any, y: ArrayLike) -> Self:
        """Fit to words X (n, words), zeros and ones, dense or sparse, and labels y (n,)."""
        x, y = validate_data(self, X, y, dtype=np.float64, accept_sparse="csr")
        self.classes_, labels = known_labels(y, self.unknown)
        x, labels = x[labels >= 0], labels[labels >= 0]
        coef, self.intercept_ = self._fit_logits(x, labels)
        self.coef_ = coef.astype(np.float16).astype(np.float64)
        self.temperature_ = 1.0
        return self

    def decision_function(self, X: Any) -> F8:
        """Return the logits (n, c); for two categories, their difference (n,)."""
        logits = self.logits(X)
        return logits[:, 1] - logits[:, 0] if len(self.classes_) == 2 else logits

    def logits(self, X: Any) -> F8:
        """Return the logits (n, c) of words X (n, words)."""
        check_is_fitted(self)
        x = validate_data(self, X, dtype=np.float64, accept_sparse="csr", reset=False)
        return np.asarray(x @ self.coef_.T) + self.intercept_

    def predict_proba(self, X: Any) -> F8:
        """Return the posteriors (n, c) of words X (n, words)."""
        logits = self.logits(X)
        return softmax(logits / self.temperature_)

    def predict(self, X: Any) -> Any:
        """Return the most probable label (n,) of each view, from words X (n, words)."""
        logits = self.logits(X)
        return self.classes_[logits.argmax(axis=1)]

    def _fit_logits(self, x: Any, labels: I4) -> tuple[F8, F8]:
        """Return coefficients (c, w) and intercepts (c,)."""
        _require_strategy(self.strategy)
        if self.strategy == "multinomial":
            model = _linear(self.C).fit(x, labels)
            coef, intercept = model.coef_, model.intercept_
            if len(coef) == 1:  # two categories share one column
                coef, intercept = (
                    np.concatenate([-coef, coef]) / 2,
                    np.array([-1, 1]) / 2 * intercept,
                )
            return coef, intercept
        models = [_linear(self.C).fit(x, labels == c) for c in range(labels.max() + 1)]
        return (
            np.concatenate([model.coef_ for model in models]),
            np.concatenate([model.intercept_ for model in models]),
        )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.sparse = True
        return tags


def _require_strategy(name: str) -> None:
    if name not in {"multinomial", "one_vs_rest"}:
        msg = f"strategy must be multinomial or one_vs_rest, got {name!r}"
        raise ValueError(msg)


def _linear(strength: float) -> LogisticRegression:
    return LogisticRegression(C=strength, class_weight="balanced", max_iter=1000, tol=1e-4)
