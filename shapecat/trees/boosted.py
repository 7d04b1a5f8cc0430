"""Trees whose leaves add up to a logit, and their file."""

from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel
from shapecat.trees.walking import LANES, Trees, find_leaves

__all__ = ["BoostedTrees", "logit_of", "read_trees", "write_trees"]


class BoostedTrees(NamedTuple):
    """Trees whose leaves add up to a logit; ``value`` (n,) is what each adds."""

    trees: Trees
    value: F4


def read_trees(content: bytes) -> BoostedTrees:
    """Return the trees of a file that `write_trees` wrote."""
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return BoostedTrees(Trees(*(arrays[name] for name in Trees._fields)), arrays["value"])


def write_trees(path: Path, grown: BoostedTrees) -> None:
    """Write trees to a file."""
    np.savez_compressed(path, **grown.trees._asdict(), value=grown.value)


@kernel
def logit_of(grown: BoostedTrees, features: F4, hopeless: float) -> float:
    """Return the sum of the leaves that features (n,) reach, or the first that is below a bound."""
    (roots, feature, threshold, left), value = grown
    leaves, logit = np.zeros(LANES, np.int32), 0.0
    for first in range(0, roots.size, LANES):
        count = find_leaves(features, roots, feature, threshold, left, first, leaves)
        for lane in range(count):
            logit += value[leaves[lane]]
        if logit < hopeless:
            break
    return float(logit)
