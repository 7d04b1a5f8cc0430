"""Learned merging: boosted trees decide whether two adjacent segments are one object.

Source: Richtsfeld et al. 2012, 2014 (learned relations between surface patches). The trees are
trained on simulated scenes.

Many weak features together distinguish a bottle and its neck, a plate and its foot, a cup and its
handle, or the halves of a toy from two objects that touch or are stacked. A few features do not.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from shapecat.arrays import F8, Records
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    find_adjacent,
    write_pair_features,
)
from shapecat.detection.merging.segment_features import SEGMENT_FEATURES, write_segment_features
from shapecat.detection.merging.segments import Segments, merge
from shapecat.detection.merging.settings import MERGING
from shapecat.jit import kernel
from shapecat.trees import BoostedTrees, logit_of, read_trees

__all__ = ["FILE", "load_trees", "merge_learned"]

FILE = "parts.npz"
"""Name of the file of the trees, in this package."""


@cache
def load_trees() -> BoostedTrees:
    """Load shapecat's trees for merging segments."""
    return read_trees(
        files("shapecat.detection.merging").joinpath(FILE).read_bytes(), PAIR_FEATURES
    )


@kernel
def merge_learned(segments: Segments, view_geometry: ViewGeometry, ensemble: BoostedTrees) -> None:
    """Merge segments that are probably one object, in place, the most probable pair first."""
    n = segments.parent.size
    logits, features = np.full((n, n), -np.inf), np.zeros(n, SEGMENT_FEATURES)
    pair = np.zeros(1, PAIR_FEATURES)
    for p in range(1, n):
        write_segment_features(segments, p, features[p])
    for p in range(1, n):
        _rate(segments, features, p, p + 1, view_geometry, ensemble, pair, logits)
    while True:
        best = np.argmax(logits)
        p, q = int(best // n), int(best % n)
        if logits[p, q] < MERGING.merge_logit:
            return
        merge(segments, p, q)
        write_segment_features(segments, p, features[p])  # only these have changed
        for k in range(n):
            logits[q, k] = logits[k, q] = -np.inf
        _rate(segments, features, p, 1, view_geometry, ensemble, pair, logits)


@kernel(inner=True)
def _rate(
    segments: Segments,
    features: Records,
    p: int,
    first: int,
    view_geometry: ViewGeometry,
    ensemble: BoostedTrees,
    pair: Records,
    logits: F8,
) -> None:
    """Write the log-odds that ``p`` belongs to the same object as each segment from ``first`` to n.

    In ``logits`` (n + 1, n + 1), for n segments, the row is the smaller of the two segment numbers;
    the logit is -inf if the two are not adjacent. ``features`` are as in `write_pair_features`;
    ``pair`` (1,) is work space for the features of a pair.
    """
    adjacent, values = find_adjacent(segments, p, view_geometry), pair.view(np.float32)
    for q in range(first, adjacent.size):
        low, high = min(p, q), max(p, q)
        logits[low, high] = -np.inf
        if adjacent[q]:
            write_pair_features(segments, features, low, high, view_geometry, pair[0])
            logits[low, high] = logit_of(ensemble, values, MERGING.stop_logit, np.inf)
