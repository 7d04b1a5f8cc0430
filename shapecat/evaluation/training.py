"""Training on a labelled data set: a whole model, or new categories for an existing one."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.arrays import Bool
from shapecat.config import Settings
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import ModelError, RecordingError
from shapecat.evaluation.dataset import read_dataset
from shapecat.evaluation.names import require_category_names
from shapecat.evaluation.report import evaluate
from shapecat.evaluation.views import DescribedViews, describe_views
from shapecat.learning import Categorizer, load_model, save_model
from shapecat.learning.calibration import can_calibrate
from shapecat.learning.categorizer import MOST_CATEGORIES
from shapecat.learning.incremental import add_categories
from shapecat.learning.training import Examples, LearningSettings, fit_categorizer
from shapecat.runs.labels.meaning import order_categories
from shapecat.system.progress import Observer, ignore, observed
from shapecat.types import UNKNOWN

__all__ = [
    "fit_views",
    "learn_on_folder",
    "split_instances",
    "train_on_folder",
]

_HELD_OUT = 0.2
"""Fraction of the instances of each category that are held out."""


def train_on_folder(
    root: Path, out: Path, *, seed: int = 0, observe: Observer = ignore
) -> dict[str, Any]:
    """Train a model on a data set and write it.

    A first model is trained on four fifths of the instances of each category. The remaining fifth
    is used to evaluate it and to fit its temperature and novelty threshold. The written model is
    trained on all views, with this temperature and threshold.

    Returns
    -------
    Plain values: ``views`` and ``skipped`` (number of views used, and of those with too few points
    for a surface), ``lost`` (folders of categories without a usable view), ``off_support``
    (categories whose objects, in most views, do not stand at z = 0), ``categories``, ``model`` (its
    id), ``calibrated`` (whether enough instances were held out to fit the temperature), and
    ``held_out`` (the report on these instances).

    Raises
    ------
    RecordingError : there are no views, one cannot be read, a folder has an invalid name, there
        are fewer than two categories, or too few views to tell them apart.
    ModelError : there are too many categories.
    OutputError : the model cannot be written.
    """
    views, lost = _describe_folder(root, seed, observe)
    categories = order_categories(views.labels)
    if len(categories) < 2:
        found = ", ".join(categories) or "none"
        msg = f"{root}: a model needs at least two categories with usable views, found: {found}"
        raise RecordingError(msg)
    held_out = split_instances(views.labels, views.instances, np.random.default_rng(seed))
    validation = views.where(held_out)
    first = fit_views(views.where(~held_out), validation, seed=seed)
    report = evaluate(validation, first)
    model = replace(
        fit_views(views, views.where(held_out & False), seed=seed),
        temperature=first.temperature,
    )
    if not model.forest.left.any():
        msg = (
            f"{root}: {len(views.labels)} views are too few to tell {', '.join(categories)} apart; "
            "add views of more objects"
        )
        raise RecordingError(msg)
    model = replace(model, threshold=first.threshold)
    save_model(out, model)
    calibrated = can_calibrate(validation.labels.tolist(), categories)
    return _summary(views, lost, model) | {"calibrated": calibrated, "held_out": report.as_dict()}


def learn_on_folder(
    model: Path | None, root: Path, out: Path, *, seed: int = 0, observe: Observer = ignore
) -> dict[str, Any]:
    """Add the new categories of a data set to a model and write the result.

    The trees and the classifiers of the old categories do not change.

    Parameters
    ----------
    model : model file; None for the default model.

    Returns
    -------
    Plain values as for `train_on_folder`, with ``added`` (the new categories), but without
    ``calibrated`` and ``held_out``.

    Raises
    ------
    RecordingError : there are no views, one cannot be read, a folder has an invalid name, or no
        view of a new category has enough points.
    ModelError : the model is unusable, or there is no new category, or there are too many.
    OutputError : the result cannot be written.
    """
    categorizer = load_model(model)
    categorizer.require_descriptor(DESCRIPTOR_NAMES)
    views, lost = _describe_folder(root, seed, observe, categorizer.categories)
    views = views.where(views.labels != UNKNOWN)
    if not set(views.labels.tolist()) - set(categorizer.categories):
        if new := [name for name in lost if name not in {UNKNOWN, *categorizer.categories}]:
            msg = (
                f"{root}: no view of {', '.join(new)} with enough points for a surface; views are "
                f"files such as {new[0]}/object/000.pcd (or .ply, .npz)"
            )
            raise RecordingError(msg)
        msg = (
            f"{root}: model {categorizer.model_id} already knows all its categories; "
            "`shapecat train` trains a new model"
        )
        raise ModelError(msg)
    learned = add_categories(
        categorizer, views.descriptors, views.labels.tolist(), rng=np.random.default_rng(seed)
    )
    save_model(out, learned)
    added = learned.categories[len(categorizer.categories) :]
    return _summary(views, lost, learned) | {"added": list(added)}


def fit_views(
    train: DescribedViews, held_out: DescribedViews, *, seed: int, **choices: Any
) -> Categorizer:
    """Train a model on described views, and calibrate it on the ``held_out`` ones, if any.

    ``choices`` are fields of `LearningSettings`.

    Raises
    ------
    ValueError : there are fewer than two categories.
    """
    return fit_categorizer(
        Examples(train.descriptors, train.labels, train.instances),
        Examples(held_out.descriptors, held_out.labels, held_out.instances),
        descriptor_names=DESCRIPTOR_NAMES,
        categories=order_categories(train.labels),
        settings=LearningSettings(**choices),
        seed=seed,
    )


def split_instances(labels: np.ndarray, instances: np.ndarray, rng: np.random.Generator) -> Bool:
    """Return the mask (n,) of views to hold out: all views of a fifth of each label's instances.

    At least one instance of each label is held out and at least one is kept; a label with a single
    instance keeps it. ``labels`` and ``instances`` (n,) are as in `DescribedViews`.
    """
    held_out = np.zeros(len(labels), bool)
    for label in np.unique(labels):
        names = np.unique(instances[labels == label])
        count = min(max(round(_HELD_OUT * names.size), 1), names.size - 1)
        held_out |= np.isin(instances, rng.permutation(names)[:count])
    return held_out


def _describe_folder(
    root: Path, seed: int, observe: Observer, known: tuple[str, ...] = ()
) -> tuple[DescribedViews, list[str]]:
    """Describe a data set from which a model with the ``known`` categories will learn.

    Return the described views, and the sorted names of the category folders without any. Raise
    `ModelError` if there are too many categories.
    """
    dataset = read_dataset(root)
    require_category_names(root, dataset.categories, known)
    count = len({*known, *dataset.categories} - {UNKNOWN})
    if count > MOST_CATEGORIES:
        msg = f"{root}: a model can have {MOST_CATEGORIES} categories, not {count}"
        raise ModelError(msg)
    settings = replace(Settings(), seed=seed)
    views = describe_views(observed(dataset, "train", len(dataset), observe), settings=settings)
    folders = {*dataset.categories, *dataset.without_views}
    return views, sorted(folders - set(views.labels.tolist()))


def _summary(views: DescribedViews, lost: list[str], model: Categorizer) -> dict[str, Any]:
    return {
        "views": len(views.labels),
        "skipped": views.skipped,
        "lost": lost,
        "off_support": list(views.off_support),
        "categories": list(model.categories),
        "model": model.model_id,
    }
