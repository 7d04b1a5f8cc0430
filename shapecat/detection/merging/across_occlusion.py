"""Merging across an occluder: segments of one object on both sides of a nearer object."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import DepthGrid, back_project, project, row_and_column
from shapecat.detection.merging.segments import MIN_LINKS, SAMPLES, Segments, merge
from shapecat.detection.merging.settings import MERGING
from shapecat.jit import kernel

__all__ = ["merge_across_occluder"]


@kernel
def merge_across_occluder(segments: Segments, grid: DepthGrid, normal: F4, labels: I4) -> None:
    """Merge segments behind the same occluder that continue each other, the best pair first.

    ``segments`` are changed in place; ``normal`` (rows, 3, columns) is as in `SurfaceGraph`, and
    ``labels`` (rows, columns) int16 are the segments.
    """
    n = segments.parent.size
    scores, changed = np.zeros((n, n)), np.ones(n, np.bool_)
    while True:
        same_occluder = _find_shared_occluder(segments)
        for p in range(1, n):
            for q in range(p + 1, n):
                if not (changed[p] or changed[q]):
                    continue
                scores[p, q] = 0
                if same_occluder[p, q]:
                    a = _local_planes(segments.samples[p], grid, normal)
                    b = _local_planes(segments.samples[q], grid, normal)
                    share, lines = _find_partners(a, b)
                    if share >= MERGING.partner_share and _is_hidden(
                        segments, p, q, grid, labels, lines
                    ):
                        scores[p, q] = share
        best = np.argmax(scores)
        p, q = int(best // n), int(best % n)
        if scores[p, q] <= 0:
            return
        merge(segments, p, q)
        changed[:] = False
        changed[p] = changed[q] = True


@kernel(inline=True)
def _find_shared_occluder(segments: Segments) -> Bool:
    """Return which pairs of segments p < q share an occluder and a plane, (n + 1, n + 1) bool."""
    pairs, parent, plane_id = segments.pairs, segments.parent, segments.plane_id
    n = parent.size
    same_occluder = np.zeros((n, n), np.bool_)
    behind = np.zeros(n, np.int32)
    for k in range(1, n):
        count = 0
        for p in range(1, n):
            if parent[p] == p and pairs[k, p].in_front >= MIN_LINKS:
                behind[count] = p
                count += 1
        for a in range(count):
            for b in range(a + 1, count):
                p, q = behind[a], behind[b]
                same_occluder[p, q] |= plane_id[p] == plane_id[q]
    return same_occluder


@kernel(inner=True)
def _local_planes(samples: I4, grid: DepthGrid, normal: F4) -> F8:
    """Return the positions, metres, and normals of a segment's samples, (2, n, 3), sensor frame.

    ``samples`` (SAMPLES,) are n flat cell indices, then -1; ``normal`` is as in `SurfaceGraph`.
    """
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    n = 0
    for cell in samples:
        n += int(cell >= 0)
    planes = np.zeros((2, n, 3))
    for k in range(n):
        i, j = row_and_column(samples[k], inv_depth.shape[1])
        z = 1 / inv_depth[i, j]
        planes[0, k, 0], planes[0, k, 1] = back_project(intrinsics, i, j, z)
        planes[0, k, 2] = z
        for d in range(3):
            planes[1, k, d] = normal[i, d, j]
    return planes


@kernel(inline=True)
def _find_partners(a: F8, b: F8) -> tuple[float, F8]:
    """Find the pairs of samples of two segments that lie in each other's local planes.

    Returns the smaller of the two segments' fractions of samples with a partner, and the positions
    (n, 2, 3), metres, of some of the pairs; 0 and no pairs if a segment has too few samples. ``a``
    and ``b`` are from `_local_planes`.
    """
    with_a, with_b = np.zeros(a.shape[1], np.bool_), np.zeros(b.shape[1], np.bool_)
    pairs = np.zeros((SAMPLES * SAMPLES, 2), np.uint8)
    n = in_a = in_b = 0
    if min(with_a.size, with_b.size) < MERGING.min_samples:
        return 0.0, np.zeros((0, 2, 3))
    for s in range(with_a.size):
        for t in range(with_b.size):
            cos = distance = offset_a = offset_b = 0.0
            for d in range(3):
                step = b[0, t, d] - a[0, s, d]
                cos += a[1, s, d] * b[1, t, d]
                distance += step * step
                offset_a += step * a[1, s, d]
                offset_b += step * b[1, t, d]
            limit = MERGING.coplanar_m + MERGING.coplanar_slope * math.sqrt(distance)
            if cos >= MERGING.coplanar_cos and abs(offset_a) <= limit and abs(offset_b) <= limit:
                in_a, in_b = in_a + (not with_a[s]), in_b + (not with_b[t])
                with_a[s] = with_b[t] = True
                pairs[n, 0], pairs[n, 1] = s, t
                n += 1
    stride = max(1, -(-n // MERGING.max_lines))
    lines = np.zeros(((n + stride - 1) // stride, 2, 3))
    for k in range(len(lines)):
        s, t = pairs[k * stride]
        for d in range(3):
            lines[k, 0, d], lines[k, 1, d] = a[0, s, d], b[0, t, d]
    return min(in_a / with_a.size, in_b / with_b.size), lines


@kernel(inline=True)
def _is_hidden(segments: Segments, p: int, q: int, grid: DepthGrid, labels: I4, lines: F8) -> bool:
    """Return whether an occluder hides the lines (n, 2, 3) between two segments, at least in part.

    Only a small part of the lines may be in free space. ``lines``, metres, are from
    `_find_partners` for the segments ``p`` and ``q`` of ``labels`` (rows, columns).
    """
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    free = hidden = measured = 0
    for k in range(len(lines)):
        for step in range(1, MERGING.line_steps):
            u, a, b = step / MERGING.line_steps, lines[k, 0], lines[k, 1]
            x, y, z = a[0] + u * (b[0] - a[0]), a[1] + u * (b[1] - a[1]), a[2] + u * (b[2] - a[2])
            i, j = project(intrinsics, x, y, z)
            if i < 0 or j < 0 or i >= inv_depth.shape[0] or j >= inv_depth.shape[1]:
                continue
            owner = segments.parent[labels[i, j]]
            measured += inv_depth[i, j] > 0
            if inv_depth[i, j] > 0 and owner not in (p, q):
                occluded = inv_depth[i, j] - 1 / z > grid.discontinuity
                hidden += occluded
                free += not occluded
    return free <= MERGING.free_share * measured and hidden >= MERGING.hidden_share * measured
