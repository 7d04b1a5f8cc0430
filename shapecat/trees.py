"""Decision trees as flat arrays, and how they are walked: a few side by side."""

from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.jit import kernel

__all__ = [
    "LANES",
    "BoostedTrees",
    "Trees",
    "find_leaves",
    "logit_of",
    "read_trees",
    "write_trees",
]

LANES = 8
"""Trees that are walked at the same time: one waits for memory while the others go on."""


class Trees(NamedTuple):
    """Trees whose nodes stand behind each other, children behind their parents.

    Attributes
    ----------
    roots : (t,) first node of each tree.
    feature, threshold : (n,) what is described goes left where this feature is <= this.
    left : (n,) the left child, the right one stands behind it; 0 in leaves.
    """

    roots: I4
    feature: I4
    threshold: F4
    left: I4


@kernel
def find_leaves(
    x: F4, roots: I4, feature: I4, threshold: F4, left: I4, first: int, leaves: I4
) -> int:
    """Walk the next `Trees` with features x (f,), from ``first`` on; return how many these are.

    ``leaves`` (`LANES`,) are nodes, any to begin with; the leaves that are reached are written.
    The trees come as arrays: to take them from a tuple counts references, as long as a level takes.
    """
    count = min(LANES, roots.size - first)
    for lane in range(count):
        leaves[lane] = roots[first + lane]
    inner = True
    while inner:  # one level down in each tree
        inner = False
        for lane in range(LANES):
            node = np.uint32(leaves[lane])  # unsigned: it cannot count from the end
            child = left[node]
            right = x[np.uint16(feature[node])] > threshold[node]
            leaves[lane] = child + np.int32(right) if child > 0 else leaves[lane]
            inner |= child > 0
    return count


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
