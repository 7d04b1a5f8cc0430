"""Parts: whether two pieces that meet are of one object, as trees grown on simulated scenes tell.

A bottle and its neck, a plate and its foot, a cup and its handle, the halves of a toy: many weak
signs together tell them from what only touches or stands on it, and no few of them do.
"""

from functools import cache
from importlib.resources import files
from io import BytesIO
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.merging.segment_features import (
    LID_M,
    apart,
    behind,
    lid_share,
    roundness_of,
    slope_of,
    top_band,
    width_of,
)
from shapecat.detection.merging.segments import (
    AREA,
    BOTTOM,
    CONTACT,
    COUNT,
    FAR,
    FEW,
    FRONT,
    HIDDEN,
    LEFT,
    NEAR,
    ONTO,
    ONTO_HEIGHT,
    OVER,
    RIGHTMOST,
    RIM,
    TABLE,
    TOP,
    Pieces,
    may_join,
    merge,
)
from shapecat.jit import kernel

__all__ = ["FILE", "SIGNS", "Sight", "Trees", "join_parts", "meet_at_all", "signs_of", "trees"]

FILE = "parts.npz"
LIKELY = 0.6
"""Logit, of 0.65, from which on two pieces are taken for parts of one object: a wrong join loses
two objects, a missing one seldom one."""
HOPELESS = -4.0
"""Logit of the first trees that the others never made up for; half of the pairs end so early."""
BORDER = (
    "contact, m", "contact", "first in front", "second in front", "along first", "along second",
    "second faces up", "first faces up", "and so far above its top", "the same of the first",
    "border, m",
)  # fmt: skip
"""Signs of a border: lengths, or shares of it; of either outline; of the contact; metres."""
TRAITS = (
    "width", "top", "bottom", "height", "slope", "roundness", "plane", "hidden", "rim", "over",
    "touching", "in front", "behind", "lid", "facing up", "area", "fill",
)  # fmt: skip
"""Signs of either piece: metres; `slope_of`, `roundness_of`; shares of its outline; `lid_share`,
shares of its area and of its width times its height."""
BOTH = (
    "area by area", "width by width", "apart", "behind, m", "behind", "overlap", "top over top",
    "bottom over top", "other bottom over top", "bottom over bottom", "most beyond", "least beyond",
    "slope", "roundness", "cells", "cell, m", "down",
)  # fmt: skip
"""Signs of how two pieces lie to each other, of both together, and of how well they are seen."""
FIRST = len(BORDER)
SECOND = FIRST + len(TRAITS)
LAST = SECOND + len(TRAITS)
SIGNS = LAST + len(BOTH)
"""Number of signs, and where those of the first and the second piece and of both begin."""
FACING_M, FACING = 0.015, 0.5
"""What faces each other: difference of the tops, metres; least share of the narrower one's width
that has the other one before or behind it."""
LANES = 8
"""Trees that are walked at the same time: one waits for memory while the others go on."""
NOWHERE_M = -1.0
"""Height of what faces up across a border where nothing does, metres."""


class Trees(NamedTuple):
    """Boosted trees, whose leaves add up to the logit that two pieces are parts of one object.

    Attributes
    ----------
    roots : (t,) first node of each tree.
    feature, threshold : (m,) a pair goes left where this sign is <= this.
    left : (m,) the left child, the right one stands behind it; 0 in leaves.
    value : (m,) what a leaf adds.
    """

    roots: I4
    feature: I4
    threshold: F4
    left: I4
    value: F4


class Sight(NamedTuple):
    """How things are seen.

    ``focal`` length in cells; ``down`` the cosine between the optical axis and up, its third part.
    """

    focal: float
    down: float


@cache
def trees() -> Trees:
    """Return the trees that belong to this version."""
    content = files("shapecat.detection.merging").joinpath(FILE).read_bytes()
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return Trees(*(arrays[name] for name in Trees._fields))


