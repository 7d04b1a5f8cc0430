"""Boosted decision trees, and their file."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel
from shapecat.trees.walking import LANES, Trees, find_leaves

__all__ = ["BoostedTrees", "logit_of", "read_trees", "write_trees"]


class BoostedTrees(NamedTuple):
    """Trees whose leaf values add up to a logit; ``value`` (n,) holds the value of each node."""

    trees: Trees
    value: F4


def read_trees(content: bytes, features: np.dtype[Any]) -> BoostedTrees:
    """Return the trees in the content of a file that `write_trees` wrote.

    Parameters
    ----------
    features : structured type of the features; the trees refer to its fields, nested ones
        included, by index.

    Raises
    ------
    ValueError : the trees were trained with other features, or with these in another order.
    """
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        if arrays["names"].tolist() != list(_names(features)):
            msg = "the trees were grown with other features than these: run `make parts`"
            raise ValueError(msg)
        return BoostedTrees(Trees(*(arrays[name] for name in Trees._fields)), arrays["value"])


def write_trees(path: Path, ensemble: BoostedTrees, features: np.dtype[Any]) -> None:
    """Write trees to a file, with the names of their ``features``, nested as ``outer.inner``."""
    names = np.array(list(_names(features)))
    np.savez_compressed(path, **ensemble.trees._asdict(), value=ensemble.value, names=names)


def _names(features: np.dtype[Any]) -> Iterator[str]:
    for name in features.names or ():
        field = features[name]
        yield from (f"{name}.{inner}" for inner in _names(field)) if field.names else (name,)


@kernel
def logit_of(ensemble: BoostedTrees, features: F4, lower: float, upper: float) -> float:
    """Return the logit of features (f,): the sum of the values of the leaves they reach.

    If the sum after a multiple of `LANES` trees is below ``lower`` or above ``upper``, it is
    returned early.
    """
    (roots, feature, threshold, left), value = ensemble
    leaves, logit = np.zeros(LANES, np.int32), 0.0
    for first in range(0, roots.size, LANES):
        count = find_leaves(features, roots, feature, threshold, left, first, leaves)
        for lane in range(count):
            logit += value[leaves[lane]]
        if not lower <= logit <= upper:
            break
    return float(logit)
