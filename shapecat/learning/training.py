"""From descriptors and labels to a fitted `Categorizer`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from sklearn.pipeline import Pipeline

from shapecat.arrays import F4, I4
from shapecat.learning.calibration import fit_temperature
from shapecat.learning.categorizer import Categorizer
from shapecat.learning.dictionary import ForestDictionary, WordLearner
from shapecat.learning.novelty import LeafProximity
from shapecat.learning.pnn import ProbabilisticNeuralNetwork

__all__ = [
    "UNKNOWN",
    "Examples",
    "LearningSettings",
    "calibrate",
    "choose_evenly",
    "collapse",
    "encode",
    "fit_categorizer",
    "make_chain",
]

UNKNOWN = "unknown"
"""Label of shapes of no category: they grow the dictionary and judge novelty."""


@dataclass(frozen=True)
class LearningSettings:
    """How a model is learned. The defaults are those that measured best (see the model card)."""

    blocks: tuple[str, ...] = ()
    """Blocks of the descriptor that are used; all if empty."""
    kernels: int = 50
    """Parzen kernels per category in the probabilistic neural network; 0 leaves it out."""
    trees: int = 100
    """Trees of the dictionary: words per object."""
    min_leaf: int = 2
    """Training views a leaf needs."""
    strategy: Literal["multinomial", "one_vs_rest"] = "multinomial"
    """Learners on the words: against each other, or one versus the rest."""
    strength: float = 0.03
    """Inverse regularisation of the learners."""
    known_views: int = 1500
    """Known views kept in the model, for novelty and for learning new categories."""
    neighbours: int = 10
    """Nearest known views that novelty asks."""
    rejected: float = 0.05
    """Share of held-out views of known categories that the novelty threshold rejects."""
    jobs: int | None = None
    """Processes that grow trees at the same time."""


class Examples(NamedTuple):
    """Described views with their labels.

    ``descriptors`` (n, d); ``labels`` (n,) category names, or `UNKNOWN`; ``instances`` (n,) the
    physical object of each view: views of one instance never straddle training and testing.
    """

    descriptors: F4
    labels: np.ndarray
    instances: np.ndarray

    def where(self, chosen: np.ndarray) -> "Examples":
        """Return the chosen views: a mask or indices."""
        return Examples(*(values[chosen] for values in self))


def make_chain(blocks: Mapping[str, slice], settings: LearningSettings, *, seed: int) -> Pipeline:
    """Return the unfitted chain: densities, dictionary, learners.

    It is fitted to `encode`d labels: -1 is a shape of no category.
    """
    names = settings.blocks or tuple(blocks)
    used = {name: (blocks[name].start, blocks[name].stop) for name in names}
    densities = ProbabilisticNeuralNetwork(
        used, kernels=settings.kernels, unknown=-1, random_state=seed
    )
    dictionary = ForestDictionary(
        trees=settings.trees, min_leaf=settings.min_leaf, jobs=settings.jobs, random_state=seed
    )
    learner = WordLearner(strategy=settings.strategy, C=settings.strength, unknown=-1)
    return Pipeline([("densities", densities), ("dictionary", dictionary), ("learner", learner)])


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
    """Learn a model.

    Parameters
    ----------
    train : the views to learn from.
    held_out : views of other instances; they fit the temperature and the novelty threshold.
    blocks : where each block of the descriptor is.
    categories : the order of the posterior.

    Raises
    ------
    ValueError : fewer than two categories, or a category without training views.
    """
    settings = settings or LearningSettings()
    missing = sorted(set(categories) - set(train.labels.tolist()))
    if missing:
        msg = f"no training views of {', '.join(missing)}"
        raise ValueError(msg)
    chain = make_chain(blocks, settings, seed=seed)
    chain.fit(train.descriptors, encode(train.labels, categories))
    categorizer = collapse(
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
    """Return the settings that decide the model; the number of jobs does not."""
    return {name: value for name, value in asdict(settings).items() if name != "jobs"}


def collapse(
    chain: Pipeline,
    train: Examples,
    *,
    descriptor_names: Sequence[str],
    categories: Sequence[str],
    settings: LearningSettings,
    seed: int,
    notes: Mapping[str, Any],
) -> Categorizer:
    """Turn a chain, fitted to `encode`d labels, into plain arrays: votes per leaf."""
    bank, forest = chain["densities"].bank_, chain["dictionary"].forest_
    learner = chain["learner"]
    codes = encode(train.labels, categories)
    chosen = choose_evenly(codes, settings.known_views, np.random.default_rng(seed))
    known = train.descriptors[chosen]
    words = forest.fall(bank.features(known))
    return Categorizer(
        categories=tuple(categories),
        descriptor_names=tuple(descriptor_names),
        bank=bank,
        forest=forest,
        votes=learner.coef_.T,
        linear=np.zeros((len(categories), bank.width)),
        bias=learner.intercept_,
        temperature=float(learner.temperature_),
        known=LeafProximity.of(words, vocabulary=forest.words, neighbours=settings.neighbours),
        known_descriptors=bank.standardise(known),
        known_category=codes[chosen],
        notes=notes,
    )


def choose_evenly(codes: I4, count: int, rng: np.random.Generator) -> I4:
    """Return at most ``count`` indices of views with a code >= 0, evenly over the codes."""
    order = rng.permutation(len(codes))
    order = order[codes[order] >= 0]
    rank = np.zeros(len(order), np.int64)
    for code in np.unique(codes[order]):
        mine = codes[order] == code
        rank[mine] = np.arange(np.count_nonzero(mine))
    return np.sort(order[np.argsort(rank, kind="stable")][:count])


def calibrate(categorizer: Categorizer, held_out: Examples, *, rejected: float) -> Categorizer:
    """Fit temperature and novelty threshold on views of instances the learners never saw.

    Views labelled `UNKNOWN` are left out. Without any view left the model stays as it is.
    """
    codes = encode(held_out.labels, categorizer.categories)
    views, codes = held_out.descriptors[codes >= 0], codes[codes >= 0]
    if codes.size == 0:
        return categorizer
    plain = replace(
        categorizer, temperature=1.0, known=replace(categorizer.known, threshold=1.0)
    ).predict(views)
    logits = np.log(np.maximum(plain.posteriors.astype(np.float64), 1e-30))
    threshold = float(np.quantile(plain.novelty, 1.0 - rejected))
    return replace(
        categorizer,
        temperature=fit_temperature(logits, codes),
        known=replace(categorizer.known, threshold=max(threshold, 1e-3)),
    )


def encode(labels: np.ndarray, categories: Sequence[str]) -> I4:
    """Return the column of each label, -1 for one that is not among the categories."""
    column = {name: k for k, name in enumerate(categories)}
    return np.array([column.get(str(label), -1) for label in labels], np.int64)
