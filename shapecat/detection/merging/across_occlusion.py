"""Merging across an occluder: segments of one object on two sides of what is in front of it."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import PinholeIntrinsics
from shapecat.detection.merging.segments import (
    FEW,
    SAMPLES,
    Segments,
    may_merge,
    merge,
)
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel

__all__ = ["merge_across_occluder"]

COPLANAR_M, COPLANAR = 0.006, 0.05
"""How far a sample may lie off the local plane of another: metres, and per metre between them."""
COPLANAR_COS = math.cos(math.radians(15))
PARTNERS = 0.45
"""Share of the samples of either segment that continue the other."""
LEAST_SAMPLES, MOST_LINES, STEPS = 4, 300, 8
"""Samples of a segment; lines between partners that are looked along, each in so many steps."""
FREE, BEHIND = 0.12, 0.05
"""Between them, largest share in free space or on others, least share behind something."""


@kernel
def merge_across_occluder(
    segments: Segments, inv_depth: F4, intrinsics: PinholeIntrinsics, normal: F4, labels: I4
) -> None:
    """Join segments behind the same occluder that continue each other, the best pair first."""
    n = segments.parent.size
    scores = np.zeros((n, n), np.float32)
    together = _behind_one(segments)
    for p in range(1, n):
        for q in range(p + 1, n):
            if together[p, q]:
                scores[p, q] = _continuation(segments, p, q, inv_depth, intrinsics, normal, labels)
    while True:
        best = np.argmax(scores)
        p, q = int(best // n), int(best % n)
        if scores[p, q] <= 0:
            return
        merge(segments, p, q)
        scores[q, :] = 0
        scores[:, q] = 0
        for k in range(1, n):
            if k != p:
                a, b = min(k, p), max(k, p)
                scores[a, b] = _continuation(segments, a, b, inv_depth, intrinsics, normal, labels)


@kernel
def _continuation(
    segments: Segments,
    p: int,
    q: int,
    inv_depth: F4,
    intrinsics: PinholeIntrinsics,
    normal: F4,
    labels: I4,
) -> float:
    """Return how well segment q continues segment p behind an occluder, 0..1; 0 if it does not."""
    if not may_merge(segments, p, q) or not _are_behind_one(segments, p, q):
        return 0.0
    a, b = np.zeros((SAMPLES, 6)), np.zeros((SAMPLES, 6))
    na = _positions(segments.samples[p], inv_depth, intrinsics, normal, a)
    nb = _positions(segments.samples[q], inv_depth, intrinsics, normal, b)
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
            j, i = (
                int(intrinsics.cx + intrinsics.fx * x / z + 0.5),
                int(intrinsics.cy + intrinsics.fy * y / z + 0.5),
            )
            if (
                i < 0
                or j < 0
                or i >= inv_depth.shape[0]
                or j >= inv_depth.shape[1]
                or inv_depth[i, j] <= 0
            ):
                continue
            looked += 1
            label = labels[i, j]
            if label == 0 or (segments.parent[label] != p and segments.parent[label] != q):
                before = inv_depth[i, j] - 1 / z > DISCONTINUITY
                hidden += before
                free += not before
    return share if free <= FREE * looked and hidden >= BEHIND * looked else 0.0


@kernel
def _are_behind_one(segments: Segments, p: int, q: int) -> bool:
    """Whether one thing is in front of both segments."""
    pairs = segments.pairs
    some = False
    for k in range(1, segments.parent.size):
        some |= (k != p) & (k != q) & (pairs[k, p].in_front >= FEW) & (pairs[k, q].in_front >= FEW)
    return some


@kernel
def _behind_one(segments: Segments) -> Bool:
    """Return for all pairs p < q of segments (n + 1, n + 1) what `_are_behind_one` does."""
    n = segments.parent.size
    together, hidden = np.zeros((n, n), np.bool_), np.zeros(n, np.int64)
    for k in range(1, n):
        count = 0
        for p in range(1, n):
            hidden[count] = p
            count += (p != k) & (segments.pairs[k, p].in_front >= FEW)
        for a in range(count):
            for b in range(a + 1, count):
                together[hidden[a], hidden[b]] = True
    return together


@kernel
def _find_partners(a: F8, b: F8, partners: I4) -> tuple[float, int]:
    """Write the pairs of samples that lie in each other's local plane.

    Returns the share of the samples that have a partner, of the segment with the lower one, and the
    number of pairs.
    """
    in_a, in_b = np.zeros(SAMPLES, np.uint8), np.zeros(SAMPLES, np.uint8)
    n = with_a = with_b = 0
    for s in range(len(a)):
        x, y, z, nx, ny, nz = a[s, 0], a[s, 1], a[s, 2], a[s, 3], a[s, 4], a[s, 5]
        for t in range(len(b)):
            mx, my, mz = b[t, 3], b[t, 4], b[t, 5]
            if nx * mx + ny * my + nz * mz < COPLANAR_COS:
                continue
            dx, dy, dz = b[t, 0] - x, b[t, 1] - y, b[t, 2] - z
            limit = COPLANAR_M + COPLANAR * math.sqrt(dx * dx + dy * dy + dz * dz)
            if abs(dx * nx + dy * ny + dz * nz) > limit:
                continue
            if abs(dx * mx + dy * my + dz * mz) > limit:
                continue
            with_a += in_a[s] == 0
            with_b += in_b[t] == 0
            in_a[s] = in_b[t] = 1
            partners[n, 0], partners[n, 1] = s, t
            n += 1
    return min(with_a / len(a), with_b / len(b)), n


@kernel
def _on_line(first: F8, second: F8, u: float) -> tuple[float, float, float]:
    """Return the point at the share ``u`` of the way between two samples."""
    return (
        first[0] + u * (second[0] - first[0]),
        first[1] + u * (second[1] - first[1]),
        first[2] + u * (second[2] - first[2]),
    )


@kernel
def _positions(
    samples: I4, inv_depth: F4, intrinsics: PinholeIntrinsics, normal: F4, out: F8
) -> int:
    """Write position and normal of the samples of a segment; return how many there are."""
    columns = inv_depth.shape[1]
    n = 0
    for s in samples:
        if s < 0:
            break
        i, j = s // columns, s % columns
        z = 1 / inv_depth[i, j]
        out[n, 0] = (j - intrinsics.cx) / intrinsics.fx * z
        out[n, 1] = (i - intrinsics.cy) / intrinsics.fy * z
        out[n, 2] = z
        out[n, 3], out[n, 4], out[n, 5] = normal[i, 0, j], normal[i, 1, j], normal[i, 2, j]
        n += 1
    return n
