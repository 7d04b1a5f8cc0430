"""Training: from descriptors and labels to a fitted `Categorizer`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from sklearn.pipeline import Pipeline

from shapecat.arrays import F4, I4
from shapecat.learning.boosted import BoostedDictionary
from shapecat.learning.calibration import fit_temperature
from shapecat.learning.categorizer import Categorizer
from shapecat.learning.pnn import ProbabilisticNeuralNetwork

__all__ = [
    "Examples",
    "LearningSettings",
    "calibrate",
    "choose_evenly",
    "encode",
    "fit_categorizer",
    "fit_threshold",
    "make_chain",
]


@dataclass(frozen=True)
class LearningSettings:
    """Settings of the training."""

    blocks: tuple[str, ...] = ()
    """Blocks of the descriptor to use; all if empty."""
    kernels: int = 0
    """Parzen kernels per category in the probabilistic neural network; 0 leaves it out."""
    rounds: int = 500
    """Boosting rounds; each grows one tree per category."""
    leaves: int = 16
    """Maximum number of leaves (words) of a tree."""
    rate: float = 0.06
    """Learning rate of the boosting."""
    known_views: int = 3000
    """Views stored in the model as negative examples for new categories."""
    rejected: float = 0.05
    """Fraction of held-out views of known categories that the novelty threshold rejects."""
    jobs: int | None = None
    """Number of trees grown at the same time."""

    def dictionary(self, seed: int) -> BoostedDictionary:
        """Return the unfitted dictionary; -1 is the label of unknown shapes."""
        return BoostedDictionary(
            rounds=self.rounds,
            leaves=self.leaves,
            rate=self.rate,
            unknown=-1,
            jobs=self.jobs,
            random_state=seed,
        )


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


def make_chain(blocks: Mapping[str, slice], settings: LearningSettings, *, seed: int) -> Pipeline:
    """Return the unfitted pipeline: features with densities, then the boosted dictionary.

    It expects labels from `encode`, in which -1 is an unknown shape. ``blocks`` is the range of
    each block in the descriptor, by name.
    """
    names = settings.blocks or tuple(blocks)
    used = {name: (blocks[name].start, blocks[name].stop) for name in names}
    densities = ProbabilisticNeuralNetwork(
        used, kernels=settings.kernels, unknown=-1, random_state=seed
    )
    dictionary = settings.dictionary(seed)
    return Pipeline([("densities", densities), ("dictionary", dictionary)])


def fit_categorizer(
    train: Examples,
    held_out: Examples,
    *,
    descriptor_names: Sequence[str],
    blocks: Mapping[str, slice],
    categories: Sequence[str],
    settings: LearningSettings | None = None,
    seed: int = 0,
    notes: Mapping[str, Any] | None = None,
) -> Categorizer:
    """Train and calibrate a model.

    Parameters
    ----------
    train : training views.
    held_out : views of other instances, which fit the temperature and the novelty threshold.
    descriptor_names : names of the components of the descriptor.
    blocks : range of each block in the descriptor, by name.
    categories : the categories in the order of the posterior.
    notes : plain JSON values to store in the model.

    Raises
    ------
    ValueError : there are fewer than two categories, or one has no training views.
    """
    settings = settings or LearningSettings()
    missing = sorted(set(categories) - set(train.labels.tolist()))
    if missing:
        msg = f"no training views of {', '.join(missing)}"
        raise ValueError(msg)
    chain = make_chain(blocks, settings, seed=seed)
    chain.fit(train.descriptors, encode(train.labels, categories))
    categorizer = _collapse(
        chain,
        train,
        descriptor_names=descriptor_names,
        categories=categories,
        settings=settings,
        seed=seed,
        notes={"seed": seed, "learning": _notes_of(settings), **(notes or {})},
    )
    return calibrate(categorizer, held_out, rejected=settings.rejected)


def _notes_of(settings: LearningSettings) -> dict[str, Any]:
    """Return the settings that affect the model: all except the number of jobs."""
    return {name: value for name, value in asdict(settings).items() if name != "jobs"}


def _collapse(
    chain: Pipeline,
    train: Examples,
    *,
    descriptor_names: Sequence[str],
    categories: Sequence[str],
    settings: LearningSettings,
    seed: int,
    notes: Mapping[str, Any],
) -> Categorizer:
    """Return a fitted pipeline from `make_chain` as a `Categorizer`, not yet calibrated.

    Parameters
    ----------
    train : the training views, some of which are stored in the model.
    """
    bank, dictionary = chain["densities"].bank_, chain["dictionary"]
    columns = dictionary.bias_.size
    codes = encode(train.labels, categories)
    codes = np.where((codes < 0) & (columns > len(categories)), len(categories), codes)
    chosen = choose_evenly(codes, settings.known_views, np.random.default_rng(seed))
    return Categorizer(
        categories=tuple(categories),
        descriptor_names=tuple(descriptor_names),
        bank=bank,
        forest=dictionary.forest_,
        votes=dictionary.votes_,
        linear=np.zeros((columns, bank.width)),
        bias=dictionary.bias_,
        temperature=1.0,
        threshold=0.0,
        known_descriptors=bank.standardise(train.descriptors[chosen]),
        known_category=codes[chosen],
        notes=notes,
    )


def choose_evenly(codes: I4, count: int, rng: np.random.Generator) -> I4:
    """Return up to ``count`` indices of views, ascending, drawn evenly from all categories.

    Parameters
    ----------
    codes : (n,) category of each view; views with a negative code are left out.
    """
    order = rng.permutation(len(codes))
    order = order[codes[order] >= 0]
    rank = np.zeros(len(order), np.int64)
    for code in np.unique(codes[order]):
        mine = codes[order] == code
        rank[mine] = np.arange(np.count_nonzero(mine))
    return np.sort(order[np.argsort(rank, kind="stable")][:count])


def calibrate(categorizer: Categorizer, held_out: Examples, *, rejected: float) -> Categorizer:
    """Fit the temperature and the novelty threshold on held-out views.

    Parameters
    ----------
    held_out : views of instances that training has not seen. Views whose label is not a category of
        the model are ignored; if none remain, the model is returned unchanged.
    rejected : fraction of the views that the novelty threshold rejects.
    """
    codes = encode(held_out.labels, categorizer.categories)
    views, codes = held_out.descriptors[codes >= 0], codes[codes >= 0]
    if codes.size == 0:
        return categorizer
    plain = replace(categorizer, temperature=1.0).predict(views)
    logits = np.log(np.maximum(plain.posteriors.astype(np.float64), 1e-30))
    fitted = replace(categorizer, temperature=fit_temperature(logits, codes))
    return fit_threshold(fitted, held_out, rejected=rejected)


def fit_threshold(categorizer: Categorizer, held_out: Examples, *, rejected: float) -> Categorizer:
    """Set the novelty threshold so that it rejects a given fraction of the held-out views.

    The parameters are as for `calibrate`.
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
