"""Rings: the pieces of a rim around a floor at the level of the table (plates, flat bowls)."""

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.fill import STACK, extent_of, flood_hole, is_raised, may_be_hole
from shapecat.detection.pieces import COUNT, TOP, Pieces, merge
from shapecat.jit import kernel

__all__ = ["join_rings"]

LOW_M = 0.06
"""Top of the pieces of a rim: higher things around a patch of table are several objects."""
RING_SHARE = 0.5
PART_SHARE = 0.08


@kernel
def join_rings(pieces: Pieces, w: F4, height: F4, labels: I4) -> None:
    """Join the low pieces around each hole that lies a little above the plane."""
    n = pieces.group.size
    seen = np.zeros(labels.shape, np.uint8)
    stack = np.zeros((STACK, 2), np.int16)
    sides, ahead, level, shares = np.zeros((4, n), np.int32)
    extent = extent_of(labels)
    for si in range(extent[0], extent[2]):
        for sj in range(extent[1], extent[3]):
            if not may_be_hole(w, labels, extent, seen, si, sj):
                continue
            stack[0, 0], stack[0, 1] = si, sj
            cells, total = flood_hole(w, labels, extent, seen, stack, sides, ahead, level)
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
