"""Decision trees for kernels, and boosted trees whose leaf values add up to one logit."""

from shapecat.trees.boosted import BoostedTrees, logit_of, read_trees, write_trees
from shapecat.trees.walking import LANES, Trees, find_leaves

__all__ = [
    "LANES",
    "BoostedTrees",
    "Trees",
    "find_leaves",
    "logit_of",
    "read_trees",
    "write_trees",
]
