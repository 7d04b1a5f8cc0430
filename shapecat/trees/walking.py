"""Decision trees as flat arrays, and how they are walked: a few side by side."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.jit import kernel

__all__ = ["LANES", "Trees", "find_leaves"]

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
