"""Learned merging: boosted trees tell whether two adjacent segments are of one object.

Relations between surface patches, learned: Richtsfeld et al. 2012, 2014; the trees are grown on
simulated scenes.

A bottle and its neck, a plate and its foot, a cup and its handle, the halves of a toy: many weak
features together tell them from what only touches or stands on it, and no few of them do.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from shapecat.arrays import F4
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    are_adjacent,
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
    changed = np.ones(n, np.bool_)  # what has to be asked for
    while True:
        for p in range(1, n):
            for q in range(p + 1, n):
                if not (changed[p] or changed[q]):
                    continue
                logits[p, q] = -np.inf
                if are_adjacent(segments, p, q):
                    pair_features(segments, p, q, view_geometry, named[0])
                    logits[p, q] = logit_of(grown, features, MERGING.hopeless)
        best = np.argmax(logits)
        p, q = int(best // n), int(best % n)
        if logits[p, q] < MERGING.likely:
            return
        merge(segments, p, q)
        changed[:] = False
        changed[p] = changed[q] = True
