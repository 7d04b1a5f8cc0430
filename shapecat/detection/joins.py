"""Joins: the rules that bring the pieces of one object together."""

from collections.abc import Collection

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.cells import Cells
from shapecat.detection.containers import join_hollow, join_overhangs, join_rims
from shapecat.detection.occluders import join_around, join_behind
from shapecat.detection.pieces import (
    BOTTOM,
    CONTACT,
    COUNT,
    FEW,
    FRONT,
    HIDDEN,
    NEAR,
    ONTO,
    OVER,
    TABLE,
    TOP,
    Pieces,
    depths_of,
    is_group,
    may_join,
    merge,
)
from shapecat.detection.surfaces import Surfaces
from shapecat.detection.traits import (
    LID_M,
    MEETS_M,
    apart,
    behind,
    has_lid,
    lid_share,
    rests_on,
    roundness_of,
    slope_of,
    width_of,
)
from shapecat.jit import kernel

__all__ = ["join_pieces"]

PART = 0.48
"""A part that stands on nothing is smaller than this share of what it hangs on."""
SEEN_WHOLE = 0.25
"""Largest share of its boundary that is behind other things."""
SEEN_BARE = 0.1
"""The same of what it may stand on: what that stands on must not be hidden."""
WHOLE = 1.6
"""`slope_of` what is seen all the way round: a ball or can that leans, but no handle."""
STANDS, ON_TOP, RISES_M = 0.25, 0.5, 0.005
"""What stands on something is linked to surface that faces up, and reaches so far above it; where
all else says that it does not, along the second share of its contacts."""
RISES, STEPPED = 0.33, 0.2
"""What stands on a top that is not seen: share of its height above that; places where depth jumps
to it, by the links."""
HANGS, ALONG = 0.4, 0.15
"""Of a handle that reaches down to the plane: most links with that, as a share of those with
pieces; least share of its boundary along what it hangs on."""
IN_AIR_M, IN_AIR, HANGING, HIGHER_M = 0.02, 0.08, 0.4, 0.02
"""Of what hangs: least height; least share of its boundary above what is farther away; width, by
that of what it hangs on, and how far it may rise above that, metres."""
SCRAP, TURNED = 100, 1.3
"""Cells of a scrap, and `slope_of` below which it is no small ball or can."""
FRAGMENT, BEARS = 160, 0.2
"""Cells of a fragment; share of the boundary of what bears something along the plane."""
NECK_WIDTH, NECK_LEDGE, NECK_STEPPED = 0.7, 0.1, 0.1
"""A neck is narrower, by the width of the body, on what faces up along more than this share of its
border, or with a step along so much of it."""
NECK_APART, NECK_OUT, NECK_TALL, NECK_OVERLAP_M = 0.2, 0.05, 1.1, 0.03
"""How far its middle is off that of the body, and its side beyond that of the body, by the width of
the body; its height, by that of the body; how far it may begin below the top of the body, metres.
"""
BULGING, ROUND = 0.8, 0.9
"""`slope_of` and `roundness_of` from which a body is round; what shows a level top is less."""
ON_AXIS, SHOULDER = 0.08, 0.4
"""How far the middle of a neck is off that of a body whose shoulder is level, by the width of the
body; how much of that faces up near its top, by its width squared: the top of a can is more."""
SEAM = 0.36
"""Share of the outlines of a lid and of what is below it along their border."""
WAIST, COAXIAL = (0.95, 1.3), 0.035
"""Width of a round body by that of what it is turned in one piece with below, and the offset of
their middles by its width."""
FOOT_M, FOOT, FOOT_APART, BARE = 0.06, 0.6, 0.06, 0.05
"""A foot: its height; its width and the offset of its middle, by the width of the dish; how much
of its top may be seen, by its own width squared."""


def join_pieces(
    pieces: Pieces, cells: Cells, surfaces: Surfaces, labels: I4, rules: Collection[str]
) -> None:
    """Apply the rules named in ``rules``, in their order; `Pieces.group` holds the result."""
    if "small" in rules:
        _join_small(pieces, cells.small(depths_of(pieces)))
    if "hollow" in rules:
        join_hollow(pieces)
    if "rim" in rules:
        join_rims(pieces)
    if "occluder" in rules:
        join_behind(pieces, cells.w, cells.lens, surfaces.normal, labels)
    if "overhang" in rules:
        join_overhangs(pieces)
    if "neck" in rules:
        _join_necks(pieces)
    if "float" in rules:
        _join_floating(pieces)
        _join_hanging(pieces)
    if "rim" in rules:  # what the scraps of a rim hold together only now
        join_rims(pieces)
    if "occluder" in rules:
        join_around(pieces)


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
    """Join a piece to the round one without a lid that it is over the middle of."""
    n = pieces.group.size
    for p in range(1, n):
        for q in range(1, n):
            if may_join(pieces, p, q) and (
                _is_neck(pieces, p, q) or _has_foot(pieces, p, q) or _is_lid(pieces, p, q)
            ):
                merge(pieces, q, p)
                break


