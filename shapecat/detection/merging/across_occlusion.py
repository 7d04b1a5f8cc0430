"""Occluders: parts of one object on two sides of something in front of it."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import Lens
from shapecat.detection.merging.segment_features import roundness_of, slope_of, width_of
from shapecat.detection.merging.segments import (
    FEW,
    FRONT,
    LEFT,
    RIGHTMOST,
    SAMPLES,
    TOP,
    Pieces,
    may_join,
    merge,
)
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel

__all__ = ["join_around", "join_behind"]

COPLANAR_M, COPLANAR = 0.006, 0.05
"""How far a sample may lie off the tangent plane of another: metres, and per metre between them."""
COPLANAR_COS = math.cos(math.radians(15))
PARTNERS = 0.45
"""Share of the samples of either piece that continue the other."""
LEAST_SAMPLES, MOST_LINES, STEPS = 4, 300, 8
"""Samples of a piece; lines between partners that are looked along, each in so many steps."""
FREE, BEHIND = 0.12, 0.05
"""Between them, largest share in free space or on others, least share behind something."""
SAME_TOP_M, FLANKED, TURNING, STEADY = 0.007, 0.12, 0.7, 1.75
"""Two sides of one object: how far their tops differ; least share of the boundary of each behind
what is between them; least `roundness_of` both together, or of a hollow the negative; and how much
faster than both together either may turn, as two cans side by side do."""


@kernel
def join_behind(pieces: Pieces, w: F4, lens: Lens, normal: F4, labels: I4) -> None:
    """Join pieces behind the same occluder that continue each other, the best pair first."""
    n = pieces.group.size
    scores = np.zeros((n, n), np.float32)
    together = _behind_one(pieces)
    for p in range(1, n):
        for q in range(p + 1, n):
            if together[p, q]:
                scores[p, q] = _continuation(pieces, p, q, w, lens, normal, labels)
    while True:
        best = np.argmax(scores)
        p, q = int(best // n), int(best % n)
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
def join_around(pieces: Pieces) -> None:
    """Join what is seen of one object on the left and on the right of something in front of it.

    Neither side goes on in the other where the surface bends, but both end at one height, and
    together they turn as one round thing does, one hollow, or the faces of one box.
    """
    n = pieces.group.size
    for p in range(1, n):
        for q in range(1, n):
            if may_join(pieces, p, q) and _flank(pieces, p, q):
                merge(pieces, p, q)


@kernel
def _flank(pieces: Pieces, left: int, right: int) -> bool:
    """Whether two pieces are the left and the right side of one object behind something."""
    a, b = pieces.shape[left], pieces.shape[right]
    if abs(a[TOP] - b[TOP]) > SAME_TOP_M or a[RIGHTMOST] > b[LEFT]:
        return False
    front, boundary = pieces.pairs[FRONT], pieces.boundary
    between = False
    for k in range(1, pieces.group.size):
        x = pieces.shape[k]
        between |= (
            front[k, left] > FLANKED * boundary[left]
            and front[k, right] > FLANKED * boundary[right]
            and x[LEFT] < b[LEFT]
            and x[RIGHTMOST] > a[RIGHTMOST]
            and width_of(x) > b[LEFT] - a[RIGHTMOST]
        )
    if not between:
        return False
    both = a + b
    both[LEFT], both[RIGHTMOST] = a[LEFT], b[RIGHTMOST]
    if abs(roundness_of(both)) < TURNING:
        return False
    most = STEADY * _bend(both)
    return bool(_bend(a) / most < 1 and _bend(b) / most < 1)


@kernel(leaf=True)
def _bend(row: F4) -> float:
    """Return by how much the lateral normal of a piece changes per metre."""
    return float(slope_of(row) / max(width_of(row), 1e-3))


@kernel
def _continuation(
    pieces: Pieces, p: int, q: int, w: F4, lens: Lens, normal: F4, labels: I4
) -> float:
    """Return how well piece q continues piece p behind an occluder, 0..1; 0 if it does not."""
    if not may_join(pieces, p, q) or not _are_behind_one(pieces, p, q):
        return 0.0
    a, b = np.zeros((SAMPLES, 6)), np.zeros((SAMPLES, 6))
    na = _positions(pieces.samples[p], w, lens, normal, a)
    nb = _positions(pieces.samples[q], w, lens, normal, b)
    if na < LEAST_SAMPLES or nb < LEAST_SAMPLES:
        return 0.0
    partners = np.zeros((SAMPLES * SAMPLES, 2), np.uint8)
    share, n = _find_partners(a[:na], b[:nb], partners)
    if share < PARTNERS:
        return 0.0
    free = hidden = looked = 0
    for k in range(0, n, max(1, n // MOST_LINES)):
        first, second = a[partners[k, 0]], b[partners[k, 1]]
        for step in range(1, STEPS):
            x, y, z = _on_line(first, second, step / STEPS)
            j, i = int(lens.cx + lens.fx * x / z + 0.5), int(lens.cy + lens.fy * y / z + 0.5)
            if i < 0 or j < 0 or i >= w.shape[0] or j >= w.shape[1] or w[i, j] <= 0:
                continue
            looked += 1
            label = labels[i, j]
            if label == 0 or (pieces.group[label] != p and pieces.group[label] != q):
                before = w[i, j] - 1 / z > DISCONTINUITY
                hidden += before
                free += not before
    return share if free <= FREE * looked and hidden >= BEHIND * looked else 0.0


@kernel(leaf=True)
def _are_behind_one(pieces: Pieces, p: int, q: int) -> bool:
    """Whether one thing is in front of both pieces."""
    front = pieces.pairs[FRONT]
    some = False
    for k in range(1, pieces.group.size):
        some |= (k != p) & (k != q) & (front[k, p] >= FEW) & (front[k, q] >= FEW)
    return some


@kernel
def _behind_one(pieces: Pieces) -> Bool:
    """Return for all pairs p < q of pieces (n + 1, n + 1) what `_are_behind_one` does."""
    n = pieces.group.size
    together, hidden = np.zeros((n, n), np.bool_), np.zeros(n, np.int64)
    for k in range(1, n):
        count = 0
        for p in range(1, n):
            hidden[count] = p
            count += (p != k) & (pieces.pairs[FRONT, k, p] >= FEW)
        for a in range(count):
            for b in range(a + 1, count):
                together[hidden[a], hidden[b]] = True
    return together


@kernel
def _find_partners(a: F8, b: F8, partners: I4) -> tuple[float, int]:
    """Write the pairs of samples that lie in each other's tangent plane.

    Returns the share of the samples that have a partner, of the piece with the lower one, and the
    number of pairs.
    """
    in_a, in_b = np.zeros(len(a), np.uint8), np.zeros(len(b), np.uint8)
    n = 0
    for s in range(len(a)):
        for t in range(len(b)):
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
    return min(np.sum(in_a) / len(a), np.sum(in_b) / len(b)), n


@kernel(leaf=True)
def _on_line(first: F8, second: F8, u: float) -> tuple[float, float, float]:
    """Return the point at the share ``u`` of the way between two samples."""
    return (
        first[0] + u * (second[0] - first[0]),
        first[1] + u * (second[1] - first[1]),
        first[2] + u * (second[2] - first[2]),
    )


@kernel
def _positions(samples: I4, w: F4, lens: Lens, normal: F4, out: F8) -> int:
    """Write position and normal of the samples of a piece; return how many there are."""
    columns = w.shape[1]
    n = 0
    for s in samples:
        if s < 0:
            break
        i, j = s // columns, s % columns
        z = 1 / w[i, j]
        out[n, 0] = (j - lens.cx) / lens.fx * z
        out[n, 1] = (i - lens.cy) / lens.fy * z
        out[n, 2] = z
        out[n, 3], out[n, 4], out[n, 5] = normal[i, 0, j], normal[i, 1, j], normal[i, 2, j]
        n += 1
    return n
