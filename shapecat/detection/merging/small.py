"""Joins: small pieces and those of low objects, which need no learning."""

import numpy as np

from shapecat.arrays import I4, Bool
from shapecat.detection.depth_grid import Cells, small_at
from shapecat.detection.merging.segments import CONTACT, COUNT, Pieces, depths_of, is_group, merge
from shapecat.jit import kernel

__all__ = ["join_raised", "join_small"]

RAISED = 0.5
"""Share of the cells of a piece that belong to one low object."""


@kernel
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
    return known


@kernel
def join_small(pieces: Pieces, cells: Cells) -> None:
    """Join a piece smaller than about 9 cm2 to what it touches most."""
    n = pieces.group.size
    depth = depths_of(pieces)
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not is_group(pieces, p) or pieces.shape[p, COUNT] >= small_at(cells, depth[p]):
                continue
            q = np.argmax(pieces.pairs[CONTACT, p])
            if pieces.pairs[CONTACT, p, q] > 0:
                merge(pieces, q, p)
                again = True
