"""Containers: the inside and the outside of bowls, cups and pots."""

import numpy as np

from shapecat.detection.pieces import (
    BOTTOM,
    CONTACT,
    COUNT,
    FEW,
    FRONT,
    HIDDEN,
    LEFT,
    NEAR,
    RIGHTMOST,
    TABLE,
    TOP,
    Pieces,
    may_join,
    merge,
)
from shapecat.detection.traits import apart, behind, has_lid, is_within, slope_of, width_of
from shapecat.jit import kernel

__all__ = ["join_hollow", "join_overhangs", "join_rims"]

SAME_TOP_M = 0.01
"""How far the heights of the parts of one container may seem to differ."""
SAME_SIDE_M, SAME_SIDE = 0.012, 0.4
"""How far an inside may reach beyond what is seen of the outside: metres, share of the width."""
ARC, ARC_APART, ARC_WIDTH, ARC_BEHIND = 1.0, 0.12, 0.75, (0.15, 1.0)
"""The near and the far half of a wall: `slope_of` either, the offset of their middles, the narrower
one, and how far the second is behind the first, by the width of the wider one."""
HOLLOW = -0.25
"""`slope_of` from which a piece is concave; planes are within a tenth of 0."""
BENT, INSIDE, INSIDE_SHARE = -0.15, -0.4, 0.12
"""Walls inside one container: slope of each, of both together, share of a boundary in contact."""
FLOOR_SHARE, WITHIN = 0.6, 0.85
"""Share of the boundary of a floor along or behind what is seen to be hollow, and what is not."""
LOW_FLOOR, RAGGED_M = 0.5, 0.02
"""Height of a low floor by that of its walls; up to where it may be full of holes, metres."""
BEFORE, FLAT, AHEAD = 0.25, 0.35, 0.65
"""A near wall: share of its boundary before the rest, height over width of it and of the rest, and
how far it is before the middle of the rest, by the width of that."""
FAR_LONG, FAR_APART, FAR_BEHIND, FAR_FLAT = 0.6, 0.12, 0.35, 0.25
"""A far rim: length and offset of its middle by the width of what is before it; share of its
boundary behind that; height over length."""
BORNE_M = 0.07
"""Lower plates are borne by nothing but their own foot."""
DISH_M, SAME_LEVEL_M, ROUND = 0.1, 0.007, 1.0
"""Height of a dish; how far the tops of its parts differ; `slope_of` of a ball or can beside it."""
UNDER, COVERED, COVERING = 0.35, 0.15, 0.2
"""What is under a rim: cells as a share of those above, share of its boundary behind the rim, and
how much of the above it may hide in turn, as a share of that."""


