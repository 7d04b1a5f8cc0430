"""Merging that needs no learning: of small segments, and of those of one low-profile object."""

import numpy as np

from shapecat.arrays import I4, Bool
from shapecat.detection.depth_grid import DepthGrid, smallest_object_at
from shapecat.detection.merging.segments import CONTACT, COUNT, Segments, depths_of, is_root, merge
from shapecat.jit import kernel

__all__ = ["merge_low_profile", "merge_small"]

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
        if overlap[p, best] <= RAISED * segments.shape[p, COUNT]:
            continue
        if leader[best] == 0:
            leader[best] = p
            known[p] = True
        else:
            merge(segments, leader[best], p)
    return known


@kernel
def merge_small(segments: Segments, grid: DepthGrid) -> None:
    """Join a segment smaller than about 9 cm2 to what it touches most."""
    n = segments.parent.size
    depth = depths_of(segments)
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not is_root(segments, p) or segments.shape[p, COUNT] >= smallest_object_at(
                grid, depth[p]
            ):
                continue
            q = np.argmax(segments.pairs[CONTACT, p])
            if segments.pairs[CONTACT, p, q] > 0:
                merge(segments, q, p)
                again = True
