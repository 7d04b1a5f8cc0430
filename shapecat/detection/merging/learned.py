"""Learned merging: boosted trees tell whether two adjacent segments are of one object.

Relations between surface patches, learned: Richtsfeld et al. 2012, 2014; the trees are grown on
simulated scenes.

A bottle and its neck, a plate and its foot, a cup and its handle, the halves of a toy: many weak
features together tell them from what only touches or stands on it, and no few of them do.
"""

from functools import cache
from importlib.resources import files
from io import BytesIO
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.merging.segment_features import (
    TOP_DEPTH_M,
    depth_difference,
    lateral_curvature,
    lateral_distance,
    normal_position_correlation,
    top_area_share,
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
    Segments,
    may_merge,
    merge,
)
from shapecat.jit import kernel

__all__ = [
    "FEATURES",
    "FILE",
    "BoostedTrees",
    "ViewGeometry",
    "are_adjacent",
    "load_trees",
    "merge_learned",
    "pair_features",
]

FILE = "parts.npz"
LIKELY = 0.6
"""Logit, of 0.65, from which on two segments are taken for parts of one object: a wrong join loses
two objects, a missing one seldom one."""
HOPELESS = -4.0
"""Logit of the first trees that the others never made up for; half of the pairs end so early."""
ADJACENCY_FEATURES = (
    "contact, m", "contact", "first in front", "second in front", "along first", "along second",
    "second faces up", "first faces up", "and so far above its top", "the same of the first",
    "border, m",
)  # fmt: skip
"""Signs of a border: lengths, or shares of it; of either outline; of the contact; metres."""
SEGMENT_FEATURES = (
    "width", "top", "bottom", "height", "slope", "roundness", "plane", "hidden", "rim", "over",
    "touching", "in front", "behind", "lid", "facing up", "area", "fill",
)  # fmt: skip
"""Signs of either segment: metres; `lateral_curvature`, `normal_position_correlation`; shares of
its outline; `top_area_share`, shares of its area and of its width times its height."""
RELATION_FEATURES = (
    "area by area", "width by width", "apart", "behind, m", "behind", "overlap", "top over top",
    "bottom over top", "other bottom over top", "bottom over bottom", "most beyond", "least beyond",
    "slope", "roundness", "cells", "cell, m", "down",
)  # fmt: skip
"""Signs of how two segments lie to each other, of both together, and of how well they are seen."""
FIRST = len(ADJACENCY_FEATURES)
SECOND = FIRST + len(SEGMENT_FEATURES)
LAST = SECOND + len(SEGMENT_FEATURES)
FEATURES = LAST + len(RELATION_FEATURES)
"""Number of features, and where those of the first and the second segment and of both begin."""
FACING_M, FACING = 0.015, 0.5
"""What faces each other: difference of the tops, metres; least share of the narrower one's width
that has the other one before or behind it."""
LANES = 8
"""Trees that are walked at the same time: one waits for memory while the others go on."""
NOWHERE_M = -1.0
"""Height of what faces up across a border where nothing does, metres."""


