"""Candidates: labelled cells become records, with boxes, supports and flags."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells, Lens
from shapecat.detection.pieces import (
    BOTTOM,
    CONTACT,
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
)
from shapecat.detection.segmentation import Segmentation
from shapecat.detection.surfaces import span_of
from shapecat.geometry import gravity_rotation, quaternion_from_rotation
from shapecat.jit import kernel

__all__ = ["Extents", "Stand", "extents_of", "occluded", "stands_of"]

OCCLUDED = 0.12
"""Share of the boundary behind something nearer that makes an object occluded."""
YAWS = 60
GAP_M, OVERLAP_M = 0.025, 0.04
"""How far the bottom of an object may seem to be above and below the top of what it stands on: what
is below is hidden, and a strip of it may go with the object."""
LIFTED_M, SUNK_M = 0.03, 0.015
"""What reaches no lower does not stand on the plane; what reaches this much lower than a surface
does not stand on that."""


class Stand(NamedTuple):
    """What a label stands on: another label or 0, at a height above its plane in metres."""

    label: int
    height_m: float


def stands_of(found: Segmentation) -> list[Stand]:
    """Return what each of the labels 1, 2, ... stands on (index 0 is label 1).

    An object stands on another when it touches surface of it that faces up, more than it touches
    the plane; or, where that contact is hidden, when it ends where the other begins.
    """
    pieces, leaders = found.pieces, found.leaders
    result = []
    met = pieces.pairs[ONTO][leaders[1:, None], leaders]
    for p, onto, k in zip(leaders[1:], met, met.argmax(axis=1), strict=True):
        best, height = 0, 0.0
        if onto[k] >= 3 and onto[k] > pieces.single[p, TABLE]:
            best, height = int(k), float(pieces.pairs[ONTO_HEIGHT, p, leaders[k]] / onto[k])
            if pieces.shape[p, BOTTOM] < height - SUNK_M:
                best, height = 0, 0.0
        elif pieces.shape[p, BOTTOM] > LIFTED_M and pieces.single[p, TABLE] <= 2:
            best = _hidden_stand(pieces, leaders, int(p))
            height = float(pieces.shape[leaders[best], TOP]) if best else 0.0
        result.append(Stand(best, height))
    return _without_cycles(result)


def _hidden_stand(pieces: Pieces, leaders: I4, p: int) -> int:
    shape = pieces.shape
    pairs = pieces.pairs
    met = pairs[CONTACT, p] + pairs[NEAR, p] + pairs[FRONT, p] + pairs[FRONT, :, p]
    overlap = shape[leaders, TOP] - shape[p, BOTTOM]
    below = (overlap > -GAP_M) & (overlap < OVERLAP_M)
    middle = (shape[p, LEFT] + shape[p, RIGHTMOST]) / 2
    beside = (shape[leaders, LEFT] < middle) & (middle < shape[leaders, RIGHTMOST])
    fits = met[leaders] * (below & beside & (leaders != p) & (leaders > 0))
    return int(np.argmax(fits)) if fits.max() >= 3 else 0


def _without_cycles(stands: list[Stand]) -> list[Stand]:
    result = list(stands)
    for k in range(len(result)):
        seen = {k + 1}
        at = result[k].label
        while at and at not in seen:
            seen.add(at)
            at = result[at - 1].label
        if at:
            result[k] = Stand(0, 0.0)
    return result


def occluded(found: Segmentation) -> list[bool]:
    """Return for each label whether something nearer hides a part of it."""
    pieces, leaders = found.pieces, found.leaders[1:]
    hidden = pieces.pairs[FRONT][:, leaders].sum(axis=0) + pieces.single[leaders, HIDDEN]
    return [bool(flag) for flag in hidden > OCCLUDED * np.maximum(pieces.boundary[leaders], 1)]


class Extents(NamedTuple):
    """How far the labels 1, 2, ... reach, one row each.

    ``center`` (n, 3), ``size`` (n, 3) and ``orientation`` (n, 4) of the upright box; ``low`` and
    ``high`` (n, 2) the first and last row and column of cells.
    """

    center: F8
    size: F8
    orientation: F8
    low: I4
    high: I4


def extents_of(cells: Cells, found: Segmentation) -> Extents:
    """Measure the upright boxes of the labels.

    The smallest box over 60 yaws, as `shapecat.geometry.upright_box`, on the outermost cells.
    """
    count = found.leaders.size - 1
    level = gravity_rotation(found.up)
    extents = Extents(
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 4)),
        np.zeros((count, 2), np.int64),
        np.zeros((count, 2), np.int64),
    )
    turned = quaternion_from_rotation(level.T)
    _extents(cells.w, cells.lens, found.labels, level, turned, extents)
    return extents


@kernel(fast=True)
def _extents(w: F4, lens: Lens, labels: I4, level: F8, turned: F8, extents: Extents) -> None:
    rows, columns = labels.shape
    count = extents.center.shape[0]
    low, high = extents.low, extents.high
    # Outermost cells, and every 4th inside (a ball's nearest point is inside its outline).
    number = np.zeros(count + 2, np.int64)
    chosen = np.zeros(labels.shape, np.uint8)
    spans = np.zeros((rows, 2), np.int64)
    for i in range(rows):
        spans[i, 0], spans[i, 1] = span_of(labels[i])
        for j in range(spans[i, 0], spans[i, 1]):
            p = labels[i, j]
            if p == 0:
                continue
            inside = (i > 0) & (j > 0) & (i + 1 < rows) & (j + 1 < columns)
            if inside:
                inside = (labels[i - 1, j] == p) & (labels[i + 1, j] == p)
                inside &= (labels[i, j - 1] == p) & (labels[i, j + 1] == p)
            if inside and (i % 4 != 0 or j % 4 != 0):
                continue
            chosen[i, j] = 1
            if number[p + 1] == 0:
                low[p - 1, 0], low[p - 1, 1] = i, j
            number[p + 1] += 1
            low[p - 1, 1] = min(low[p - 1, 1], j)
            high[p - 1, 0], high[p - 1, 1] = i, max(high[p - 1, 1], j)
    place = np.cumsum(number)
    start = place.copy()
    local = np.zeros((3, place[-1]), np.float32)
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            if chosen[i, j]:
                k = place[labels[i, j]]
                place[labels[i, j]] += 1
                z = 1 / w[i, j]
                x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
                for d in range(3):
                    local[d, k] = level[d, 0] * x + level[d, 1] * y + level[d, 2] * z
    for k in range(count):
        if start[k + 1] < start[k + 2]:
            _measure_box(local, start[k + 1], start[k + 2], level, turned, extents, k)


@kernel(fast=True, leaf=True)
def _measure_box(
    local: F4, first: int, end: int, level: F8, turned: F8, extents: Extents, k: int
) -> None:
    """Write the box of least area around some of the points (3, n), level frame."""
    xs, ys, zs = local[0, first:end], local[1, first:end], local[2, first:end]
    least = np.inf
    left = right = back = front = yaw = 0.0
    for t in range(YAWS):
        turn = t * (np.pi / 2 / YAWS)
        c, s = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        x0 = x1 = c * xs[0] + s * ys[0]
        y0 = y1 = c * ys[0] - s * xs[0]
        for n in range(xs.size):
            u, v = c * xs[n] + s * ys[n], c * ys[n] - s * xs[n]
            x0 = u if u < x0 else x0
            x1 = u if u > x1 else x1
            y0 = v if v < y0 else y0
            y1 = v if v > y1 else y1
        if (x1 - x0) * (y1 - y0) < least:
            least = (x1 - x0) * (y1 - y0)
            left, right, back, front, yaw = float(x0), float(x1), float(y0), float(y1), turn
    z0 = z1 = zs[0]
    for n in range(zs.size):
        z0 = zs[n] if zs[n] < z0 else z0
        z1 = zs[n] if zs[n] > z1 else z1
    bottom, top = np.float64(z0), np.float64(z1)
    extents.size[k] = right - left, front - back, top - bottom
    u, v, h = (left + right) / 2, (back + front) / 2, (bottom + top) / 2
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y = cos * u - sin * v, sin * u + cos * v
    for d in range(3):
        extents.center[k, d] = x * level[0, d] + y * level[1, d] + h * level[2, d]
    # The axes of the box are the level axes turned by yaw: q = q_level * q_yaw.
    x, y, z, w = turned
    cos, sin = math.cos(yaw / 2), math.sin(yaw / 2)
    if w * cos < z * sin:
        cos, sin = -cos, -sin
    extents.orientation[k, 0] = x * cos + y * sin
    extents.orientation[k, 1] = y * cos - x * sin
    extents.orientation[k, 2] = z * cos + w * sin
    extents.orientation[k, 3] = w * cos - z * sin
