"""The fitted model, from descriptor to posterior and novelty (thesis ch. 7)."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, U1, Record, array
from shapecat.errors import ModelError
from shapecat.jit import kernel
from shapecat.learning.features import Standardisation
from shapecat.learning.forest import FlatForest, apply
from shapecat.types import UNKNOWN

__all__ = ["MOST_CATEGORIES", "Categorizer", "Prediction", "parts_of"]

MOST_CATEGORIES = 254
"""Maximum number of categories of a model."""

_LARGEST = 1e6
"""Maximum magnitude of a model's weights: real ones are far smaller, and sums stay finite."""


class Prediction(NamedTuple):
    """Predictions for n objects.

    Attributes
    ----------
    posteriors : (n, c) in the order of the model's categories; each row sums to 1.
    novelty : (n,) from 0, a familiar shape, to 2; above 1 the shape is unknown.
    """

    posteriors: F4
    novelty: F4


class Categorizer(Record):
    """A fitted model, which turns descriptors into posteriors and novelty.

    Attributes
    ----------
    categories : names of the columns of the posterior.
    descriptor_names : names of the descriptor's components, in order.
    standardisation : turns a descriptor into features.
    forest : the boosted trees.
    leaf_values : (l, k) the value that each leaf adds to each logit. k is c, the number of
        categories, or c + 1 if the model was trained with unknown shapes, whose logit comes last.
    linear : (k, f) weights of the features in the logits; nonzero only for added categories.
    bias : (k,) constants of the logits.
    temperature : posteriors are ``softmax(logits / temperature)``.
    threshold : log odds of being unknown above which a shape is *unknown*.
    known_descriptors : (v, d) standardised descriptors of some training views, which are the
        negative examples for new categories.
    known_category : (v,) index of the true logit of each of these views.
    notes : origin of the model and its training settings; plain JSON values.

    Raises
    ------
    ValueError : the parts are inconsistent.
    """

    categories: tuple[str, ...]
    descriptor_names: tuple[str, ...]
    standardisation: Standardisation
    forest: FlatForest
    leaf_values: F4 = array("l k", "f2")
    linear: F4 = array("k f", "f4")
    bias: F8 = array("k", "f8")
    temperature: float
    threshold: float
    known_descriptors: F4 = array("v d", "f2")
    known_category: U1 = array("v", "u1")
    notes: Mapping[str, Any]

    def __post_init__(self) -> None:
        """Check that the parts are consistent."""
        super().__post_init__()
        sizes = {
            "descriptor": len(self.descriptor_names) == self.standardisation.mean.size,
            "categories": self.bias.size - len(self.categories) in {0, 1},
            "category names": len(set(self.categories)) == len(self.categories)
            and 0 < len(self.categories) <= MOST_CATEGORIES
            and all(name and name.isprintable() and name != UNKNOWN for name in self.categories),
            "leaves": self.forest.leaf_count == len(self.leaf_values),
            "features": self.linear.shape[1]
            == self.standardisation.mean.size
            > self.forest.feature.max(initial=0),
            "known views": self.known_descriptors.shape[1] == self.standardisation.mean.size
            and bool(np.all(self.known_category < self.bias.size)),
            "numbers": all(
                bool(np.all(np.abs(values.astype(np.float64)) <= _LARGEST))
                for values in (self.leaf_values, self.linear, self.bias, self.known_descriptors)
            )
            and 1e-3 <= self.temperature <= 1e3
            and abs(self.threshold) <= _LARGEST,
        }
        wrong = [name for name, fits in sizes.items() if not fits]
        if wrong:
            msg = f"parts of the model do not fit together: {', '.join(wrong)}"
            raise ValueError(msg)

    @cached_property
    def model_id(self) -> str:
        """A hash of the whole model; models with equal ids give equal predictions."""
        digest = hashlib.sha256()
        for name, value in sorted(parts_of(self).items()):
            digest.update(name.encode())
            if isinstance(value, np.ndarray):
                digest.update(f"{value.dtype.str}{value.shape}".encode())
                digest.update(np.ascontiguousarray(value).tobytes())
            else:
                digest.update(json.dumps(value, sort_keys=True).encode())
        return digest.hexdigest()[:16]

    @property
    def knows_unknown(self) -> bool:
        """Whether the model has a logit for unknown shapes."""
        return self.bias.size > len(self.categories)

    def require_descriptor(self, names: Sequence[str]) -> None:
        """Check that descriptors have the components that this model was trained on.

        Raises
        ------
        ModelError : the names or their order differ.
        """
        if tuple(names) != self.descriptor_names:
            msg = (
                f"model {self.model_id} was trained on a different descriptor "
                f"({len(self.descriptor_names)} components, this version computes {len(names)}); "
                "train it again with this version"
            )
            raise ModelError(msg)

    def predict(self, descriptors: F4) -> Prediction:
        """Return the posteriors and the novelty of descriptors (n, d), in about 0.1 ms each.

        Raises
        ------
        ValueError : the number of components is wrong, or a component is not finite.
        """
        x = np.ascontiguousarray(descriptors, np.float32)
        if x.ndim != 2 or x.shape[1] != len(self.descriptor_names):
            msg = f"expected descriptors of shape (n, {len(self.descriptor_names)}), got {x.shape}"
            raise ValueError(msg)
        if not np.all(np.isfinite(x)):
            msg = "descriptors must be finite"
            raise ValueError(msg)
        posteriors = np.zeros((len(x), len(self.categories)), np.float32)
        novelty = np.zeros(len(x), np.float32)
        _predict(self.standardisation.standardise(x), *self._parameters, posteriors, novelty)
        return Prediction(posteriors, novelty)

    @cached_property
    def _parameters(self) -> tuple[Any, ...]:
        return (
            self.forest.parameters,
            np.ascontiguousarray(self.leaf_values, np.float32),
            self.linear,
            bool(np.any(self.linear)),
            self.bias,
            float(self.temperature),
            float(self.threshold),
        )