@kernel(leaf=True)
def _is_neck(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` is narrow and rises from the middle of ``q``, which is round and open.

    What stands on something is linked to its top, rests on it, or is parted from it by a step.
    """
    a, b = pieces.shape[p], pieces.shape[q]
    met = pieces.pairs[CONTACT, p, q] + pieces.pairs[NEAR, p, q]
    if met < FEW or pieces.single[p, TABLE] > 2:
        return False
    narrow, wide = width_of(a), width_of(b)
    ledge = pieces.pairs[ONTO, p, q] > NECK_LEDGE * pieces.pairs[CONTACT, p, q]
    ledge |= rests_on(pieces, p, q) or _is_stepped(pieces, p, q, NECK_STEPPED)
    if narrow > (NECK_WIDTH if ledge else 1.0) * wide:
        return False
    off = apart(a, b)
    if off > min(NECK_APART * wide, (wide - narrow) / 2 + NECK_OUT * wide):
        return False
    if a[TOP] < b[TOP] or a[BOTTOM] < b[TOP] - NECK_OVERLAP_M:
        return False
    if a[TOP] - a[BOTTOM] > NECK_TALL * (b[TOP] - b[BOTTOM]):
        return False
    if slope_of(b) < BULGING or roundness_of(b) < ROUND:
        return False
    shoulder = off < ON_AXIS * wide and lid_share(pieces, q, LID_M) < SHOULDER
    return bool(shoulder or not has_lid(pieces, q))


@kernel(leaf=True)
def _has_foot(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``q`` is the lower half of a body with a waist, or the foot of a dish.

    Nothing of its top is seen, and their border is not level; what stands on it meets it at one
    height, and hardly ever stands so exactly in the middle.
    """
    a, b = pieces.shape[p], pieces.shape[q]
    contact = pieces.pairs[CONTACT, p, q]
    if contact < FEW or pieces.single[p, TABLE] > 2:
        return False
    if a[TOP] < b[TOP] or not -NECK_OVERLAP_M < a[BOTTOM] - b[TOP] < -MEETS_M:
        return False
    if slope_of(b) < BULGING or roundness_of(b) < ROUND:
        return False
    if pieces.pairs[ONTO, p, q] > NECK_LEDGE * contact or lid_share(pieces, q, LID_M) > BARE:
        return False
    width, foot, off = width_of(a), width_of(b), apart(a, b)
    if slope_of(a) > BULGING and WAIST[0] * foot < width < WAIST[1] * foot:
        return bool(off < COAXIAL * width)
    return bool(b[TOP] < FOOT_M and FOOT * width < foot < width and off < FOOT_APART * width)


@kernel(leaf=True)
def _is_lid(pieces: Pieces, p: int, q: int) -> bool:
    """Whether the border of two pieces is a seam: much of both outlines, and no top shows there.

    So flat things whose sides are so nearly flush all around hardly ever lie on each other.
    """
    seam = pieces.pairs[CONTACT, p, q]
    return bool(
        seam > SEAM * max(pieces.boundary[p], pieces.boundary[q])
        and pieces.shape[p, TOP] > pieces.shape[q, TOP]
        and pieces.pairs[ONTO, p, q] < ON_TOP * seam
    )


@kernel
def _join_floating(pieces: Pieces) -> None:
    """Join a piece that is no object of its own to what it touches: what floats, and scraps."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not is_group(pieces, p):
                continue
            contact = pieces.pairs[CONTACT, p]
            q = np.argmax(contact)
            if np.sum(contact) >= FEW and (
                _is_scrap(pieces, p, q)
                or _is_fragment(pieces, p, q)
                or (
                    _floats(pieces, p, q)
                    and (_is_part(pieces, p, q) or _is_upper_half(pieces, p, q))
                )
            ):
                merge(pieces, q, p)
                again = True


@kernel
def _join_hanging(pieces: Pieces) -> None:
    """Join what ends in the air and touches nothing to what it is beside: a handle or a spout."""
    n = pieces.group.size
    pairs = pieces.pairs
    for p in range(1, n):
        if not is_group(pieces, p) or not _hangs(pieces, p):
            continue
        best, most = 0, 0.0
        for q in range(1, n):
            beside = pairs[NEAR, p, q] + pairs[FRONT, p, q] + pairs[FRONT, q, p]
            if beside > most and _is_within_reach(pieces, p, q):
                best, most = q, beside
        if most >= FEW:
            merge(pieces, best, p)


@kernel(leaf=True)
def _hangs(pieces: Pieces, p: int) -> bool:
    """Whether the lower end of a piece is seen above what is farther away, and never meets it.

    So is the lower side of balls and bowls.
    """
    row, single = pieces.shape[p], pieces.single[p]
    return bool(
        row[COUNT] > 0
        and row[BOTTOM] > IN_AIR_M
        and abs(slope_of(row)) < BULGING
        and single[TABLE] == 0
        and single[OVER] > max(float(FEW), IN_AIR * pieces.boundary[p])
        and np.sum(pieces.pairs[CONTACT, p]) < FEW
    )


@kernel(leaf=True)
def _is_within_reach(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` is small, and before or behind ``q`` by no more than half its width."""
    if pieces.owner[p] != pieces.owner[q] or not _is_smaller(pieces, p, q):
        return False
    a, b = pieces.shape[p], pieces.shape[q]
    wide = width_of(b)
    if width_of(a) > HANGING * wide or a[TOP] > b[TOP] + HIGHER_M:
        return False
    return bool(abs(behind(a, b)) < wide / 2)


@kernel(leaf=True)
def _is_smaller(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` is much smaller than ``q`` and does not rest on it."""
    return bool(
        pieces.shape[p, COUNT] < PART * pieces.shape[q, COUNT] and not rests_on(pieces, p, q)
    )


@kernel(leaf=True)
def _is_scrap(pieces: Pieces, p: int, q: int) -> bool:
    """Whether too little is seen of a piece to be an object that touches another, unless round.

    The neck of a lying bottle and the handle of a cup reach the plane, as small objects do.
    """
    row = pieces.shape[p]
    return bool(row[COUNT] < SCRAP and slope_of(row) < TURNED and _is_smaller(pieces, p, q))


@kernel(leaf=True)
def _is_fragment(pieces: Pieces, p: int, q: int) -> bool:
    """Whether so little is seen of two pieces that both are of one object.

    Of two objects one stands on the other, and that on the plane, or they touch at one place.
    """
    a, b = pieces.shape[p], pieces.shape[q]
    if a[COUNT] >= FRAGMENT or a[COUNT] < PART * b[COUNT]:
        return False
    if slope_of(a) > TURNED or rests_on(pieces, p, q) or rests_on(pieces, q, p):
        return False
    on, under = pieces.single[p, TABLE], pieces.single[q, TABLE]
    if on > 0 and pieces.pairs[CONTACT, p, q] < ALONG * pieces.boundary[p]:
        return False
    return not (
        (on <= 2 and under > BEARS * pieces.boundary[q])
        or (under <= 2 and on > BEARS * pieces.boundary[p])
    )


@kernel(leaf=True)
def _floats(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` is not on the plane and is seen whole but for what ``q`` hides."""
    hidden = np.sum(pieces.pairs[FRONT, :, p]) + pieces.single[p, HIDDEN]
    hidden -= pieces.pairs[FRONT, q, p]
    return bool(
        pieces.single[p, TABLE] <= max(2.0, HANGS * np.sum(pieces.pairs[CONTACT, p]))
        and hidden < SEEN_WHOLE * pieces.boundary[p]
    )


@kernel(leaf=True)
def _is_part(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` stands on nothing, and is small beside ``q``.

    A neighbour whose foot is hidden but for a little meets ``q`` along a short line.
    """
    if pieces.single[p, TABLE] > 0 and pieces.pairs[CONTACT, p, q] < ALONG * pieces.boundary[p]:
        return False
    stands = _links_onto_lower(pieces, p) >= STANDS * np.sum(pieces.pairs[CONTACT, p])
    stands |= _is_atop(pieces, p, q)
    return bool(not stands and slope_of(pieces.shape[p]) < WHOLE and _is_smaller(pieces, p, q))


@kernel(leaf=True)
def _is_atop(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` rises above ``q``, and a part of their border is a step.

    So does what stands on a top that is seen edge on; what grows out of a body does so smoothly.
    """
    a, b = pieces.shape[p], pieces.shape[q]
    rises = a[TOP] - b[TOP] > RISES * (a[TOP] - a[BOTTOM])
    return bool(rises and _is_stepped(pieces, p, q, STEPPED))


@kernel(leaf=True)
def _is_stepped(pieces: Pieces, p: int, q: int, share: float) -> bool:
    """Whether depth jumps between two pieces in more than this share of their links."""
    steps = pieces.pairs[FRONT, p, q] + pieces.pairs[FRONT, q, p]
    return bool(steps > share * pieces.pairs[CONTACT, p, q])


@kernel(leaf=True)
def _is_upper_half(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``q`` below is seen to stand on nothing either: what bears something does."""
    a, b = pieces.shape[p], pieces.shape[q]
    contact = pieces.pairs[CONTACT, p, q]
    others = np.sum(pieces.pairs[CONTACT, q]) - contact
    hidden = np.sum(pieces.pairs[FRONT, :, q]) - pieces.pairs[FRONT, p, q]
    hidden += pieces.single[q, HIDDEN]
    return bool(
        a[TOP] > b[TOP]
        and a[BOTTOM] > b[BOTTOM]
        and others < FEW
        and _links_onto_lower(pieces, p) < ON_TOP * np.sum(pieces.pairs[CONTACT, p])
        and pieces.single[q, TABLE] <= max(2.0, HANGS * contact)
        and hidden < SEEN_BARE * pieces.boundary[q]
    )


@kernel(leaf=True)
def _links_onto_lower(pieces: Pieces, p: int) -> float:
    """Count the links of a piece with surface that faces up, of pieces that it rises above.

    The upper side of a lying bottle faces up beside its neck too.
    """
    total = 0.0
    for q in range(1, pieces.group.size):
        if pieces.shape[p, TOP] > pieces.shape[q, TOP] + RISES_M:
            total += pieces.pairs[ONTO, p, q]
    return total
