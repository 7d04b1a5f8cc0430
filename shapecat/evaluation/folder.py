"""Evaluation of a model, and optionally of baselines, on a labelled data set."""

import hashlib
from dataclasses import replace
from pathlib import Path

from shapecat.config import Settings
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import RecordingError
from shapecat.evaluation.baselines import compare_learners
from shapecat.evaluation.dataset import Dataset, read_dataset
from shapecat.evaluation.names import require_category_names
from shapecat.evaluation.report import Report, evaluate, require_categories
from shapecat.evaluation.views import describe_views
from shapecat.learning import load_model
from shapecat.system.progress import Observer, ignore, observed

__all__ = ["evaluate_folder"]


def evaluate_folder(
    root: Path,
    model: Path | None = None,
    *,
    baselines: Path | None = None,
    observe: Observer = ignore,
) -> Report:
    """Evaluate a model on a labelled data set.

    Parameters
    ----------
    root : folder of the data set.
    model : model file; the default model by default.
    baselines : folder of a data set on which shapecat's classifier and the baselines are trained,
        to be tested on ``root``. If it is ``root`` itself, they are cross-validated by instance.
        None for no baselines.

    Raises
    ------
    RecordingError : there are no views, one cannot be read, a folder has an invalid name, there are
        too few views to train or test on, or the training set of the baselines holds a view of
        ``root``.
    ModelError : the model is unusable, or does not know a category of the data set.
    """
    categorizer = load_model(model)
    categorizer.require_descriptor(DESCRIPTOR_NAMES)
    dataset = read_dataset(root)
    require_category_names(root, dataset.categories, categorizer.categories)
    require_categories(dataset.categories, categorizer)
    if baselines is not None and baselines.resolve() != root.resolve():
        _require_other_views(dataset, root, baselines)
    views = describe_views(
        observed(dataset, "evaluate", len(dataset), observe),
        settings=Settings(),
        with_functions=baselines is not None,
    )
    report = evaluate(views, categorizer)
    if baselines is None:
        return report
    if report.n == 0:
        msg = f"{root}: baselines need views with a category to be tested on"
        raise RecordingError(msg)
    train = None
    if baselines.resolve() != root.resolve():
        training_set = read_dataset(baselines)
        train = describe_views(
            observed(training_set, "train", len(training_set), observe),
            settings=Settings(),
            with_functions=True,
        )
    rows = compare_learners(
        views, train, categories=categorizer.categories, root=baselines, observe=observe
    )
    return replace(report, baselines=rows)


def _require_other_views(test: Dataset, root: Path, training_set: Path) -> None:
    """Check that no tested view is also in a training set, under whatever name.

    ``root`` is the folder of ``test``, ``training_set`` that of the training set.

    Raises
    ------
    RecordingError : a view is in both, or the training set has none.
    """
    sizes = {path.stat().st_size for path in test.files}
    files = read_dataset(training_set).files  # also those in linked folders
    others = {_digest(path): path for path in files if path.stat().st_size in sizes}
    for path in test.files:
        if other := others.get(_digest(path)):
            msg = f"{other}: is also in {root}; baselines must be tested on other objects"
            raise RecordingError(msg)


def _digest(path: Path) -> bytes:
    """Return a hash of the content of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").digest()