@kernel
def join_parts(pieces: Pieces, sight: Sight, grown: Trees) -> None:
    """Join pieces that are likely parts of one object, the likeliest first."""
    n = pieces.group.size
    logits = np.full((n, n), -np.inf)
    signs = np.zeros(SIGNS, np.float32)
    for p in range(1, n):
        for q in range(p + 1, n):
            if meet_at_all(pieces, p, q):
                signs_of(pieces, p, q, sight, signs)
                logits[p, q] = _sum_of(grown, signs)
    while True:
        best = np.argmax(logits)
        p, q = int(best // n), int(best % n)
        if logits[p, q] < LIKELY:
            return
        merge(pieces, p, q)
        for k in range(1, n):
            logits[q, k] = logits[k, q] = logits[k, p] = logits[p, k] = -np.inf
            if meet_at_all(pieces, p, k):
                signs_of(pieces, p, k, sight, signs)
                logits[min(p, k), max(p, k)] = _sum_of(grown, signs)


@kernel(leaf=True)
def meet_at_all(pieces: Pieces, p: int, q: int) -> bool:
    """Whether two pieces above one plane touch, one hides the other, or they face each other."""
    if not may_join(pieces, p, q):
        return False
    pairs = pieces.pairs
    met = pairs[CONTACT, p, q] + pairs[NEAR, p, q] + pairs[FRONT, p, q] + pairs[FRONT, q, p]
    return bool(met >= FEW or _face(pieces.shape[p], pieces.shape[q]))


@kernel(leaf=True)
def _face(a: F4, b: F4) -> bool:
    """Whether two pieces may be the near and the far wall of a pot: these touch nowhere."""
    narrow, wide = min(width_of(a), width_of(b)), max(width_of(a), width_of(b))
    common = min(a[RIGHTMOST], b[RIGHTMOST]) - max(a[LEFT], b[LEFT])
    level = abs(a[TOP] - b[TOP]) < FACING_M
    return bool(level and common > FACING * narrow and abs(behind(a, b)) < wide)


@kernel
def _sum_of(grown: Trees, signs: F4) -> float:
    nodes = np.zeros(LANES, np.int32)
    logit = 0.0
    for first in range(0, grown.roots.size, LANES):
        lanes = min(LANES, grown.roots.size - first)
        nodes[:lanes] = grown.roots[first : first + lanes]
        while _descend(grown, signs, nodes):
            pass
        for lane in range(lanes):
            logit += grown.value[nodes[lane]]
            if logit < HOPELESS:
                return float(logit)
    return float(logit)


@kernel(leaf=True)
def _descend(grown: Trees, signs: F4, nodes: I4) -> bool:
    """Go down one level in each of `LANES` trees; whether any was not in a leaf."""
    inner = False
    for lane in range(LANES):
        node = np.uint32(nodes[lane])  # unsigned numbers cannot count from the end: no test for it
        left = grown.left[node]
        right = signs[np.uint16(grown.feature[node])] > grown.threshold[node]
        nodes[lane] = left + np.int32(right) if left > 0 else nodes[lane]
        inner |= left > 0
    return inner


@kernel
def signs_of(pieces: Pieces, p: int, q: int, sight: Sight, signs: F4) -> None:
    """Write the `SIGNS` of two pieces, those of the smaller one first; lengths are in metres."""
    first, second = pieces.shape[p, AREA], pieces.shape[q, AREA]
    if first > second or (first == second and p > q):
        p, q = q, p
    cell = pieces.shape[p, FAR] / pieces.shape[p, COUNT] / sight.focal
    _border(pieces, p, q, cell, signs[:FIRST])
    _traits(pieces, p, signs[FIRST:SECOND])
    _traits(pieces, q, signs[SECOND:LAST])
    a, b = pieces.shape[p], pieces.shape[q]
    both = signs[LAST:]
    _compare(a, b, both)
    whole = a + b
    whole[LEFT], whole[RIGHTMOST] = min(a[LEFT], b[LEFT]), max(a[RIGHTMOST], b[RIGHTMOST])
    both[12], both[13] = slope_of(whole), roundness_of(whole)
    both[14], both[15], both[16] = a[COUNT], cell, sight.down


@kernel(leaf=True)
def _border(pieces: Pieces, p: int, q: int, cell: float, signs: F4) -> None:
    """Write what is where two pieces meet."""
    pairs = pieces.pairs
    contact, near = pairs[CONTACT, p, q], pairs[NEAR, p, q]
    over, under = pairs[FRONT, p, q], pairs[FRONT, q, p]
    met = contact + near + over + under
    signs[0] = contact * cell
    signs[1] = _share(contact, met)
    signs[2] = _share(over, met)
    signs[3] = _share(under, met)
    signs[4] = _share(contact + near, pieces.boundary[p])
    signs[5] = _share(contact + near, pieces.boundary[q])
    signs[6] = _share(pairs[ONTO, p, q], contact)
    signs[7] = _share(pairs[ONTO, q, p], contact)
    signs[8] = _above_top(pieces, p, q)
    signs[9] = _above_top(pieces, q, p)
    signs[10] = met * cell


@kernel(leaf=True)
def _above_top(pieces: Pieces, p: int, q: int) -> float:
    """Return how far above the top of ``q`` faces up what ``p`` borders on there."""
    onto = pieces.pairs[ONTO, p, q]
    if onto == 0:
        return NOWHERE_M
    return float(pieces.pairs[ONTO_HEIGHT, p, q] / onto - pieces.shape[q, TOP])


@kernel(leaf=True)
def _traits(pieces: Pieces, p: int, signs: F4) -> None:
    """Write what one piece looks like, and what its outline is made of."""
    row, single, around = pieces.shape[p], pieces.single[p], pieces.boundary[p]
    front = back = touch = up = 0.0
    for k in range(pieces.group.size):
        front += pieces.pairs[FRONT, p, k]
        back += pieces.pairs[FRONT, k, p]
        touch += pieces.pairs[CONTACT, p, k]
    for band in range(top_band(row) + 1):
        up += pieces.lid[p, band]
    wide, tall = width_of(row), row[TOP] - row[BOTTOM]
    signs[0], signs[1], signs[2], signs[3] = wide, row[TOP], row[BOTTOM], tall
    signs[4], signs[5] = slope_of(row), roundness_of(row)
    signs[6] = _share(single[TABLE], around)
    signs[7] = _share(single[HIDDEN], around)
    signs[8] = _share(single[RIM], around)
    signs[9] = _share(single[OVER], around)
    signs[10] = _share(touch, around)
    signs[11] = _share(front, around)
    signs[12] = _share(back, around)
    signs[13] = lid_share(pieces, p, LID_M)
    signs[14] = _share(up, row[AREA])
    signs[15] = row[AREA]
    signs[16] = _share(row[AREA], wide * tall)


@kernel(leaf=True)
def _compare(a: F4, b: F4, signs: F4) -> None:
    """Write how two pieces lie to each other."""
    narrow, wide = width_of(a), width_of(b)
    most = max(narrow, wide)
    left, right = b[LEFT] - a[LEFT], a[RIGHTMOST] - b[RIGHTMOST]
    common = min(a[RIGHTMOST], b[RIGHTMOST]) - max(a[LEFT], b[LEFT])
    signs[0], signs[1] = _share(a[AREA], b[AREA]), _share(narrow, wide)
    signs[2] = _share(apart(a, b), most)
    signs[3] = behind(a, b)
    signs[4] = _share(behind(a, b), most)
    signs[5] = _share(common, min(narrow, wide))
    signs[6] = a[TOP] - b[TOP]
    signs[7] = a[BOTTOM] - b[TOP]
    signs[8] = b[BOTTOM] - a[TOP]
    signs[9] = a[BOTTOM] - b[BOTTOM]
    signs[10], signs[11] = max(left, right), min(left, right)


@kernel(leaf=True)
def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else 0.0
