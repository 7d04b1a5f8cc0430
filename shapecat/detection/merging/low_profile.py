"""Merge the segments of each low-profile object that `find_low_profile` found."""

import numpy as np

from shapecat.arrays import I4, Bool
from shapecat.detection.merging.segments import Segments, merge
from shapecat.detection.merging.settings import MERGING
from shapecat.jit import kernel

__all__ = ["merge_low_profile"]


def merge_low_profile(segments: Segments, low_profile: I4, labels: I4, spans: I4) -> Bool:
    """Merge the segments of each low-profile object.

    Parameters
    ----------
    segments : changed in place.
    low_profile : (rows, columns) the numbers of the objects, from `find_low_profile`.
    labels : (rows, columns) the segments.
    spans : (rows, 2) as in `SurfaceGraph`.

    Returns
    -------
    (n + 1,) bool, True for the representative of each low-profile object: the segment that its
    other segments are merged into.
    """
    known = np.zeros(segments.parent.size, np.bool_)
    count = int(low_profile.max(initial=0))
    if count == 0:
        return known
    overlap = np.zeros((known.size, count + 1), np.int32)
    _count_overlap(low_profile, labels, spans, overlap)
    most = overlap.max(axis=1) > MERGING.low_share * segments.statistics["count"]
    leader: dict[int, int] = {}
    for p in np.flatnonzero(most[1:]) + 1:
        first = leader.setdefault(int(overlap[p].argmax()), int(p))
        if first == p:
            known[p] = True
        else:
            merge(segments, first, int(p))
    return known


@kernel
def _count_overlap(low_profile: I4, labels: I4, spans: I4, overlap: I4) -> None:
    """Count the cells that each segment shares with each low-profile object."""
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            if low_profile[i, j] > 0:
                overlap[labels[i, j], low_profile[i, j]] += 1
