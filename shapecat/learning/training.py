"""From descriptors and labels to a fitted `Categorizer`."""

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
    "collapse",
    "encode",
    "fit_categorizer",
    "fit_threshold",
    "make_chain",
]


@dataclass(frozen=True)
class LearningSettings:
    """Settings of the training. The defaults measured best (see the model card)."""

    blocks: tuple[str, ...] = ()
    """Blocks of the descriptor that are used; all if empty."""
    kernels: int = 0
    """Parzen kernels per category in the probabilistic neural network; 0 leaves it out."""
    rounds: int = 500
    """Rounds in which the dictionary grows one tree per category."""
    leaves: int = 16
    """Words of a tree, at most."""
    rate: float = 0.06
    """Share of what is lacking that a tree corrects."""
    known_views: int = 3000
    """Views kept in the model, to learn new categories against."""
    rejected: float = 0.05
    """Share of held-out views of known categories that the novelty threshold rejects."""
    jobs: int | None = None
    """Trees grown at the same time."""

    def dictionary(self, seed: int) -> BoostedDictionary:
        """Return the dictionary to fit; -1 is the label of shapes of no category."""
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
    """Return the unfitted chain: densities, then the dictionary with its learners.

    It is fitted to `encode`d labels: -1 is a shape of no category.
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
    """Return at most ``count`` ascending indices of views with a code >= 0, evenly over the codes.

    ``codes`` is (n,).
    """
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
    plain = replace(categorizer, temperature=1.0).predict(views)
    logits = np.log(np.maximum(plain.posteriors.astype(np.float64), 1e-30))
    fitted = replace(categorizer, temperature=fit_temperature(logits, codes))
    return fit_threshold(fitted, held_out, rejected=rejected)


def fit_threshold(categorizer: Categorizer, held_out: Examples, *, rejected: float) -> Categorizer:
    """Choose the novelty threshold that rejects this share of held-out views of known categories.

    Views labelled `UNKNOWN` are left out. Without any view left the model stays as it is.
    """
    views = held_out.descriptors[encode(held_out.labels, categorizer.categories) >= 0]
    if not len(views):
        return categorizer
    doubt = replace(categorizer, threshold=0.0).predict(views).novelty.astype(np.float64) / 2
    limit = np.clip(np.quantile(doubt, 1.0 - rejected), 1e-6, 1 - 1e-6)
    return replace(categorizer, threshold=float(np.log(limit / (1 - limit))))


def encode(labels: np.ndarray, categories: Sequence[str]) -> I4:
    """Return the column (n,) of each label, -1 for one that is not among the categories."""
    column = {name: k for k, name in enumerate(categories)}
    return np.array([column.get(str(label), -1) for label in labels], np.int64)
