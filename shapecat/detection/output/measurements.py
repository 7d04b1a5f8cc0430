"""Things: what is measured of labelled cells: boxes, what they stand on, and flags."""

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import Cells, Lens, count_last, small_at
from shapecat.detection.merging.segments import (
    BOTTOM,
    CONTACT,
    FEW,
    FRONT,
    HIDDEN,
    LEFT,
    NEAR,
    ONTO,
    ONTO_HEIGHT,
    RIGHTMOST,
    TABLE,
    TOP,
    Pieces,
    depths_of,
)
from shapecat.detection.segmentation.connectivity import span_of
from shapecat.geometry import level_axes, row_quaternion
from shapecat.jit import kernel

__all__ = ["Things", "things_of"]

OCCLUDED = 0.12
"""Share of the boundary behind something nearer that makes an object occluded."""
YAWS = np.arange(60) * (np.pi / 120)
COS, SIN = np.cos(YAWS).astype(np.float32), np.sin(YAWS).astype(np.float32)
GAP_M, OVERLAP_M = 0.025, 0.04
"""How far the bottom of an object may seem to be above and below the top of what it stands on: what
is below is hidden, and a strip of it may go with the object."""
LIFTED_M, SUNK_M = 0.03, 0.015
"""What reaches no lower does not stand on the plane; what reaches this much lower than a surface
does not stand on that."""


Turned: TypeAlias = tuple[float, float, float, float]
"""A quaternion (x, y, z, w)."""


class Things(NamedTuple):
    """What is measured of the labels 1, 2, ..., one row each.

    Attributes
    ----------
    center, size, orientation : (n, 3), (n, 3) and (n, 4) of the upright box.
    low, high : (n, 2) the first and last row and column of cells.
    stand : (n,) the label that each stands on, 0 for its plane.
    support_m : (n,) the height of that above the plane.
    hidden : (n,) whether something nearer hides a part.
    last : (n,) whether it ends where the range does, beyond which readings are left out.
    least : (n,) cells of the smallest object at that distance.
    """

    center: F8
    size: F8
    orientation: F8
    low: I4
    high: I4
    stand: I4
    support_m: F8
    hidden: Bool
    last: Bool
    least: F4


@kernel
def things_of(
    cells: Cells, labels: I4, pieces: Pieces, leaders: I4, up: F8, range_m: float
) -> Things:
    """Measure the labels, the pieces of each of which are merged into one of ``leaders``.

    The box is the smallest over 60 yaws, as `shapecat.geometry.upright_box`, on the outermost
    cells. An object stands on another when it touches surface of it that faces up, more than it
    touches the plane; or, where that contact is hidden, when it ends where the other begins.
    """
    count = leaders.size - 1
    things = Things(
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 4)),
        np.zeros((count, 2), np.int64),
        np.zeros((count, 2), np.int64),
        np.zeros(count, np.int64),
        np.zeros(count),
        np.zeros(count, np.bool_),
        np.zeros(count, np.bool_),
        np.zeros(count, np.float32),
    )
    _measure_boxes(cells.w, cells.lens, labels, np.array(level_axes(up[0], up[1], up[2])), things)
    last, depth = count_last(cells.w, labels, leaders.size, range_m), depths_of(pieces)
    for k in range(count):
        p = leaders[k + 1]
        things.last[k], things.least[k] = last[k + 1] >= FEW, small_at(cells, depth[p])
        things.stand[k], things.support_m[k] = _stand(pieces, leaders, p)
        hidden = pieces.single[p, HIDDEN]
        for q in range(pieces.group.size):
            hidden += pieces.pairs[FRONT, q, p]
        things.hidden[k] = hidden > np.float32(OCCLUDED) * max(pieces.boundary[p], np.float32(1))
    _break_cycles(things)
    return things


