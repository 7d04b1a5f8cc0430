"""Joins: the rules that bring the pieces of one object together."""

import math
from collections.abc import Collection

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.cells import JUMP, Cells, Lens
from shapecat.detection.pieces import (
    BAND_M,
    BOTTOM,
    CONTACT,
    COUNT,
    FRONT,
    HIDDEN,
    LEFT,
    NEAR,
    ONTO,
    RIGHTMOST,
    SAMPLES,
    SIDE,
    SIDE2,
    SIDETURN,
    TABLE,
    TOP,
    TURN,
    Pieces,
    merge,
)
from shapecat.detection.surfaces import Surfaces
from shapecat.jit import kernel

__all__ = ["join_pieces"]

FEW = 3
"""Links between two pieces that are taken for a contact rather than for noise."""
SAME_TOP_M = 0.015
SAME_SIDE_M, SAME_SIDE = 0.012, 0.25
HOLLOW = -0.25
BENT, INSIDE, INSIDE_SHARE = -0.15, -0.4, 0.12
FLOOR_SHARE = 0.6
CUT_SIDE = 0.6
LID_M, LID = 0.02, 0.25
COPLANAR_M, COPLANAR = 0.006, 0.05
COPLANAR_COS = 0.966
PARTNERS = 0.45
PART = 0.35
NECK_WIDTH, NECK_OVERLAP_M, NECK_APART, ROUND = 0.55, 0.03, 0.12, 0.8
NECK_LEDGE = 0.1


def join_pieces(
    pieces: Pieces, cells: Cells, surfaces: Surfaces, labels: I4, rules: Collection[str]
) -> None:
    """Apply the rules named in ``rules``, in their order; `Pieces.group` holds the result."""
    if "small" in rules:
        _join_small(pieces, cells.small)
    if "occluder" in rules:
        _join_behind(pieces, cells.w, cells.lens, surfaces.normal, labels)
    if "hollow" in rules:
        _join_hollow(pieces)
    if "rim" in rules:
        _join_rims(pieces)
    if "neck" in rules:
        _join_necks(pieces)
    if "float" in rules:
        _join_floating(pieces)
    if "enclosed" in rules:
        _join_enclosed(pieces)


@kernel
def _alive(pieces: Pieces, p: int) -> bool:
    return pieces.group[p] == p


