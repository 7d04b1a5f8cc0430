"""Outlines of masks as polygons."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.colour.masks import Mask
from shapecat.jit import kernel

__all__ = ["joined", "outlines"]

_TOLERANCE_PX = 0.75
"""Corners that stick out by less are dropped; the steps of a slanted edge stick out by 0.71."""


def outlines(mask: Mask) -> list[F8]:
    """Return the outer outline of each connected part of a mask, the largest first.

    Holes are ignored. Pixels that touch only at a corner are not connected.

    Returns
    -------
    For each part, the column and row of its corners, (n, 2), at least three corners. The first
    pixel of the image extends from 0 to 1.

    Examples
    --------
    >>> outlines(Mask(5, 7, np.ones((2, 3), bool)))[0].tolist()
    [[5.0, 7.0], [8.0, 7.0], [8.0, 9.0], [5.0, 9.0]]
    """
    inside = np.pad(mask.pixels, 1)
    corners = np.zeros((4 * inside.size + 4, 2), np.int64)
    ends = np.zeros(inside.size + 1, np.int64)
    count = _trace(inside, corners, ends)
    rings = np.split(corners[: ends[count - 1]] if count else corners[:0], ends[: count - 1])
    valid = [ring for ring in rings if len(ring) and _area(ring) > 0]
    valid.sort(key=_area, reverse=True)
    offset = np.array([mask.left - 1, mask.top - 1])
    return [_simplified(ring.astype(np.float64)) + offset for ring in valid]


def joined(rings: Sequence[F8]) -> F8:
    """Join outlines (n, 2) into one polygon (m, 2), for formats with one polygon per object.

    A double edge links the nearest corners, as in converters of COCO data sets.
    """
    joined_ring = rings[0]
    for ring in rings[1:]:
        apart = ((joined_ring[:, None] - ring[None]) ** 2).sum(axis=-1)
        i, j = np.unravel_index(int(apart.argmin()), apart.shape)
        around = np.concatenate([ring[j:], ring[: j + 1]])
        joined_ring = np.concatenate([joined_ring[: i + 1], around, joined_ring[i:]])
    return joined_ring


def _area(ring: I4) -> float:
    """Return the area inside a clockwise ring of corners (n, 2); the area of a hole is negative."""
    x, y = ring.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2


def _simplified(ring: F8) -> F8:
    """Drop those corners of a ring (n, 2) that hardly stick out (Douglas and Peucker 1973)."""
    farthest = int(((ring - ring[0]) ** 2).sum(axis=1).argmax())
    closed = np.concatenate([ring, ring[:1]])
    keep = np.zeros(len(closed), np.bool_)
    keep[[0, farthest, -1]] = True
    _keep_far(closed, 0, farthest, keep)
    _keep_far(closed, farthest, len(closed) - 1, keep)
    simplified = closed[:-1][keep[:-1]]
    return simplified if len(simplified) >= 3 else ring


@kernel
def _keep_far(line: F8, first: int, last: int, keep: Bool) -> None:
    """Mark in ``keep`` the corners between ``first`` and ``last`` that the simplified line keeps.

    ``line`` (n, 2) are the corners, pixels; ``keep`` is (n,). Both ends must be marked already.
    """
    stack = [(first, last)]
    while len(stack) > 0:
        a, b = stack.pop()
        dx, dy = line[b, 0] - line[a, 0], line[b, 1] - line[a, 1]
        length = np.sqrt(dx * dx + dy * dy)
        worst, at = _TOLERANCE_PX, -1
        for i in range(a + 1, b):
            ex, ey = line[i, 0] - line[a, 0], line[i, 1] - line[a, 1]
            apart = abs(dx * ey - dy * ex) / length if length > 0 else np.sqrt(ex * ex + ey * ey)
            if apart > worst:
                worst, at = apart, i
        if at >= 0:
            keep[at] = True
            stack.append((a, at))
            stack.append((at, b))


@kernel
def _trace(inside: Bool, corners: I4, ends: I4) -> int:
    """Trace the borders of regions, with the inside on the right; return the number of borders.

    ``inside`` (h, w) is False along its edge. ``corners`` (n, 2) gets the column and row of the
    corners of all borders, ``ends`` (k,) the number of corners up to the end of each border. A
    border starts along the top of a pixel, to the right.
    """
    walked = np.zeros(inside.shape, np.bool_)
    count = length = 0
    for v0 in range(1, inside.shape[0] - 1):
        for u0 in range(1, inside.shape[1] - 1):
            if not inside[v0, u0] or inside[v0 - 1, u0] or walked[v0, u0]:
                continue
            u, v, du, dv = u0, v0, 1, 0
            corners[length, 0], corners[length, 1] = u, v
            length += 1
            while True:
                if du == 1:
                    walked[v, u] = True
                u, v = u + du, v + dv
                # The two pixels ahead, left and right of the border.
                left = int(inside[v + (dv - 1 - du) // 2, u + (du - 1 + dv) // 2])
                right = int(inside[v + (dv - 1 + du) // 2, u + (du - 1 - dv) // 2])
                if u == u0 and v == v0 and _turn(du, dv, left, right) == (1, 0):
                    break
                turned = _turn(du, dv, left, right)
                if turned != (du, dv):
                    corners[length, 0], corners[length, 1] = u, v
                    length += 1
                    du, dv = turned
            ends[count] = length
            count += 1
    return count


@kernel(inner=True)
def _turn(du: int, dv: int, left: int, right: int) -> tuple[int, int]:
    """Return the next direction: right if ``right`` is outside, left if both are inside, or ahead.

    The present direction is ``du``, ``dv``; ``left`` and ``right`` are the pixels ahead, 1 inside.
    """
    if not right:
        return -dv, du
    return (dv, -du) if left else (du, dv)
