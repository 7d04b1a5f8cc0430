"""Learned merging: boosted trees tell whether two adjacent segments are of one object.

Relations between surface patches, learned: Richtsfeld et al. 2012, 2014; the trees are grown on
simulated scenes.

A bottle and its neck, a plate and its foot, a cup and its handle, the halves of a toy: many weak
features together tell them from what only touches or stands on it, and no few of them do.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    find_adjacent,
    pair_features,
)
from shapecat.detection.merging.segments import Records, Segments, merge
from shapecat.detection.merging.settings import MERGING
from shapecat.jit import kernel
from shapecat.trees import BoostedTrees, logit_of, read_trees

__all__ = ["FILE", "load_trees", "merge_learned"]

FILE = "parts.npz"


@cache
def load_trees() -> BoostedTrees:
    """Return the trees that belong to this version."""
    return read_trees(files("shapecat.detection.merging").joinpath(FILE).read_bytes())


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
    """Do what `merge_learned` does; ``named`` and ``features`` are scratch, the same one."""
    n = segments.parent.size
    logits = np.full((n, n), -np.inf)
    for p in range(1, n):
        _rate(segments, p, p + 1, view_geometry, grown, named, features, logits)
    while True:
        best = np.argmax(logits)
        p, q = int(best // n), int(best % n)
        if logits[p, q] < MERGING.likely:
            return
        merge(segments, p, q)
        for k in range(n):
            logits[q, k] = logits[k, q] = -np.inf
        _rate(segments, p, 1, view_geometry, grown, named, features, logits)


@kernel
def _rate(
    segments: Segments,
    p: int,
    first: int,
    view_geometry: ViewGeometry,
    grown: BoostedTrees,
    named: Records,
    features: F4,
    logits: F8,
) -> None:
    """Write the logits of a segment with the others from ``first`` on, the lower one first."""
    adjacent = find_adjacent(segments, p)
    for q in range(first, adjacent.size):
        low, high = min(p, q), max(p, q)
        logits[low, high] = -np.inf
        if adjacent[q]:
            pair_features(segments, low, high, view_geometry, named[0])
            logits[low, high] = logit_of(grown, features, MERGING.hopeless)