@kernel
def _join_small(pieces: Pieces, small: int) -> None:
    """A piece smaller than about 9 cm2 belongs to what it touches most."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not _alive(pieces, p) or pieces.shape[p, COUNT] >= small:
                continue
            q = np.argmax(pieces.pairs[CONTACT, p])
            if pieces.pairs[CONTACT, p, q] > 0:
                merge(pieces, q, p)
                again = True


@kernel
def _join_behind(pieces: Pieces, w: F4, lens: Lens, normal: F4, labels: I4) -> None:
    """Two pieces behind the same occluder that continue each other are one (best pair first)."""
    n = pieces.group.size
    scores = np.zeros((n, n), np.float32)
    for p in range(1, n):
        for q in range(p + 1, n):
            scores[p, q] = _continuation(pieces, p, q, w, lens, normal, labels)
    while True:
        best = np.argmax(scores)
        p, q = best // n, best % n
        if scores[p, q] <= 0:
            return
        merge(pieces, p, q)
        scores[q, :] = 0
        scores[:, q] = 0
        for k in range(1, n):
            if k != p:
                a, b = min(k, p), max(k, p)
                scores[a, b] = _continuation(pieces, a, b, w, lens, normal, labels)


@kernel
def _continuation(
    pieces: Pieces, p: int, q: int, w: F4, lens: Lens, normal: F4, labels: I4
) -> float:
    """Return how well piece q continues piece p behind an occluder, 0..1; 0 if it does not."""
    if not (_alive(pieces, p) and _alive(pieces, q)) or pieces.owner[p] != pieces.owner[q]:
        return 0.0
    # (a) one thing is in front of both
    front = pieces.pairs[FRONT]
    between = False
    for k in range(1, pieces.group.size):
        between |= (k != p) & (k != q) & (front[k, p] >= FEW) & (front[k, q] >= FEW)
    if not between:
        return 0.0
    # (b) many samples of each lie in tangent planes of the other
    columns = w.shape[1]
    a, b = np.zeros((SAMPLES, 6)), np.zeros((SAMPLES, 6))
    na = _positions(pieces.samples[p], w, lens, normal, columns, a)
    nb = _positions(pieces.samples[q], w, lens, normal, columns, b)
    if na < 4 or nb < 4:
        return 0.0
    in_a, in_b = np.zeros(SAMPLES, np.uint8), np.zeros(SAMPLES, np.uint8)
    partners = np.zeros((SAMPLES * SAMPLES, 2), np.uint8)
    n = 0
    for s in range(na):
        for t in range(nb):
            if a[s, 3] * b[t, 3] + a[s, 4] * b[t, 4] + a[s, 5] * b[t, 5] < COPLANAR_COS:
                continue
            dx, dy, dz = b[t, 0] - a[s, 0], b[t, 1] - a[s, 1], b[t, 2] - a[s, 2]
            limit = COPLANAR_M + COPLANAR * math.sqrt(dx * dx + dy * dy + dz * dz)
            if abs(dx * a[s, 3] + dy * a[s, 4] + dz * a[s, 5]) > limit:
                continue
            if abs(dx * b[t, 3] + dy * b[t, 4] + dz * b[t, 5]) > limit:
                continue
            in_a[s] = 1
            in_b[t] = 1
            partners[n, 0], partners[n, 1] = s, t
            n += 1
    share = min(np.sum(in_a) / na, np.sum(in_b) / nb)
    if share < PARTNERS:
        return 0.0
    # (c) between them nothing else is seen, and something hides them
    free = hidden = looked = 0
    for k in range(0, n, max(1, n // 300)):
        first, second = a[partners[k, 0]], b[partners[k, 1]]
        for step in range(1, 8):
            u = step / 8
            z = first[2] + u * (second[2] - first[2])
            x, y = first[0] + u * (second[0] - first[0]), first[1] + u * (second[1] - first[1])
            j, i = int(lens.cx + lens.fx * x / z + 0.5), int(lens.cy + lens.fy * y / z + 0.5)
            if i < 0 or j < 0 or i >= w.shape[0] or j >= columns or w[i, j] <= 0:
                continue
            looked += 1
            label = labels[i, j]
            if label > 0 and (pieces.group[label] == p or pieces.group[label] == q):
                continue
            if w[i, j] - 1 / z > JUMP:
                hidden += 1
            else:
                free += 1
    return share if free <= 0.12 * looked and hidden >= 0.05 * looked else 0.0


@kernel
def _positions(samples: I4, w: F4, lens: Lens, normal: F4, columns: int, out: F4) -> int:
    n = 0
    for s in samples:
        if s < 0:
            break
        i, j = s // columns, s % columns
        z = 1 / w[i, j]
        out[n, 0] = (j - lens.cx) / lens.fx * z
        out[n, 1] = (i - lens.cy) / lens.fy * z
        out[n, 2] = z
        out[n, 3], out[n, 4], out[n, 5] = normal[i, j, 0], normal[i, j, 1], normal[i, j, 2]
        n += 1
    return n


@kernel
def _slope(row: F4) -> float:
    """Return by how much the lateral normal changes across a piece: 2 for a whole cylinder seen
    from outside, -2 from inside, 0 for a plane."""
    spread = row[SIDE2] - row[SIDE] * row[SIDE] / row[COUNT]
    slope = (row[SIDETURN] - row[SIDE] * row[TURN] / row[COUNT]) / max(spread, 1e-9)
    return slope * (row[RIGHTMOST] - row[LEFT])


@kernel
def _join_hollow(pieces: Pieces) -> None:
    """The walls and the floor inside a container meet in concave edges and are one."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            for q in range(1, n):
                if (
                    p != q
                    and _alive(pieces, p)
                    and _alive(pieces, q)
                    and pieces.owner[p] == pieces.owner[q]
                    and (_is_inside(pieces, p, q) or _is_floor(pieces, p, q))
                ):
                    merge(pieces, p, q)
                    again = True


@kernel
def _is_inside(pieces: Pieces, p: int, q: int) -> bool:
    """Whether two pieces that touch are walls facing each other."""
    if pieces.shape[p, COUNT] < pieces.shape[q, COUNT]:
        return False
    contact = pieces.pairs[CONTACT, p, q]
    if contact < max(FEW, INSIDE_SHARE * min(pieces.boundary[p], pieces.boundary[q])):
        return False
    a, b = pieces.shape[p], pieces.shape[q]
    if _slope(a) > BENT or _slope(b) > BENT:
        return False
    both = a + b
    both[LEFT], both[RIGHTMOST] = min(a[LEFT], b[LEFT]), max(a[RIGHTMOST], b[RIGHTMOST])
    return _slope(both) < INSIDE


@kernel
def _is_floor(pieces: Pieces, p: int, q: int) -> bool:
    """Whether ``q`` lies within the hollow piece ``p`` and lower."""
    if pieces.shape[q, TOP] > pieces.shape[p, TOP] or _slope(pieces.shape[p]) > HOLLOW:
        return False
    shared = pieces.pairs[CONTACT, p, q] + pieces.pairs[FRONT, p, q]
    return shared > FLOOR_SHARE * pieces.boundary[q] and pieces.pairs[CONTACT, p, q] >= FEW