@kernel
def join_hollow(pieces: Pieces) -> None:
    """Join the walls and the floor inside a container, which meet in concave edges."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            for q in range(1, n):
                if _touch(pieces, p, q) and (_is_inside(pieces, p, q) or _is_floor(pieces, p, q)):
                    merge(pieces, p, q)
                    again = True


@kernel(leaf=True)
def _touch(pieces: Pieces, p: int, q: int) -> bool:
    return bool(pieces.pairs[CONTACT, p, q] >= FEW and may_join(pieces, p, q))


@kernel
def _is_inside(pieces: Pieces, p: int, q: int) -> bool:
    """Whether two pieces that touch are walls facing each other."""
    if pieces.shape[p, COUNT] < pieces.shape[q, COUNT]:
        return False
    if pieces.pairs[CONTACT, p, q] < INSIDE_SHARE * min(pieces.boundary[p], pieces.boundary[q]):
        return False
    a, b = pieces.shape[p], pieces.shape[q]
    if (slope_of(a) > BENT or slope_of(b) > BENT) and not _are_walls(pieces, p, q):
        return False
    both = a + b
    both[LEFT], both[RIGHTMOST] = min(a[LEFT], b[LEFT]), max(a[RIGHTMOST], b[RIGHTMOST])
    return bool(slope_of(both) < INSIDE)


@kernel(leaf=True)
def _are_walls(pieces: Pieces, p: int, q: int) -> bool:
    """Whether two pieces end at one height without a lid, as the walls of a square bowl do."""
    if abs(pieces.shape[p, TOP] - pieces.shape[q, TOP]) > SAME_TOP_M:
        return False
    return not (has_lid(pieces, p) or has_lid(pieces, q))


@kernel(leaf=True)
def _is_floor(pieces: Pieces, p: int, q: int) -> bool:
    """Whether ``q``, which touches the hollow piece ``p``, lies within it and lower."""
    if pieces.shape[q, TOP] > pieces.shape[p, TOP]:
        return False
    shared = pieces.pairs[CONTACT, p, q] + pieces.pairs[FRONT, p, q]
    share = FLOOR_SHARE if slope_of(pieces.shape[p]) <= HOLLOW else WITHIN
    return bool(shared > share * pieces.boundary[q] or _is_low_floor(pieces, p, q))


@kernel(leaf=True)
def _is_low_floor(pieces: Pieces, p: int, q: int) -> bool:
    """Whether ``q`` lies low between the near and the far wall of ``p``, and hardly at any other.

    Shadows of the walls hide a part of its outline. A floor a few millimetres thick is full of
    holes that are taken for the plane.
    """
    a, x, pairs = pieces.shape[p], pieces.shape[q], pieces.pairs
    before, touching = pairs[FRONT, p, q], pairs[CONTACT, p, q]
    if x[TOP] > LOW_FLOOR * a[TOP] or before < FEW or has_lid(pieces, p):
        return False
    if not is_within(x, a, SAME_SIDE_M):
        return False
    if a[BOTTOM] > x[BOTTOM] + SAME_TOP_M:  # what is under a body that begins higher is no floor
        return False
    known = np.sum(pairs[CONTACT, q]) + np.sum(pairs[FRONT, :, q]) + np.sum(pairs[FRONT, q])
    known += pieces.single[q, HIDDEN]
    known += pieces.single[q, TABLE] if x[TOP] > RAGGED_M else 0.0
    return bool(before + touching > FLOOR_SHARE * known)


@kernel
def join_rims(pieces: Pieces) -> None:
    """Join the far inside wall of a container to its outside, and then the floor to both.

    Of a wide container with upright walls these touch nowhere; but then nothing else has the near
    half of the same circle.
    """
    n = pieces.group.size
    again = True
    while again:
        again = False
        for inside in range(1, n):
            for outside in range(1, n):
                if may_join(pieces, inside, outside) and _is_container(pieces, inside, outside):
                    merge(pieces, outside, inside)
                    again = True
    for inside in range(1, n):
        for outside in range(1, n):
            if may_join(pieces, inside, outside) and _are_halves(pieces, inside, outside):
                merge(pieces, outside, inside)
    for whole in range(1, n):
        for floor in range(1, n):
            if _touch(pieces, whole, floor) and _is_floor(pieces, whole, floor):
                merge(pieces, whole, floor)


@kernel(leaf=True)
def _are_halves(pieces: Pieces, inside: int, outside: int) -> bool:
    """Whether two pieces are the far and the near half of one round wall."""
    a, x = pieces.shape[outside], pieces.shape[inside]
    if abs(a[TOP] - x[TOP]) > SAME_TOP_M:
        return False
    if slope_of(a) < ARC or slope_of(x) > -ARC:
        return False
    near, far = width_of(a), width_of(x)
    wide = max(near, far)
    if min(near, far) < ARC_WIDTH * wide or apart(a, x) > ARC_APART * wide:
        return False
    if not ARC_BEHIND[0] * wide < behind(x, a) < ARC_BEHIND[1] * wide:
        return False
    return not (has_lid(pieces, outside) or has_lid(pieces, inside))


@kernel(leaf=True)
def _is_container(pieces: Pieces, inside: int, outside: int) -> bool:
    """Whether one piece is the far inside, seen over the near rim, of another as high and wide."""
    pairs = pieces.pairs
    touch = pairs[CONTACT, inside, outside] + pairs[NEAR, inside, outside]
    if max(touch, pairs[FRONT, outside, inside]) < FEW:
        return False
    a, x = pieces.shape[outside], pieces.shape[inside]
    if abs(a[TOP] - x[TOP]) > SAME_TOP_M:
        return False
    if not is_within(x, a, max(SAME_SIDE_M, SAME_SIDE * max(width_of(a), width_of(x)))):
        return False
    # Where they touch, ending at one height without a lid says enough: within small cups the
    # windows of the tangents smear the curvature.
    if touch < FEW and slope_of(x) > HOLLOW and not _is_far_rim(pieces, inside, outside):
        return False
    return not (has_lid(pieces, outside) or has_lid(pieces, inside))


@kernel(leaf=True)
def _is_far_rim(pieces: Pieces, far: int, near: int) -> bool:
    """Whether a narrow strip, too flat to show its curvature, shows behind the middle of a piece.

    Of a container at the level of the camera little else is seen of the inside.
    """
    a, x = pieces.shape[near], pieces.shape[far]
    long, wide = width_of(x), width_of(a)
    along = long > FAR_LONG * wide and apart(x, a) < FAR_APART * wide
    hidden = pieces.pairs[FRONT, near, far] > FAR_BEHIND * pieces.boundary[far]
    return bool(along and hidden and x[TOP] - x[BOTTOM] < FAR_FLAT * long)


@kernel
def join_overhangs(pieces: Pieces) -> None:
    """Join the near outside wall of a plate or bowl, seen below its own rim or before its floor.

    Contents behind the near rim hide a part of the inside; what is under the rim hides nothing.
    """
    n = pieces.group.size
    for near in range(1, n):
        for whole in range(1, n):
            if may_join(pieces, near, whole) and (
                _is_under(pieces, near, whole)
                or _is_strip(pieces, near, whole)
                or _is_wall(pieces, near, whole)
            ):
                merge(pieces, whole, near)
                break


@kernel(leaf=True)
def _is_under(pieces: Pieces, under: int, above: int) -> bool:
    """Whether one piece is small and shows below the rim of another, nearer than its middle."""
    a, u = pieces.shape[above], pieces.shape[under]
    if u[COUNT] > UNDER * a[COUNT]:
        return False
    covered = pieces.pairs[FRONT, above, under]
    if covered < max(FEW, COVERED * pieces.boundary[under]):
        return False
    if pieces.pairs[FRONT, under, above] > COVERING * covered:
        return False
    if not is_within(u, a, SAME_SIDE_M):
        return False
    if not a[BOTTOM] < u[TOP] <= a[TOP] or _bears(pieces, under, above):
        return False
    return bool(behind(a, u) > 0)


@kernel(leaf=True)
def _bears(pieces: Pieces, under: int, above: int) -> bool:
    """Whether one piece stands on the plane, and the other, which is high enough, on it."""
    if pieces.shape[above, TOP] < BORNE_M:
        return False
    return bool(pieces.single[under, TABLE] >= FEW and pieces.single[above, TABLE] < FEW)


@kernel(leaf=True)
def _is_strip(pieces: Pieces, strip: int, whole: int) -> bool:
    """Whether a long low piece without a lid stands before the floor of a flat container."""
    a, s = pieces.shape[whole], pieces.shape[strip]
    if s[COUNT] > a[COUNT]:
        return False
    if pieces.pairs[FRONT, strip, whole] < BEFORE * pieces.boundary[strip]:
        return False
    if not is_within(s, a, SAME_SIDE_M):
        return False
    long, wide = width_of(s), width_of(a)
    if s[TOP] - s[BOTTOM] > FLAT * long or a[TOP] > FLAT * wide:
        return False
    if abs(a[TOP] - s[TOP]) > SAME_TOP_M or behind(a, s) > AHEAD * wide:
        return False
    return not has_lid(pieces, strip)


@kernel(leaf=True)
def _is_wall(pieces: Pieces, wall: int, whole: int) -> bool:
    """Whether two low pieces that touch end at one height, one is hollow and neither is round.

    So do the parts of a dish. Its floor is so near to its top that it seems to have a lid.
    """
    a, x = pieces.shape[whole], pieces.shape[wall]
    if x[COUNT] > a[COUNT]:
        return False
    if pieces.pairs[CONTACT, wall, whole] == 0 or abs(a[TOP] - x[TOP]) > SAME_LEVEL_M:
        return False
    first, second = slope_of(a), slope_of(x)
    return bool(a[TOP] < DISH_M and min(first, second) < BENT and max(first, second) < ROUND)
