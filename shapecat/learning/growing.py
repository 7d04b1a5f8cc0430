"""More trees for a fitted model, grown on new views."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from shapecat.arrays import F4
from shapecat.learning.categorizer import Categorizer
from shapecat.learning.forest import FlatForest
from shapecat.learning.training import Examples, LearningSettings, choose_evenly, encode

__all__ = ["grow_on", "widened"]

_CONSTANT = 1e-6
"""A component with a smaller standard deviation counts as constant."""


def widened(
    categorizer: Categorizer,
    train: Examples,
    *,
    descriptor_names: Sequence[str],
    blocks: Mapping[str, slice],
    used: Sequence[str],
) -> Categorizer:
    """Add the components of descriptor blocks that a model lacks; no prediction changes.

    Parameters
    ----------
    train : views whose statistics standardise the new components.
    descriptor_names : names of all components of the current descriptor.
    blocks : range of each block in the descriptor, by name.
    used : names of the blocks that the model should have.

    Raises
    ------
    ValueError : the current descriptor lacks a component of the model.
    """
    place = {name: k for k, name in enumerate(descriptor_names)}
    lost = [name for name in categorizer.descriptor_names if name not in place]
    if lost:
        msg = f"the descriptor lacks {', '.join(lost[:3])}"
        raise ValueError(msg)
    old = [place[categorizer.descriptor_names[k]] for k in categorizer.bank.columns]
    chosen = {k for name in used for k in range(blocks[name].start, blocks[name].stop)}
    new = sorted(chosen - set(old))
    values = train.descriptors[:, new].astype(np.float64)
    scale = values.std(axis=0)
    inverse = np.divide(1.0, scale, where=scale > _CONSTANT, out=np.zeros_like(scale))
    bank = categorizer.bank
    more = (0, len(new))
    return replace(
        categorizer,
        descriptor_names=tuple(descriptor_names),
        bank=replace(
            bank,
            columns=np.array([*old, *new]),
            mean=np.concatenate([bank.mean, values.mean(axis=0)]),
            inverse_scale=np.concatenate([bank.inverse_scale, inverse]),
            kernels=np.pad(bank.kernels, ((0, 0), more)),
        ),
        linear=np.pad(categorizer.linear, ((0, 0), more)),
        known_descriptors=np.pad(categorizer.known_descriptors, ((0, 0), more)),
    )


def grow_on(
    categorizer: Categorizer, train: Examples, *, settings: LearningSettings, seed: int
) -> Categorizer:
    """Grow more trees on the residuals of a model; its own trees stay unchanged.

    Parameters
    ----------
    train : views of the model's categories, and of unknown shapes.
    settings : rounds, leaves, rate and jobs of the trees to grow.

    Returns
    -------
    A model whose temperature and threshold still have to be fitted.

    Raises
    ------
    ValueError : the model has no logit for unknown shapes, or has Parzen kernels.
    """
    if not categorizer.knows_unknown or len(categorizer.bank.kernels):
        msg = "more trees need a model without Parzen kernels, trained with unknown shapes"
        raise ValueError(msg)
    count = len(categorizer.categories)
    labels = encode(train.labels, categorizer.categories)
    features = categorizer.bank.features(train.descriptors)
    more = settings.dictionary(seed).fit(features, labels, start=_logits(categorizer, features))
    rng, half = np.random.default_rng(seed), settings.known_views // 2
    codes = np.where(labels < 0, count, labels)
    kept = choose_evenly(categorizer.known_category.astype(np.int64), half, rng)
    added = choose_evenly(codes, half, rng)
    seen = features[added, : categorizer.bank.mean.size]
    return replace(
        categorizer,
        forest=_joined(categorizer.forest, more.forest_),
        votes=np.concatenate([categorizer.votes, more.votes_]),
        temperature=1.0,
        threshold=0.0,
        known_descriptors=np.concatenate([categorizer.known_descriptors[kept], seen]),
        known_category=np.concatenate([categorizer.known_category[kept], codes[added]]),
    )


def _logits(categorizer: Categorizer, features: F4) -> F4:
    """Return the logits (n, k) of features (n, f), computed a thousand views at a time."""
    found = [
        categorizer.votes[categorizer.forest.apply(part)].sum(axis=1, dtype=np.float32)
        for part in np.array_split(features, len(features) // 1000 + 1)
    ]
    return np.asarray(np.concatenate(found) + categorizer.bias, np.float32)


def _joined(first: FlatForest, second: FlatForest) -> FlatForest:
    """Concatenate two forests."""
    base = first.left.size
    left = second.left.astype(np.int64)
    return FlatForest(
        np.concatenate([first.roots, second.roots.astype(np.int64) + base]),
        np.concatenate([first.feature, second.feature]),
        np.concatenate([first.threshold, second.threshold]),
        np.concatenate([first.left, np.where(left > 0, left + base, 0)]),
    )
