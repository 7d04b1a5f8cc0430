"""Comparison of shapecat's classifier with baselines on the same views."""

import warnings
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.description import BLOCKS
from shapecat.errors import RecordingError
from shapecat.evaluation import metrics
from shapecat.evaluation.report import Compared
from shapecat.evaluation.training import fit_views
from shapecat.evaluation.views import DescribedViews
from shapecat.system.progress import Observer, ignore, observed
from shapecat.types import UNKNOWN

__all__ = ["compare_learners"]

_FOLDS = 5


_Learner = Callable[[DescribedViews, DescribedViews, tuple[str, ...]], F8]
"""Returns the posteriors (n, c) of test views, given training views, test views and categories."""


def compare_learners(
    test: DescribedViews,
    train: DescribedViews | None,
    *,
    categories: tuple[str, ...],
    root: Path,
    observe: Observer = ignore,
) -> tuple[Compared, ...]:
    """Train shapecat's classifier and the baselines on the same views, and test all on ``test``.

    Parameters
    ----------
    test : test views; those labelled ``unknown`` are left out.
    train : training views. If None, use ``test`` in cross-validation by instance, in up to 5 folds.
    categories : all possible labels except *unknown*. All views of a category without training
        views count as wrong.
    root : folder of the data set, which error messages name.

    Returns
    -------
    Results of shapecat's classifier, of those in `shapecat.evaluation.baseline_classifiers`, and of
    two forests on shape distributions: on D2, and on D2, D3 and A3 together.

    Raises
    ------
    RecordingError : there are fewer than two categories, or, for cross-validation, a category with
        only one instance.
    """
    if train is None and (ones := ", ".join(_single(test))):
        msg = f"{root}: cross-validation needs two objects of each category; with one only: {ones}"
        raise RecordingError(msg)
    splits = list(_folds(test)) if train is None else [(train, test)]
    if any(len(_known(part.labels)) < 2 for part, _ in splits):
        msg = f"{root}: training needs at least two categories"
        raise RecordingError(msg)
    learners = _learners()
    rows = []
    for name, (learner, learns_unknown) in observed(
        learners.items(), "baselines", len(learners), observe
    ):
        truth, posteriors = _predict_all(learner, splits, categories)
        learned = _mean_views(splits, with_unknown=learns_unknown)
        rows.append(_compared(name, learned, truth, posteriors))
    return tuple(rows)


def _folds(views: DescribedViews) -> Iterator[tuple[DescribedViews, DescribedViews]]:
    """Yield training and test views of each fold; all views of an instance are on one side."""
    from sklearn.model_selection import StratifiedGroupKFold  # noqa: PLC0415  only needed here

    fewest = min(_instances(views).values())
    folds = StratifiedGroupKFold(min(_FOLDS, fewest), shuffle=True, random_state=0)
    with warnings.catch_warnings():  # there may be fewer unknown shapes than folds
        warnings.simplefilter("ignore", UserWarning)
        splits = list(folds.split(views.descriptors, views.labels, views.instances))
    for train, test in splits:
        yield views.where(train), views.where(test)


def _mean_views(splits: list[tuple[DescribedViews, DescribedViews]], *, with_unknown: bool) -> int:
    """Return the mean number of training views of a split, with or without unknown shapes."""
    counts = [np.sum(with_unknown | (train.labels != UNKNOWN)) for train, _ in splits]
    return round(float(np.mean(counts)))


def _single(views: DescribedViews) -> list[str]:
    """Return the categories with only one instance."""
    return [name for name, count in _instances(views).items() if count == 1]


def _instances(views: DescribedViews) -> dict[str, int]:
    """Return the number of instances of each category."""
    return {
        name: np.unique(views.instances[views.labels == name]).size for name in _known(views.labels)
    }


def _known(labels: np.ndarray) -> list[str]:
    return sorted(set(labels.tolist()) - {UNKNOWN})


def _predict_all(
    learner: _Learner,
    splits: list[tuple[DescribedViews, DescribedViews]],
    categories: tuple[str, ...],
) -> tuple[I4, F8]:
    """Return the indices of the true categories (n,) and the posteriors (n, c) of all test views.

    ``splits`` are training and test views, from `_folds`.
    """
    truths, posteriors = [], []
    for train, test in splits:
        known = test.where(test.labels != UNKNOWN)
        truths.append([categories.index(label) for label in known.labels.tolist()])
        posteriors.append(learner(train, known, categories))
    return np.concatenate(truths).astype(np.int64), np.concatenate(posteriors)


def _compared(name: str, learned: int, truth: I4, posteriors: F8) -> Compared:
    """Return the metrics of a classifier that was trained on ``learned`` views.

    ``truth`` and ``posteriors`` are from `_predict_all`.
    """
    predicted = posteriors.argmax(axis=1)
    table = metrics.confusion(truth, predicted, posteriors.shape[1])
    figures = (
        metrics.accuracy(truth, predicted),
        metrics.balanced_accuracy(table),
        metrics.expected_calibration_error(truth, posteriors),
    )
    return Compared(name, learned, *(None if np.isnan(value) else value for value in figures))


def _learners() -> dict[str, tuple[_Learner, bool]]:
    """Return the learners by name, each with whether it learns unknown shapes, too."""
    from shapecat.evaluation.baseline_classifiers import make_baselines  # noqa: PLC0415  scikit-learn

    makers = make_baselines(tuple(BLOCKS.values()))
    descriptors, functions = attrgetter("descriptors"), attrgetter("functions")
    baselines = {name: _make_learner(make, descriptors) for name, make in makers.items()}
    baselines["forest on D2"] = _make_learner(makers["forest"], _d2)
    baselines["forest on D2, D3, A3 (ESF-like)"] = _make_learner(makers["forest"], functions)
    return {
        "shapecat": (_learn_shapecat, True),
        **{name: (learner, False) for name, learner in baselines.items()},
    }


def _learn_shapecat(train: DescribedViews, test: DescribedViews, categories: tuple[str, ...]) -> F8:
    """Train shapecat's classifier, also on unknown shapes; return the posteriors of ``test``."""
    model = fit_views(train, train.where(np.zeros(0, np.int64)), seed=0)
    return _in_order(model.predict(test.descriptors).posteriors, model.categories, categories)


def _make_learner(make: Callable[[], Any], features: Callable[[DescribedViews], F4]) -> _Learner:
    """Return a learner that trains a scikit-learn classifier, without the unknown shapes.

    ``make`` returns the untrained classifier; ``features`` returns its inputs (n, f) for views.
    """

    def learn(train: DescribedViews, test: DescribedViews, categories: tuple[str, ...]) -> F8:
        known = train.where(train.labels != UNKNOWN)
        fitted = make().fit(features(known), known.labels)
        return _in_order(fitted.predict_proba(features(test)), fitted.classes_, categories)

    return learn


def _in_order(posteriors: F4, found: Any, categories: tuple[str, ...]) -> F8:
    """Return posteriors with their columns in the order of ``categories``.

    ``found`` are the categories of the given columns; the posterior of any other is 0.
    """
    names = [str(name) for name in found]
    result = np.zeros((len(posteriors), len(categories)))
    for column, name in enumerate(categories):
        if name in names:
            result[:, column] = posteriors[:, names.index(name)]
    return result


def _d2(views: DescribedViews) -> F4:
    """Return the histograms (n, d) of point distances (D2), the first third of ``functions``."""
    return views.functions[:, : views.functions.shape[1] // 3]
