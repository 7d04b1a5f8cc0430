"""Joins: the rules that bring the pieces of one object together."""

from collections.abc import Collection

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.cells import Cells
from shapecat.detection.containers import join_hollow, join_overhangs, join_rims
from shapecat.detection.occluders import join_behind
from shapecat.detection.pieces import (
    BOTTOM,
    CONTACT,
    COUNT,
    FEW,
    FRONT,
    HIDDEN,
    LEFT,
    NEAR,
    ONTO,
    RIGHTMOST,
    TABLE,
    TOP,
    Pieces,
    depths_of,
    has_lid,
    is_group,
    lid_share,
    merge,
    rests_on,
    slope_of,
)
from shapecat.detection.surfaces import Surfaces
from shapecat.jit import kernel

__all__ = ["join_pieces"]

PART = 0.48
"""A part that stands on nothing is smaller than this share of what it hangs on."""
SEEN_WHOLE = 0.25
"""Largest share of its boundary that is behind other things."""
STANDS = 0.25
HANGS = 0.4
"""Links with the plane, as a share of those with pieces, of a handle that reaches down to it."""
NECK_WIDTH, NECK_OVERLAP_M, NECK_APART, ROUND = 0.55, 0.03, 0.12, 0.8
"""A neck: width, metres below the top of the body, offset of its middle; slope of the body."""
NECK_LEDGE, NECK_TALL = 0.1, 1.1
AXIAL, WIDEST_NECK, NECK_HEIGHT = 0.055, 0.78, 0.62
"""A wide neck on a shoulder: offset of its middle, width, height, all by those of the body."""
SHOULDER_M, SHOULDER = 0.01, 0.17
"""A shoulder slopes: within this depth of its top less faces up than this, by width squared."""


def join_pieces(
    pieces: Pieces, cells: Cells, surfaces: Surfaces, labels: I4, rules: Collection[str]
) -> None:
    """Apply the rules named in ``rules``, in their order; `Pieces.group` holds the result."""
    if "small" in rules:
        _join_small(pieces, cells.small(depths_of(pieces)))
    if "occluder" in rules:
        join_behind(pieces, cells.w, cells.lens, surfaces.normal, labels)
    if "hollow" in rules:
        join_hollow(pieces)
    if "rim" in rules:
        join_rims(pieces)
    if "overhang" in rules:
        join_overhangs(pieces)
    if "neck" in rules:
        _join_necks(pieces)
    if "float" in rules:
        _join_floating(pieces)


@kernel
def _join_small(pieces: Pieces, small: F4) -> None:
    """Join a piece smaller than about 9 cm2 to what it touches most."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not is_group(pieces, p) or pieces.shape[p, COUNT] >= small[p]:
                continue
            q = np.argmax(pieces.pairs[CONTACT, p])
            if pieces.pairs[CONTACT, p, q] > 0:
                merge(pieces, q, p)
                again = True


@kernel
def _join_necks(pieces: Pieces) -> None:
    """Join a narrow round piece to the round one without a lid it is over the middle of."""
    n = pieces.group.size
    for p in range(1, n):
        for q in range(1, n):
            if p != q and is_group(pieces, p) and is_group(pieces, q) and _is_neck(pieces, p, q):
                merge(pieces, q, p)
                break


@kernel(leaf=True)
def _is_neck(pieces: Pieces, p: int, q: int) -> bool:
    a, b = pieces.shape[p], pieces.shape[q]
    met = pieces.pairs[CONTACT, p, q] + pieces.pairs[NEAR, p, q]
    if met < FEW or pieces.owner[p] != pieces.owner[q] or pieces.single[p, TABLE] > 2:
        return False
    narrow, wide = a[RIGHTMOST] - a[LEFT], b[RIGHTMOST] - b[LEFT]
    if a[TOP] < b[TOP] or a[BOTTOM] < b[TOP] - NECK_OVERLAP_M or slope_of(b) < ROUND:
        return False
    apart = abs(a[LEFT] + a[RIGHTMOST] - b[LEFT] - b[RIGHTMOST]) / 2
    if apart > NECK_APART * wide or slope_of(a) < ROUND / 2:
        return False
    if a[TOP] - a[BOTTOM] > NECK_TALL * (b[TOP] - b[BOTTOM]) or rests_on(pieces, p, q):
        return False
    if pieces.pairs[ONTO, p, q] <= NECK_LEDGE * pieces.pairs[CONTACT, p, q]:
        return bool(narrow <= wide and not has_lid(pieces, q))
    if narrow <= NECK_WIDTH * wide and not has_lid(pieces, q):
        return True
    # A wide neck on a shoulder: turned about one axis, and the shoulder slopes.
    axial = apart <= AXIAL * wide and slope_of(a) >= ROUND and narrow <= WIDEST_NECK * wide
    axial = axial and a[TOP] - a[BOTTOM] <= NECK_HEIGHT * (b[TOP] - b[BOTTOM])
    return bool(axial and lid_share(pieces, q, SHOULDER_M) < SHOULDER)


@kernel
def _join_floating(pieces: Pieces) -> None:
    """Join a piece that stands on nothing and is seen whole to what it touches."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not is_group(pieces, p):
                continue
            contact = pieces.pairs[CONTACT, p]
            total = np.sum(contact)
            q = np.argmax(contact)
            hidden = np.sum(pieces.pairs[FRONT, :, p]) + pieces.single[p, HIDDEN]
            hidden -= pieces.pairs[FRONT, q, p]  # that would be its own body
            if (
                total >= FEW
                and pieces.single[p, TABLE] <= max(2.0, HANGS * total)
                and hidden < SEEN_WHOLE * pieces.boundary[p]
                and np.sum(pieces.pairs[ONTO, p]) < STANDS * total
                and pieces.shape[p, COUNT] < PART * pieces.shape[q, COUNT]
                and not rests_on(pieces, p, q)
            ):
                merge(pieces, q, p)
                again = True