@kernel
def _join_rims(pieces: Pieces) -> None:
    """The far inside wall of a container belongs to its outside."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for inside in range(1, n):
            for outside in range(1, n):
                if inside != outside and _is_container(pieces, inside, outside):
                    merge(pieces, outside, inside)
                    again = True


@kernel
def _is_container(pieces: Pieces, inside: int, outside: int) -> bool:
    if not (_alive(pieces, inside) and _alive(pieces, outside)):
        return False
    pairs = pieces.pairs
    touch = pairs[CONTACT, inside, outside] + pairs[NEAR, inside, outside]
    if max(touch, pairs[FRONT, outside, inside]) < FEW:
        return False
    a, x = pieces.shape[outside], pieces.shape[inside]
    if pieces.owner[outside] != pieces.owner[inside] or abs(a[TOP] - x[TOP]) > SAME_TOP_M:
        return False
    inner = x[RIGHTMOST] - x[LEFT]
    width = max(a[RIGHTMOST] - a[LEFT], inner)
    # An outside that something hides a part of may be wider than it looks.
    cut = np.sum(pairs[FRONT, :, outside]) - pairs[FRONT, inside, outside] >= 2 * FEW
    slack = max(SAME_SIDE_M, (CUT_SIDE if cut else SAME_SIDE) * width)
    if x[LEFT] < a[LEFT] - slack or x[RIGHTMOST] > a[RIGHTMOST] + slack:
        return False
    if _slope(x) > HOLLOW:
        return False
    return not (_has_lid(pieces, outside) or _has_lid(pieces, inside))


@kernel
def _has_lid(pieces: Pieces, p: int) -> bool:
    """Whether the top of a piece is closed by a surface that faces up."""
    row = pieces.shape[p]
    top = min(int(row[TOP] / BAND_M), pieces.lid.shape[1] - 1)
    area = 0.0
    for band in range(max(top - int(LID_M / BAND_M), 0), top + 1):
        area += pieces.lid[p, band]
    return area > LID * (row[RIGHTMOST] - row[LEFT]) ** 2


@kernel
def _join_necks(pieces: Pieces) -> None:
    """A narrow round piece over the middle of a round one without a lid is its neck."""
    n = pieces.group.size
    for p in range(1, n):
        for q in range(1, n):
            if p != q and _alive(pieces, p) and _alive(pieces, q) and _is_neck(pieces, p, q):
                merge(pieces, q, p)
                break


@kernel
def _is_neck(pieces: Pieces, p: int, q: int) -> bool:
    a, b = pieces.shape[p], pieces.shape[q]
    met = pieces.pairs[CONTACT, p, q] + pieces.pairs[NEAR, p, q] + pieces.pairs[FRONT, p, q]
    if met < FEW or pieces.owner[p] != pieces.owner[q] or pieces.single[p, TABLE] > 2:
        return False
    narrow, wide = a[RIGHTMOST] - a[LEFT], b[RIGHTMOST] - b[LEFT]
    ledge = pieces.pairs[ONTO, p, q] > NECK_LEDGE * pieces.pairs[CONTACT, p, q]
    if (
        narrow > (NECK_WIDTH if ledge else 1.0) * wide
        or a[TOP] < b[TOP]
        or a[BOTTOM] < b[TOP] - NECK_OVERLAP_M
    ):
        return False
    apart = abs(a[LEFT] + a[RIGHTMOST] - b[LEFT] - b[RIGHTMOST]) / 2
    if apart > NECK_APART * wide or _slope(a) < ROUND / 2 or _slope(b) < ROUND:
        return False
    return not _has_lid(pieces, q)


@kernel
def _join_floating(pieces: Pieces) -> None:
    """A piece that stands on nothing and is seen whole is a part of what it touches."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not _alive(pieces, p):
                continue
            contact = pieces.pairs[CONTACT, p]
            total = np.sum(contact)
            q = np.argmax(contact)
            hidden = np.sum(pieces.pairs[FRONT, :, p]) + pieces.single[p, HIDDEN]
            if (
                total >= FEW
                and pieces.single[p, TABLE] <= 2
                and hidden < 0.1 * pieces.boundary[p]
                and np.sum(pieces.pairs[ONTO, p]) < 0.25 * total
                and pieces.shape[p, COUNT] < PART * pieces.shape[q, COUNT]
            ):
                merge(pieces, q, p)
                again = True


@kernel
def _join_enclosed(pieces: Pieces) -> None:
    """A lower piece almost surrounded by one taller piece lies inside it."""
    n = pieces.group.size
    pairs = pieces.pairs
    for p in range(1, n):
        if not _alive(pieces, p):
            continue
        for q in range(1, n):
            if q == p or not _alive(pieces, q):
                continue
            shared = (
                pairs[CONTACT, p, q] + pairs[NEAR, p, q] + pairs[FRONT, p, q] + pairs[FRONT, q, p]
            )
            if (
                shared >= 0.8 * pieces.boundary[p]
                and pairs[FRONT, q, p] >= 0.15 * pieces.boundary[p]
                and pairs[FRONT, p, q] < 0.1 * pieces.boundary[p]
                and pieces.shape[q, TOP] > pieces.shape[p, TOP]
            ):
                merge(pieces, q, p)
                break