@kernel(leaf=True)
def _stand(pieces: Pieces, leaders: I4, p: int) -> tuple[int, float]:
    """Return what a piece stands on: a label or 0, and its height above the plane, metres."""
    onto, shape = pieces.pairs[ONTO, p], pieces.shape
    best = 0
    for k in range(1, leaders.size):
        best = k if onto[leaders[k]] > onto[leaders[best]] else best
    met = onto[leaders[best]]
    if met >= FEW and met > pieces.single[p, TABLE]:
        height = float(pieces.pairs[ONTO_HEIGHT, p, leaders[best]] / met)
        return (0, 0.0) if shape[p, BOTTOM] < height - SUNK_M else (best, height)
    if shape[p, BOTTOM] > LIFTED_M and pieces.single[p, TABLE] < FEW:
        best = _hidden_stand(pieces, leaders, p)
        return best, float(shape[leaders[best], TOP]) if best else 0.0
    return 0, 0.0


@kernel(leaf=True)
def _hidden_stand(pieces: Pieces, leaders: I4, p: int) -> int:
    """Return the label below a piece that it meets most, 0 if none."""
    shape, pairs = pieces.shape, pieces.pairs
    middle = (shape[p, LEFT] + shape[p, RIGHTMOST]) / 2
    best, most = 0, 0.0
    for k in range(1, leaders.size):
        q = leaders[k]
        met = pairs[CONTACT, p, q] + pairs[NEAR, p, q] + pairs[FRONT, p, q] + pairs[FRONT, q, p]
        overlap = shape[q, TOP] - shape[p, BOTTOM]
        below = -GAP_M < overlap < OVERLAP_M
        beside = shape[q, LEFT] < middle < shape[q, RIGHTMOST]
        if q != p and below and beside and met > most:
            best, most = k, met
    return best if most >= FEW else 0


@kernel(leaf=True)
def _break_cycles(things: Things) -> None:
    """Put what stands on itself, by way of others, on its plane."""
    stand = things.stand
    for k in range(stand.size):
        at = stand[k]
        for _ in range(stand.size):
            at = stand[at - 1] if at > 0 else 0
        if at > 0:
            stand[k], things.support_m[k] = 0, 0.0


@kernel(fast=True)
def _measure_boxes(w: F4, lens: Lens, labels: I4, level: F8, things: Things) -> None:
    points, start = _outer_points(w, lens, labels, level, things)
    back = level.T
    turned = row_quaternion(
        (back[0, 0], back[0, 1], back[0, 2]),
        (back[1, 0], back[1, 1], back[1, 2]),
        (back[2, 0], back[2, 1], back[2, 2]),
    )
    reach = np.zeros(4 * YAWS.size, np.float32)
    for k in range(start.size - 1):
        if start[k] < start[k + 1]:
            _measure_box(points, start[k], start[k + 1], level, turned, things, k, reach)


@kernel(fast=True)
def _outer_points(w: F4, lens: Lens, labels: I4, level: F8, things: Things) -> tuple[F4, I4]:
    """Return some cells of each label in the level frame (3, n), and where each label begins.

    They are the outermost, of which come `Things.low` and `Things.high`, and every 4th inside: the
    nearest point of a ball is inside its outline.
    """
    rows, columns = labels.shape
    low, high = things.low, things.high
    spans, outer = np.zeros((rows, 2), np.int64), np.zeros(columns, np.bool_)
    for i in range(rows):
        spans[i, 0], spans[i, 1] = span_of(labels[i])
    chosen, n = np.zeros((np.sum(spans[:, 1] - spans[:, 0]), 2), np.int32), 0
    start = np.zeros(low.shape[0] + 1, np.int64)
    for i in range(rows):
        first, end = spans[i]
        _find_outer(labels, i, first, end, outer)
        for j in range(first, end):
            if outer[j]:
                k = labels[i, j] - 1
                if start[k + 1] == 0:
                    low[k] = i, j
                start[k + 1] += 1
                low[k, 1] = min(low[k, 1], j)
                high[k, 0], high[k, 1] = i, max(high[k, 1], j)
                chosen[n, 0], chosen[n, 1] = i, j
                n += 1
    start = np.cumsum(start)
    place, points = start.copy(), np.zeros((3, n), np.float32)
    for i, j in chosen[:n]:
        k = labels[i, j] - 1
        z = 1 / w[i, j]
        x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
        for d in range(3):
            points[d, place[k]] = level[d, 0] * x + level[d, 1] * y + level[d, 2] * z
        place[k] += 1
    return points, start


