"""Merging of low-profile objects: the segments of one are known by its outline."""

import numpy as np

from shapecat.arrays import I4, Bool
from shapecat.detection.merging.segments import Segments, merge
from shapecat.jit import kernel

__all__ = ["merge_low_profile"]

RAISED = 0.5
"""Share of the cells of a segment that belong to one low object."""


@kernel
def merge_low_profile(segments: Segments, low_profile: I4, labels: I4, spans: I4) -> Bool:
    """Join the segments of each low object that is known by its outline; return which they are.

    Parameters
    ----------
    low_profile : (rows, columns) the numbers of the low objects, from `find_low_profile`.
    spans : where there are ``labels``, as in `SurfaceGraph`.

    Returns
    -------
    (n + 1,) whether most of a segment is low and known to be an object.
    """
    known = np.zeros(segments.parent.size, np.bool_)
    n = segments.parent.size
    overlap = np.zeros((n, np.max(low_profile) + 1), np.int32)
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            if low_profile[i, j] > 0:
                overlap[labels[i, j], low_profile[i, j]] += 1
    leader = np.zeros(overlap.shape[1], np.int32)
    for p in range(1, n):
        best = np.argmax(overlap[p])
        if overlap[p, best] <= RAISED * segments.statistics[p].count:
            continue
        if leader[best] == 0:
            leader[best] = p
            known[p] = True
        else:
            merge(segments, int(leader[best]), p)
    return known
