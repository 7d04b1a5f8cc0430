"""Rings: the pieces of a rim around a floor at the level of the table (plates, flat bowls)."""

import numpy as np

from shapecat.arrays import F4, I4, Bool
from shapecat.detection.fill import STACK, extent_of, flood_hole, is_raised, mark_open, may_be_hole
from shapecat.detection.pieces import COUNT, TOP, Pieces, merge
from shapecat.jit import kernel

__all__ = ["join_raised", "join_rings"]

LOW_M = 0.06
"""Top of the pieces of a rim: higher things around a patch of table are several objects."""
LEAST_CELLS = 12
"""Smaller holes are noise."""
RING_SHARE, PART_SHARE = 0.5, 0.08
"""Shares of the boundary of a hole: along low pieces together, and along each that is joined."""
RAISED = 0.5
"""Share of the cells of a piece that belong to one low object."""


def join_raised(pieces: Pieces, raised: I4, labels: I4, spans: I4) -> Bool:
    """Join the pieces of each low object that is known by its outline; return which they are.

    Parameters
    ----------
    raised : (rows, columns) the numbers of the low objects, from `raise_low`.
    spans : where there are ``labels``, as in `Surfaces`.

    Returns
    -------
    (n + 1,) whether most of a piece is low and known to be an object.
    """
    known = np.zeros(pieces.group.size, np.bool_)
    _join_raised(pieces, raised, labels, spans, known)
    return known


@kernel
def _join_raised(pieces: Pieces, raised: I4, labels: I4, spans: I4, known: Bool) -> None:
    n = pieces.group.size
    cells = np.zeros((n, np.max(raised) + 1), np.int32)
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            if raised[i, j] > 0:
                cells[labels[i, j], raised[i, j]] += 1
    leader = np.zeros(cells.shape[1], np.int32)
    for p in range(1, n):
        best = np.argmax(cells[p])
        if cells[p, best] <= RAISED * pieces.shape[p, COUNT]:
            continue
        if leader[best] == 0:
            leader[best] = p
            known[p] = True
        else:
            merge(pieces, leader[best], p)


@kernel
def join_rings(pieces: Pieces, w: F4, height: F4, labels: I4) -> None:
    """Join the low pieces around each hole that lies a little above the plane."""
    n = pieces.group.size
    seen = np.zeros(labels.shape, np.uint8)
    stack = np.zeros((STACK, 2), np.int16)
    sides, ahead, level, shares = np.zeros((4, n), np.int32)
    extent = extent_of(labels)
    mark_open(w, labels, extent, seen)
    for si in range(extent[0], extent[2]):
        for sj in range(extent[1], extent[3]):
            if not may_be_hole(w, labels, extent, seen, si, sj):
                continue
            stack[0, 0], stack[0, 1] = si, sj
            cells, total = flood_hole(w, labels, extent, seen, stack, sides, ahead, level)
            if cells < LEAST_CELLS or not is_raised(w, height, stack, cells):
                continue
            shares[:] = 0
            low = 0
            for k in range(1, n):
                leader = pieces.group[k]
                if leader > 0 and pieces.shape[leader, TOP] < LOW_M:
                    shares[leader] += sides[k]
                    low += sides[k]
            if low < RING_SHARE * total:
                continue
            best = 0
            for k in range(1, n):
                if shares[k] >= PART_SHARE * total and (
                    best == 0 or pieces.shape[k, COUNT] > pieces.shape[best, COUNT]
                ):
                    best = k
            for k in range(1, n):
                if k != best and best > 0 and shares[k] >= PART_SHARE * total:
                    merge(pieces, best, k)