@kernel(leaf=True)
def _find_outer(labels: I4, i: int, first: int, end: int, outer: Bool) -> None:
    """Mark the labelled cells of a part of a row that are next to others, and every 4th inside."""
    rows, columns = labels.shape
    if i == 0 or i == rows - 1:
        for j in range(first, end):
            outer[j] = labels[i, j] > 0
        return
    a, b = max(first, 1), min(end, columns - 1)
    here, above, below = labels[i, a:b], labels[i - 1, a:b], labels[i + 1, a:b]
    left, right, out = labels[i, a - 1 : b - 1], labels[i, a + 1 : b + 1], outer[a:b]
    for j in range(here.size):
        edge = (above[j] != here[j]) | (below[j] != here[j])
        edge |= (left[j] != here[j]) | (right[j] != here[j])
        out[j] = edge & (here[j] > 0)
    outer[0], outer[columns - 1] = labels[i, 0] > 0, labels[i, columns - 1] > 0
    if i % 4 == 0:
        for j in range(first + -first % 4, end, 4):
            outer[j] = labels[i, j] > 0


@kernel(fast=True, leaf=True)
def _measure_box(
    local: F4, first: int, end: int, level: F8, turned: Turned, things: Things, k: int, reach: F4
) -> None:
    """Write the box of least area around some of the points (3, n), level frame."""
    zs = local[2, first:end]
    _reach(local[0, first:end], local[1, first:end], reach)
    least = np.inf
    left = right = back = front = yaw = 0.0
    for t in range(YAWS.size):
        x0, x1 = reach[t], reach[t + YAWS.size]
        y0, y1 = reach[t + 2 * YAWS.size], reach[t + 3 * YAWS.size]
        if (x1 - x0) * (y1 - y0) < least:
            least = (x1 - x0) * (y1 - y0)
            left, right, back, front, yaw = float(x0), float(x1), float(y0), float(y1), YAWS[t]
    z0 = z1 = zs[0]
    for n in range(zs.size):
        z0 = zs[n] if zs[n] < z0 else z0
        z1 = zs[n] if zs[n] > z1 else z1
    bottom, top = np.float64(z0), np.float64(z1)
    things.size[k] = right - left, front - back, top - bottom
    u, v, h = (left + right) / 2, (back + front) / 2, (bottom + top) / 2
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y = cos * u - sin * v, sin * u + cos * v
    for d in range(3):
        things.center[k, d] = x * level[0, d] + y * level[1, d] + h * level[2, d]
    # The axes of the box are the level axes turned by yaw: q = q_level * q_yaw.
    x, y, z, w = turned
    cos, sin = math.cos(yaw / 2), math.sin(yaw / 2)
    if w * cos < z * sin:
        cos, sin = -cos, -sin
    things.orientation[k, 0] = x * cos + y * sin
    things.orientation[k, 1] = y * cos - x * sin
    things.orientation[k, 2] = z * cos + w * sin
    things.orientation[k, 3] = w * cos - z * sin


@kernel(fast=True, leaf=True)
def _reach(xs: F4, ys: F4, reach: F4) -> None:
    """Write for each yaw the least and greatest place of points along it, and the same across it.

    All yaws are turned to at once, one point after the other: this vectorises.
    """
    n = YAWS.size
    reach[:n], reach[n : 2 * n], reach[2 * n : 3 * n], reach[3 * n :] = (
        np.inf,
        -np.inf,
        np.inf,
        -np.inf,
    )
    for k in range(xs.size):
        x, y = xs[k], ys[k]
        for t in range(n):
            u, v = COS[t] * x + SIN[t] * y, COS[t] * y - SIN[t] * x
            reach[t] = u if u < reach[t] else reach[t]
            reach[t + n] = u if u > reach[t + n] else reach[t + n]
            reach[t + 2 * n] = v if v < reach[t + 2 * n] else reach[t + 2 * n]
            reach[t + 3 * n] = v if v > reach[t + 3 * n] else reach[t + 3 * n]