def parts_of(record: Record, prefix: str = "") -> dict[str, Any]:
    """Return the arrays and plain values of a record and of nested records, by dotted name.

    Each name begins with ``prefix``.
    """
    parts: dict[str, Any] = {}
    for item in fields(record):  # type: ignore[arg-type]  # every Record is a dataclass
        value = getattr(record, item.name)
        name = f"{prefix}{item.name}"
        parts |= parts_of(value, f"{name}.") if isinstance(value, Record) else {name: value}
    return parts


@kernel
def _predict(
    features: F4,
    forest: Any,
    leaf_values: F4,
    linear: F4,
    use_linear: bool,  # noqa: FBT001  compiled kernels take their arguments by position
    bias: F8,
    temperature: float,
    threshold: float,
    posteriors: F4,
    novelty: F4,
) -> None:
    """Write posteriors (n, c) and novelty (n,) of standardised descriptors ``features`` (n, f).

    ``forest`` is `FlatForest.parameters`; ``use_linear`` is False if ``linear`` is all 0. The other
    parameters are as in `Categorizer`.
    """
    trees, leaf_id = forest
    categories = posteriors.shape[1]
    reached = np.zeros(trees.roots.size, np.int64)
    logits = np.zeros(bias.size)
    for i in range(features.shape[0]):
        # (1) The leaf of each tree.
        apply(features[i], trees, leaf_id, reached)
        # (2) Logits of the categories.
        for c in range(bias.size):
            logits[c] = bias[c]
        for leaf in reached:
            for c in range(bias.size):
                logits[c] += leaf_values[leaf, c]
        if use_linear:
            for c in range(bias.size):
                for j in range(linear.shape[1]):
                    logits[c] += linear[c, j] * features[i, j]
        best = -np.inf
        for c in range(bias.size):
            logits[c] /= temperature
            if c < categories:
                best = max(best, logits[c])
        total = 0.0
        for c in range(categories):
            total += np.exp(logits[c] - best)
        for c in range(categories):
            posteriors[i, c] = np.exp(logits[c] - best) / total
        # (3) Novelty: the odds of *unknown*; without its logit, of any category but the best.
        if bias.size > categories:
            odds = logits[categories] - best - np.log(total)
        else:
            odds = np.log(max(total - 1.0, 1e-30))
        novelty[i] = 2.0 / (1.0 + np.exp(min(threshold - odds, 80.0)))
