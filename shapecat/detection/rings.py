"""Rings: the pieces of a rim around a floor at the level of the table (plates, flat bowls)."""

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.fill import flood_hole, is_raised
from shapecat.detection.pieces import COUNT, TOP, Pieces, merge
from shapecat.jit import kernel

__all__ = ["join_rings"]

LOW_M = 0.06
"""Top of the pieces of a rim: higher things around a patch of table are several objects."""
RING_SHARE = 0.5
PART_SHARE = 0.08


def join_rings(pieces: Pieces, w: F4, height: F4, labels: I4) -> None:
    """Join the low pieces around each hole that lies a little above the plane."""
    rows, columns = np.flatnonzero(labels.any(axis=1)), np.flatnonzero(labels.any(axis=0))
    if rows.size:
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        _join(pieces, w[box], height[box], labels[box])


@kernel
def _join(pieces: Pieces, w: F4, height: F4, labels: I4) -> None:
    n = pieces.group.size
    seen = np.zeros(labels.shape, np.uint8)
    stack = np.zeros((labels.size, 2), np.int16)
    sides, ahead, level = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int32)
    shares = np.zeros(n, np.int32)
    for si in range(labels.shape[0]):
        for sj in range(labels.shape[1]):
            if labels[si, sj] != 0 or seen[si, sj] or w[si, sj] <= 0:
                continue
            stack[0, 0], stack[0, 1] = si, sj
            cells, total = flood_hole(w, labels, seen, stack, sides, ahead, level)
            if cells < 12 or not is_raised(w, height, stack, cells):
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
