"""Training: from descriptors and labels to a fitted `Categorizer`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.learning.boosted import grow_ensemble
from shapecat.learning.calibration import can_calibrate, fit_temperature
from shapecat.learning.categorizer import Categorizer
from shapecat.learning.features import fit_standardisation
from shapecat.learning.known_views import KNOWN_VIEWS, choose_evenly

__all__ = [
    "Examples",
    "LearningSettings",
    "calibrate",
    "encode",
    "fit_categorizer",
    "fit_threshold",
]


@dataclass(frozen=True)
class LearningSettings:
    """Settings for training a model."""

    rounds: int = 500
    """Boosting rounds; each grows one tree per category."""
    leaves: int = 16
    """Maximum number of leaves of a tree."""
    rate: float = 0.06
    """Learning rate of the boosting."""
    known_views: int = KNOWN_VIEWS
    """Maximum number of views stored in the model as negative examples for new categories."""
    rejected: float = 0.05
    """Fraction of held-out views of known categories that the novelty threshold rejects."""
    jobs: int = 1
    """Number of trees grown at the same time."""


class Examples(NamedTuple):
    """Described views with their labels.

    Attributes
    ----------
    descriptors : (n, d).
    labels : (n,) category names, or `UNKNOWN`.
    instances : (n,) name of the physical object that each view shows; all views of an instance are
        used either for training or for testing.
    """

    descriptors: F4
    labels: np.ndarray
    instances: np.ndarray

    def where(self, chosen: np.ndarray) -> "Examples":
        """Return the chosen views; ``chosen`` is a mask (n,) or indices."""
        return Examples(*(values[chosen] for values in self))


def fit_categorizer(
    train: Examples,
    held_out: Examples,
    *,
    descriptor_names: Sequence[str],
    categories: Sequence[str],
    settings: LearningSettings,
    seed: int = 0,
) -> Categorizer:
    """Train and calibrate a model.

    Parameters
    ----------
    train : training views; those whose label is not a category are learned as unknown shapes.
    held_out : views of other instances, for fitting the temperature and the novelty threshold.
    descriptor_names : names of the components of the descriptor.
    categories : the categories in the order of the posterior.

    Raises
    ------
    ValueError : there are fewer than two categories, or one has no training views.
    """
    missing = sorted(set(categories) - set(train.labels.tolist()))
    if missing:
        msg = f"no training views of {', '.join(missing)}"
        raise ValueError(msg)
    if len(categories) < 2:
        msg = f"a classifier needs at least 2 categories, got {len(categories)}"
        raise ValueError(msg)
    codes = encode(train.labels, categories)
    codes[codes < 0] = len(categories)  # the column of unknown shapes
    standardisation = fit_standardisation(train.descriptors)
    rng = np.random.default_rng(seed)
    ensemble = grow_ensemble(
        standardisation.standardise(train.descriptors),
        codes,
        rounds=settings.rounds,
        leaves=settings.leaves,
        rate=settings.rate,
        jobs=settings.jobs,
        rng=rng,
    )
    chosen = choose_evenly(codes, settings.known_views, rng)
    categorizer = Categorizer(
        categories=tuple(categories),
        descriptor_names=tuple(descriptor_names),
        standardisation=standardisation,
        forest=ensemble.forest,
        leaf_values=ensemble.leaf_values,
        linear=np.zeros((ensemble.bias.size, standardisation.mean.size)),
        bias=ensemble.bias,
        temperature=1.0,
        threshold=0.0,
        known_descriptors=standardisation.standardise(train.descriptors[chosen]),
        known_category=codes[chosen],
        notes={"seed": seed, "learning": _notes_of(settings)},
    )
    return calibrate(categorizer, held_out, rejected=settings.rejected)


def _notes_of(settings: LearningSettings) -> dict[str, Any]:
    """Return the settings that affect the model: all except the number of jobs."""
    return {name: value for name, value in asdict(settings).items() if name != "jobs"}


def calibrate(categorizer: Categorizer, held_out: Examples, *, rejected: float) -> Categorizer:
    """Fit the temperature and the novelty threshold on held-out views.

    The temperature becomes 1 if fewer than half of the categories have held-out views.

    Parameters
    ----------
    held_out : views of instances that training has not seen. Views whose label is not a category of
        the model are ignored; if no views remain, the model is returned unchanged.
    rejected : fraction of the views that the novelty threshold rejects.
    """
    codes = encode(held_out.labels, categorizer.categories)
    labelled = codes >= 0
    views, codes = held_out.descriptors[labelled], codes[labelled]
    if codes.size == 0:
        return categorizer
    fitted = replace(categorizer, temperature=1.0)
    if can_calibrate(held_out.labels.tolist(), categorizer.categories):
        posteriors = fitted.predict(views).posteriors.astype(np.float64)
        objects = np.unique(held_out.instances[labelled]).size
        temperature = fit_temperature(np.log(np.maximum(posteriors, 1e-30)), codes, objects)
        fitted = replace(fitted, temperature=temperature)
    return fit_threshold(fitted, held_out, rejected=rejected)


def fit_threshold(categorizer: Categorizer, held_out: Examples, *, rejected: float) -> Categorizer:
    """Set the novelty threshold so that it rejects a given fraction of the held-out views.

    The parameters are as for `calibrate`; the temperature does not change.
    """
    views = held_out.descriptors[encode(held_out.labels, categorizer.categories) >= 0]
    if not len(views):
        return categorizer
    doubt = replace(categorizer, threshold=0.0).predict(views).novelty.astype(np.float64) / 2
    limit = np.clip(np.quantile(doubt, 1.0 - rejected), 1e-6, 1 - 1e-6)
    return replace(categorizer, threshold=float(np.log(limit / (1 - limit))))


def encode(labels: np.ndarray, categories: Sequence[str]) -> I4:
    """Return the index (n,) of each label in ``categories``, -1 for other labels."""
    column = {name: k for k, name in enumerate(categories)}
    return np.array([column.get(str(label), -1) for label in labels], np.int64)
