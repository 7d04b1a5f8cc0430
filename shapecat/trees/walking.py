"""Decision trees as flat arrays, walked several at a time."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.jit import kernel

__all__ = ["LANES", "Trees", "find_leaves"]

LANES = 8
"""Number of trees walked at the same time: while one waits for memory, the others go on."""


class Trees(NamedTuple):
    """Trees whose n nodes are stored one after the other, children after their parents.

    Attributes
    ----------
    roots : (t,) index of the root of each tree.
    feature, threshold : (n,) a sample goes left if this feature is <= this threshold.
    left : (n,) index of the left child, 0 in leaves; the right child is ``left + 1``.
    """

    roots: I4
    feature: I4
    threshold: F4
    left: I4


@kernel(inline=True)
def find_leaves(
    x: F4, roots: I4, feature: I4, threshold: F4, left: I4, first: int, leaves: I4
) -> int:
    """Find the leaves that a sample reaches in up to `LANES` trees; return the number of trees.

    The arrays of `Trees` are passed one by one: unpacking the tuple counts references, which takes
    as long as one level of the trees.

    Parameters
    ----------
    x : (f,) features of the sample.
    roots, feature, threshold, left : as in `Trees`.
    first : number of the first tree, from 0.
    leaves : (`LANES`,) valid node indices, overwritten with the leaf reached in each tree.
    """
    count = min(LANES, roots.size - first)
    for lane in range(count):
        leaves[lane] = roots[first + lane]
    inner = True
    while inner:  # one level down in each tree
        inner = False
        for lane in range(LANES):
            node = np.uint32(leaves[lane])  # unsigned: no check for negative indices
            child = left[node]
            right = x[np.uint16(feature[node])] > threshold[node]
            leaves[lane] = child + np.int32(right) if child > 0 else leaves[lane]
            inner |= child > 0
    return count
