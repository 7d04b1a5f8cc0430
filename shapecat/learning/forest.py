"""A forest as flat arrays, and the leaves that a view reaches in it (thesis 7.3)."""

from functools import cached_property

import numpy as np

from shapecat.arrays import F4, I4, U2, U4, Record, array
from shapecat.jit import kernel
from shapecat.trees import LANES, Trees, find_leaves

__all__ = ["FlatForest", "apply"]


class FlatForest(Record):
    """Trees whose n nodes are stored one after the other, children after their parents.

    The id of a leaf is its number among the leaves, in the order of the nodes.

    Attributes
    ----------
    roots : (t,) index of the root of each tree.
    feature, threshold : (n,) a sample goes left if this feature is <= this threshold.
    left : (n,) index of the left child, 0 in leaves; the right child is ``left + 1``.

    Raises
    ------
    ValueError : there is no tree, or a child does not come after its parent, lies beyond the end,
        or has two parents.
    """

    roots: U4 = array("t", "u4")
    feature: U2 = array("n", "u2")
    threshold: F4 = array("n", "f4")
    left: U4 = array("n", "u4")

    def __post_init__(self) -> None:
        """Check that every path ends in a leaf."""
        super().__post_init__()
        left = self.left.astype(np.int64)
        inner = np.flatnonzero(left)
        reached = np.concatenate([self.roots.astype(np.int64), left[inner], left[inner] + 1])
        behind = bool(np.all(left[inner] > inner))
        if not (self.roots.size and behind and reached.max() < left.size):
            msg = "the trees are damaged: a child lies before its parent or beyond the end"
            raise ValueError(msg)
        if np.bincount(reached).max() > 1:
            msg = "the trees are damaged: two parents share a child"
            raise ValueError(msg)

    @cached_property
    def leaf_id(self) -> I4:
        """(n,) the id of each leaf; meaningless for inner nodes."""
        return (np.cumsum(self.left == 0) - 1).astype(np.int32)

    @property
    def leaf_count(self) -> int:
        """Number of leaves."""
        return int(np.count_nonzero(self.left == 0))

    @cached_property
    def parameters(self) -> tuple[Trees, I4]:
        """The trees and leaf ids for `apply`; small types keep a large forest in the CPU cache."""
        left = self.left.astype(np.int32)
        return Trees(self.roots, self.feature, self.threshold, left), self.leaf_id

    def apply(self, features: F4) -> I4:
        """Return the ids (v, t) of the leaves that views with features (v, f) reach in each tree.

        Raises
        ------
        ValueError : there are fewer features than the trees compare.
        """
        x = np.require(features, np.float32, ["C", "W"])  # one compiled version
        if x.shape[1] <= self.feature.max(initial=0):
            msg = f"the forest needs feature {self.feature.max()}, got {x.shape[1]} features"
            raise ValueError(msg)
        result = np.zeros((len(x), len(self.roots)), np.int64)
        for i, row in enumerate(x):
            apply(row, *self.parameters, result[i])
        return result


@kernel
def apply(x: F4, trees: Trees, leaf_id: I4, result: I4) -> None:
    """Write the id of the leaf that one view reaches in each tree into ``result`` (t,).

    ``x`` (f,) are the features of the view; ``trees`` and ``leaf_id`` (n,) are from
    `FlatForest.parameters`.
    """
    leaves, (roots, feature, threshold, left) = np.zeros(LANES, np.int32), trees
    for first in range(0, result.size, LANES):
        count = find_leaves(x, roots, feature, threshold, left, first, leaves)
        for lane in range(count):
            result[first + lane] = leaf_id[leaves[lane]]
