"""Learned merging: boosted trees tell whether two adjacent segments are of one object.

Relations between surface patches, learned: Richtsfeld et al. 2012, 2014; the trees are grown on
simulated scenes.

A bottle and its neck, a plate and its foot, a cup and its handle, the halves of a toy: many weak
features together tell them from what only touches or stands on it, and no few of them do.
"""

from functools import cache
from importlib.resources import files
from io import BytesIO
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    are_adjacent,
    pair_features,
)
from shapecat.detection.merging.segments import Records, Segments, merge
from shapecat.jit import kernel

__all__ = ["FILE", "BoostedTrees", "load_trees", "logit_of", "merge_learned"]

FILE = "parts.npz"
LIKELY = 0.3
"""Logit, of 0.57, from which on two segments are taken for parts of one object: a wrong join loses
two objects, a missing one seldom one."""
HOPELESS = -4.0
"""Logit of the first trees that the others never made up for; half of the pairs end so early."""
LANES = 8
"""Trees that are walked at the same time: one waits for memory while the others go on."""


class BoostedTrees(NamedTuple):
    """Boosted trees, whose leaves add up to the logit that two segments are parts of one object.

    Attributes
    ----------
    roots : (t,) first node of each tree.
    feature, threshold : (m,) a pair goes left where this feature is <= this.
    left : (m,) the left child, the right one stands behind it; 0 in leaves.
    value : (m,) what a leaf adds.
    """

    roots: I4
    feature: I4
    threshold: F4
    left: I4
    value: F4


@cache
def load_trees() -> BoostedTrees:
    """Return the trees that belong to this version."""
    content = files("shapecat.detection.merging").joinpath(FILE).read_bytes()
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return BoostedTrees(*(arrays[name] for name in BoostedTrees._fields))


def merge_learned(segments: Segments, view_geometry: ViewGeometry, grown: BoostedTrees) -> None:
    """Merge segments that are likely parts of one object, the likeliest first."""
    named = np.zeros(1, PAIR_FEATURES)
    _merge(segments, view_geometry, grown, named, named.view(np.float32))


@kernel
def _merge(
    segments: Segments,
    view_geometry: ViewGeometry,
    grown: BoostedTrees,
    named: Records,
    features: F4,
) -> None:
    """Do what `merge_learned` does; ``named`` and ``features`` are room, the same one."""
    n = segments.parent.size
    logits = np.full((n, n), -np.inf)
    for p in range(1, n):
        for q in range(p + 1, n):
            if are_adjacent(segments, p, q):
                pair_features(segments, p, q, view_geometry, named[0])
                logits[p, q] = logit_of(grown, features)
    while True:
        best = np.argmax(logits)
        p, q = int(best // n), int(best % n)
        if logits[p, q] < LIKELY:
            return
        merge(segments, p, q)
        for k in range(1, n):
            logits[q, k] = logits[k, q] = logits[k, p] = logits[p, k] = -np.inf
            if are_adjacent(segments, p, k):
                pair_features(segments, p, k, view_geometry, named[0])
                logits[min(p, k), max(p, k)] = logit_of(grown, features)


@kernel
def logit_of(grown: BoostedTrees, features: F4) -> float:
    """Return the logit that a pair with these features (n,) is of one object."""
    roots, value = grown.roots, grown.value
    feature, threshold, children = grown.feature, grown.threshold, grown.left
    nodes = np.zeros(LANES, np.int32)
    logit = 0.0
    for first in range(0, roots.size, LANES):
        lanes = min(LANES, roots.size - first)
        for lane in range(lanes):
            nodes[lane] = roots[first + lane]
        inner = True
        while inner:  # one level down in each tree
            inner = False
            for lane in range(LANES):
                node = np.uint32(nodes[lane])  # unsigned: it cannot count from the end
                left = children[node]
                right = features[np.uint16(feature[node])] > threshold[node]
                nodes[lane] = left + np.int32(right) if left > 0 else nodes[lane]
                inner |= left > 0
        for lane in range(lanes):
            logit += value[nodes[lane]]
            if logit < HOPELESS:
                return float(logit)
    return float(logit)