class BoostedTrees(NamedTuple):
    """Boosted trees, whose leaves add up to the logit that two segments are parts of one object.

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


class ViewGeometry(NamedTuple):
    """How things are seen.

    ``focal`` length in cells; ``down`` the cosine between the optical axis and up, its third part.
    """

    focal: float
    down: float


@cache
def load_trees() -> BoostedTrees:
    """Return the trees that belong to this version."""
    content = files("shapecat.detection.merging").joinpath(FILE).read_bytes()
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return BoostedTrees(*(arrays[name] for name in BoostedTrees._fields))


@kernel
def merge_learned(segments: Segments, view_geometry: ViewGeometry, grown: BoostedTrees) -> None:
    """Join segments that are likely parts of one object, the likeliest first."""
    n = segments.parent.size
    logits = np.full((n, n), -np.inf)
    features = np.zeros(FEATURES, np.float32)
    for p in range(1, n):
        for q in range(p + 1, n):
            if are_adjacent(segments, p, q):
                pair_features(segments, p, q, view_geometry, features)
                logits[p, q] = logit_of(grown, features)
    while True:
        best = np.argmax(logits)
        p, q = int(best // n), int(best % n)
        if logits[p, q] < LIKELY:
            return
        merge(segments, p, q)
        for k in range(1, n):
            logits[q, k] = logits[k, q] = logits[k, p] = logits[p, k] = -np.inf
            if are_adjacent(segments, p, k):
                pair_features(segments, p, k, view_geometry, features)
                logits[min(p, k), max(p, k)] = logit_of(grown, features)


@kernel(leaf=True)
def are_adjacent(segments: Segments, p: int, q: int) -> bool:
    """Whether two segments above one plane touch, one hides the other, or they face each other."""
    if not may_merge(segments, p, q):
        return False
    pairs = segments.pairs
    met = pairs[CONTACT, p, q] + pairs[NEAR, p, q] + pairs[FRONT, p, q] + pairs[FRONT, q, p]
    return bool(met >= FEW or _face(segments.shape[p], segments.shape[q]))


@kernel(leaf=True)
def _face(a: F4, b: F4) -> bool:
    """Whether two segments may be the near and the far wall of a pot: these touch nowhere."""
    narrow, wide = min(width_of(a), width_of(b)), max(width_of(a), width_of(b))
    common = min(a[RIGHTMOST], b[RIGHTMOST]) - max(a[LEFT], b[LEFT])
    level = abs(a[TOP] - b[TOP]) < FACING_M
    return bool(level and common > FACING * narrow and abs(depth_difference(a, b)) < wide)


@kernel
def logit_of(grown: BoostedTrees, features: F4) -> float:
    nodes = np.zeros(LANES, np.int32)
    logit = 0.0
    for first in range(0, grown.roots.size, LANES):
        lanes = min(LANES, grown.roots.size - first)
        nodes[:lanes] = grown.roots[first : first + lanes]
        while _descend(grown, features, nodes):
            pass
        for lane in range(lanes):
            logit += grown.value[nodes[lane]]
            if logit < HOPELESS:
                return float(logit)
    return float(logit)


@kernel(leaf=True)
def _descend(grown: BoostedTrees, features: F4, nodes: I4) -> bool:
    """Go down one level in each of `LANES` trees; whether any was not in a leaf."""
    inner = False
    for lane in range(LANES):
        node = np.uint32(nodes[lane])  # unsigned numbers cannot count from the end: no test for it
        left = grown.left[node]
        right = features[np.uint16(grown.feature[node])] > grown.threshold[node]
        nodes[lane] = left + np.int32(right) if left > 0 else nodes[lane]
        inner |= left > 0
    return inner


@kernel
def pair_features(
    segments: Segments, p: int, q: int, view_geometry: ViewGeometry, features: F4
) -> None:
    """Write the `FEATURES` of two segments, the smaller one first; lengths in metres."""
    first, second = segments.shape[p, AREA], segments.shape[q, AREA]
    if first > second or (first == second and p > q):
        p, q = q, p
    cell = segments.shape[p, FAR] / segments.shape[p, COUNT] / view_geometry.focal
    _adjacency_features(segments, p, q, cell, features[:FIRST])
    _segment_features(segments, p, features[FIRST:SECOND])
    _segment_features(segments, q, features[SECOND:LAST])
    a, b = segments.shape[p], segments.shape[q]
    both = features[LAST:]
    _relation_features(a, b, both)
    whole = a + b
    whole[LEFT], whole[RIGHTMOST] = min(a[LEFT], b[LEFT]), max(a[RIGHTMOST], b[RIGHTMOST])
    both[12], both[13] = lateral_curvature(whole), normal_position_correlation(whole)
    both[14], both[15], both[16] = a[COUNT], cell, view_geometry.down


@kernel(leaf=True)
def _adjacency_features(segments: Segments, p: int, q: int, cell: float, features: F4) -> None:
    """Write what is where two segments meet."""
    pairs = segments.pairs
    contact, near = pairs[CONTACT, p, q], pairs[NEAR, p, q]
    over, under = pairs[FRONT, p, q], pairs[FRONT, q, p]
    met = contact + near + over + under
    features[0] = contact * cell
    features[1] = _share(contact, met)
    features[2] = _share(over, met)
    features[3] = _share(under, met)
    features[4] = _share(contact + near, segments.boundary[p])
    features[5] = _share(contact + near, segments.boundary[q])
    features[6] = _share(pairs[ONTO, p, q], contact)
    features[7] = _share(pairs[ONTO, q, p], contact)
    features[8] = _above_top(segments, p, q)
    features[9] = _above_top(segments, q, p)
    features[10] = met * cell


@kernel(leaf=True)
def _above_top(segments: Segments, p: int, q: int) -> float:
    """Return how far above the top of ``q`` faces up what ``p`` borders on there."""
    onto = segments.pairs[ONTO, p, q]
    if onto == 0:
        return NOWHERE_M
    return float(segments.pairs[ONTO_HEIGHT, p, q] / onto - segments.shape[q, TOP])


@kernel(leaf=True)
def _segment_features(segments: Segments, p: int, features: F4) -> None:
    """Write what one segment looks like, and what its outline is made of."""
    row, single, around = segments.shape[p], segments.single[p], segments.boundary[p]
    front = back = touch = up = 0.0
    for k in range(segments.parent.size):
        front += segments.pairs[FRONT, p, k]
        back += segments.pairs[FRONT, k, p]
        touch += segments.pairs[CONTACT, p, k]
    for band in range(top_band(row) + 1):
        up += segments.top_area[p, band]
    wide, tall = width_of(row), row[TOP] - row[BOTTOM]
    features[0], features[1], features[2], features[3] = wide, row[TOP], row[BOTTOM], tall
    features[4], features[5] = lateral_curvature(row), normal_position_correlation(row)
    features[6] = _share(single[TABLE], around)
    features[7] = _share(single[HIDDEN], around)
    features[8] = _share(single[RIM], around)
    features[9] = _share(single[OVER], around)
    features[10] = _share(touch, around)
    features[11] = _share(front, around)
    features[12] = _share(back, around)
    features[13] = top_area_share(segments, p, TOP_DEPTH_M)
    features[14] = _share(up, row[AREA])
    features[15] = row[AREA]
    features[16] = _share(row[AREA], wide * tall)


@kernel(leaf=True)
def _relation_features(a: F4, b: F4, features: F4) -> None:
    """Write how two segments lie to each other."""
    narrow, wide = width_of(a), width_of(b)
    most = max(narrow, wide)
    left, right = b[LEFT] - a[LEFT], a[RIGHTMOST] - b[RIGHTMOST]
    common = min(a[RIGHTMOST], b[RIGHTMOST]) - max(a[LEFT], b[LEFT])
    features[0], features[1] = _share(a[AREA], b[AREA]), _share(narrow, wide)
    features[2] = _share(lateral_distance(a, b), most)
    features[3] = depth_difference(a, b)
    features[4] = _share(depth_difference(a, b), most)
    features[5] = _share(common, min(narrow, wide))
    features[6] = a[TOP] - b[TOP]
    features[7] = a[BOTTOM] - b[TOP]
    features[8] = b[BOTTOM] - a[TOP]
    features[9] = a[BOTTOM] - b[BOTTOM]
    features[10], features[11] = max(left, right), min(left, right)


@kernel(leaf=True)
def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else 0.0
