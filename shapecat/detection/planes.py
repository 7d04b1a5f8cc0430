"""Planes: the horizontal levels of the scene and their outlines (thesis 4.3, Alg. 1)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, Bool
from shapecat.detection.cells import Cells, Lens
from shapecat.detection.consensus import (
    TOLERANCE,
    Readings,
    among,
    consensus,
    cosine,
    count_near,
    level_plane,
    middle_of,
    normal_of,
    refit,
    triples_of,
)
from shapecat.geometry import gravity_rotation, level_axes
from shapecat.jit import kernel

__all__ = [
    "ARM",
    "COS",
    "DIRECTIONS",
    "SIN",
    "Support",
    "by_height",
    "corners_of",
    "find_planes",
    "fullest",
    "support_of",
]

DIRECTIONS = 16
"""Sides of the convex outline of a plane."""
ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COS, SIN = np.cos(ANGLES), np.sin(ANGLES)
NEXT = np.roll(np.arange(DIRECTIONS), -1)
MARGIN_M = 0.01
"""An outline reaches this far beyond the readings."""
BIN_M = 0.01
MOST_LEVELS = 10
LEAST_CELLS = 100
MOST_HEIGHTS = 500
"""About as many readings tell the height of a level to begin with."""
LEAST_AREA_M2 = 0.02
LEVEL_COS2 = 0.82
"""Squared cosine of the largest angle, 25 degrees, of a level reading to the horizontal."""
STEADY_COS = math.cos(math.radians(6))
CLOSE, CLOSE_SHARE = 0.5, 0.75
"""Of the readings near a plane, less than this share is so close to one that is tilted between
two: a table and the plates on it."""
ARM = 3
"""Cells to each side over which a surface is seen to be level; odd."""
BEND = 0.024
GRAZING_SIN2 = 0.04
"""Squared sine of the angle, 11.5 degrees, below which a surface is seen at a grazing angle."""


class Support(NamedTuple):
    """A horizontal plane that objects may stand on, in units of cells.

    ``a * j + b * i + c`` is its inverse depth at cell (i, j); ``up`` (3,) its unit normal in the
    sensor frame and ``offset`` its height along ``up``; ``reach`` (DIRECTIONS,) how far it extends
    along evenly spaced directions of the level frame, metres; ``area_m2`` its visible area.
    """

    a: float
    b: float
    c: float
    up: F8
    offset: float
    reach: F8
    area_m2: float


def find_planes(cells: Cells, up: F8, rng: np.random.Generator) -> list[tuple[Support, Readings]]:
    """Return the horizontal planes of the scene, lowest first, each with its readings."""
    w, lens = cells.w, cells.lens
    # (1), (2) readings whose surface is level
    level, height, order, starts = _level_readings(w, lens, up)
    # (3) one plane candidate for each accumulation in height
    done = np.zeros(starts.size - 1, np.bool_)
    supports: list[tuple[Support, Readings]] = []
    for _ in range(MOST_LEVELS):
        near, plane, count, close = _next_level(lens, up, level, height, order, starts, done)
        if near.w.size < LEAST_CELLS:
            break
        if count < LEAST_CELLS:
            continue
        # (4) refine, and keep what lies in the plane
        if close < CLOSE_SHARE * count:
            plane = _voted(lens, near, up, triples_of(near.w.size, rng), plane, close)
        support = support_of(cells, near, plane)
        if support is not None:
            supports.append((support, near))
            _keep_off(plane, level, order, starts)
    # (5) ascending
    return sorted(supports, key=lambda found: found[0].offset)


@kernel
def _level_readings(w: F4, lens: Lens, up: F8) -> tuple[Readings, F4, I4, I4]:
    """Find every second cell whose surface is level within 25 degrees.

    Returns
    -------
    These readings, their heights, and what `by_height` says of these.
    """
    rows, columns = w.shape
    even, odd = _halves(w)
    width = max((columns - 2 * ARM + 1) // 2, 0)
    x = (ARM + 2 * np.arange(width) - lens.cx) / lens.fx
    row = np.zeros(width, np.float32)
    found = np.zeros((4, width * (rows // 2) + 1), np.float32)
    j_of, i_of, w_of, height_of = found[0], found[1], found[2], found[3]
    lowest, highest = np.float32(np.inf), np.float32(-np.inf)
    n = np.uint32(0)  # a place without a sign is not asked whether it counts from the end
    for i in range(ARM, rows - ARM, 2):
        _find_level(even, odd, lens, up, i, x, row)
        values = odd[i]
        for k in range(width):
            j_of[n], i_of[n], w_of[n], height_of[n] = ARM + 2 * k, i, values[ARM // 2 + k], row[k]
            level = row[k] < np.inf
            h = row[k] if level else highest
            lowest, highest = (row[k] if row[k] < lowest else lowest), max(h, highest)
            n += np.uint32(level)
    base = float(lowest) if n > 0 else 0.0
    bins = int((float(highest) - base) / BIN_M) + 1 if n > 0 else 1
    order, starts = by_height(height_of[:n], base, bins)
    return Readings(j_of[:n], i_of[:n], w_of[:n], 4), height_of[:n], order, starts


@kernel
def _halves(w: F4) -> tuple[F4, F4]:
    """Return the even and the odd columns of an image: loops over these vectorise."""
    rows, columns = w.shape
    even = np.zeros((rows, (columns + 1) // 2), np.float32)
    odd = np.zeros((rows, columns // 2), np.float32)
    for i in range(rows):
        row, evens, odds = w[i], even[i], odd[i]
        for k in range(odds.size):
            evens[k], odds[k] = row[2 * k], row[2 * k + 1]
        evens[-1] = row[(columns - 1) // 2 * 2]
    return even, odd


@kernel(fast=True, leaf=True)
def _find_level(even: F4, odd: F4, lens: Lens, up: F8, i: int, x: F8, height: F4) -> None:
    """Write the heights of the cells of a row on odd columns, infinity where it is not level."""
    bend, two = np.float32(BEND), np.float32(2)
    sides, middle, above, below = even[i], odd[i], odd[i - ARM], odd[i + ARM]
    close_above, close_below = odd[i - 1], odd[i + 1]
    y = (i - lens.cy) / lens.fy
    for k in range(x.size):
        m = k + ARM // 2
        center, left, right = middle[m], sides[k], sides[k + ARM]
        rise = x[k] * up[0] + y * up[1] + up[2]
        # A level surface near the height of the camera is narrow in the image.
        narrow = rise * rise < GRAZING_SIN2 * (x[k] * x[k] + y * y + 1)
        # All are read before some are chosen, or this would not vectorise.
        far, near, far_below, near_below = above[m], close_above[m], below[m], close_below[m]
        top, bottom = (near if narrow else far), (near_below if narrow else far_below)
        seen = (center > 0) & (left > 0) & (right > 0) & (top > 0) & (bottom > 0)
        smooth = abs(left + right - two * center) <= bend
        smooth &= abs(top + bottom - two * center) <= bend
        across, down = right - left, (bottom - top) * np.float32(ARM if narrow else 1)
        nx, ny = across * (lens.fx / (2 * ARM)), down * (lens.fy / (2 * ARM))
        nz = center - nx * x[k] - ny * y
        along = -(nx * up[0] + ny * up[1] + nz * up[2])
        upwards = along > 0
        upwards &= along * along > LEVEL_COS2 * (nx * nx + ny * ny + nz * nz)
        height[k] = rise / center if seen & smooth & upwards else np.inf


@kernel
def by_height(height: F4, base: float, bins: int) -> tuple[I4, I4]:
    """Return the order of heights by bins, and where each bin starts."""
    n = height.size
    bin_of = np.zeros(n, np.uint32)
    for k in range(n):
        bin_of[k] = min(int((height[k] - base) / BIN_M), bins - 1)
    starts = np.zeros(bins + 1, np.uint32)
    for k in range(n):
        starts[bin_of[k] + np.uint32(1)] += np.uint32(1)
    for b in range(bins):
        starts[b + 1] += starts[b]
    place = starts.copy()
    order = np.zeros(n, np.uint32)
    for k in range(n):
        order[place[bin_of[k]]] = k
        place[bin_of[k]] += np.uint32(1)
    return order, starts


@kernel
def fullest(starts: I4, done: Bool) -> int:
    """Return the bin that with its neighbours holds most readings; those done count as empty."""
    count = np.zeros(done.size + 2, np.int64)
    for k in range(done.size):
        count[k + 1] = 0 if done[k] else starts[k + 1] - starts[k]
    return int(np.argmax(count[:-2] + 2 * count[1:-1] + count[2:]))


@kernel
def _next_level(
    lens: Lens, up: F8, level: Readings, height: F4, order: I4, starts: I4, done: Bool
) -> tuple[Readings, F8, int, int]:
    """Fit a plane to the fullest bins that are not done.

    Returns
    -------
    The readings in these bins; the plane (a, b, c); how many of them lie in it, 0 if it is not
    seen from above; and how many are close to it.
    """
    peak = fullest(starts, done)
    low, high = max(peak - 2, 0), min(peak + 3, done.size)
    chosen = order[starts[low] : starts[high]]
    near = among(level, chosen)
    if chosen.size < LEAST_CELLS:
        return near, np.zeros(3), 0, 0
    done[low:high] = True
    offset = middle_of(height, chosen[:: 1 + chosen.size // MOST_HEIGHTS])
    if offset > -MARGIN_M:
        return near, np.zeros(3), 0, 0
    plane = level_plane(lens, up, offset)
    count = 0
    for _ in range(3):
        count = refit(near.j, near.i, near.w, 1.5 * TOLERANCE, plane)
        if count < LEAST_CELLS:
            break
        if cosine(normal_of(plane, lens), up) < STEADY_COS:
            plane = level_plane(lens, up, offset)
            break
    return near, plane, count, count_near(near, plane[0], plane[1], plane[2], CLOSE * TOLERANCE)


@kernel
def _voted(lens: Lens, near: Readings, up: F8, triples: I4, plane: F8, close: int) -> F8:
    """Return the plane most readings are close to, or ``plane``, to which ``close`` are."""
    other, votes = consensus(near, triples, lens, up, (STEADY_COS, 1.0), CLOSE * TOLERANCE)
    return other if votes > close else plane


@kernel
def _keep_off(plane: F8, level: Readings, order: I4, starts: I4) -> None:
    """Take the readings near a plane from their order `by_height`, in place."""
    j, i, w = level.j, level.i, level.w
    off = np.zeros(w.size, np.uint8)
    for k in range(w.size):
        off[k] = abs(w[k] - (plane[0] * j[k] + plane[1] * i[k] + plane[2])) > 3 * TOLERANCE
    left = np.zeros(order.size + 1, np.uint32)  # of those before each
    n = np.uint32(0)
    for k in range(starts[-1]):
        order[n] = order[k]
        n += np.uint32(off[order[k]])
        left[k + 1] = n
    for b in range(starts.size):
        starts[b] = left[starts[b]]


def support_of(cells: Cells, readings: Readings, plane: F8) -> Support | None:
    """Measure a plane (a, b, c) on readings near it; None if little of it is seen."""
    normal, offset, reach, area = _measure(cells.w, cells.lens, readings, plane)
    if area < LEAST_AREA_M2:
        return None
    a, b, c = plane.tolist()
    return Support(a, b, c, normal, offset, reach, area)


@kernel
def _measure(w: F4, lens: Lens, readings: Readings, plane: F8) -> tuple[F8, float, F8, float]:
    """Return the normal of a plane, its offset along it, how far it reaches, and its area, m2."""
    normal = normal_of(plane, lens)
    x, y = plane[0] * lens.fx, plane[1] * lens.fy
    z = plane[0] * lens.cx + plane[1] * lens.cy + plane[2]
    distance = 1 / math.sqrt(x * x + y * y + z * z)
    area = _area_of(readings, plane, distance) / (lens.fx * lens.fy)
    axes = np.array(level_axes(normal[0], normal[1], normal[2]))
    beside = _beside_inliers(readings, plane, w.shape[0], w.shape[1])
    return normal, -distance, _reach_of(w, lens, plane, axes, beside), area


@kernel(fast=True, leaf=True)
def _area_of(readings: Readings, plane: F8, distance: float) -> float:
    """Return the visible area of a plane by that of a pixel at 1 m, from its distance."""
    j, i, w = readings.j, readings.i, readings.w
    total = 0.0
    for k in range(w.size):
        level = plane[0] * j[k] + plane[1] * i[k] + plane[2]
        near = (level > 0) & (abs(w[k] - level) < TOLERANCE)
        facing = level * distance  # the cosine between the normal and the ray
        area = 1 / (level * level * (facing if facing > 0.05 else 0.05))
        total += area if near else 0.0
    return float(readings.share * total)


@kernel(fast=True)
def _beside_inliers(readings: Readings, plane: F8, rows: int, columns: int) -> U1:
    """Mark the cells (rows, columns) to which the surface was seen to go on from an inlier."""
    j, i, w = readings.j, readings.i, readings.w
    top, width = np.int32(ARM), np.int32(columns)
    place = np.zeros(w.size, np.int32)
    for k in range(w.size):
        level = plane[0] * j[k] + plane[1] * i[k] + plane[2]
        near = (level > 0) & (abs(w[k] - level) < TOLERANCE)
        here = np.int32(j[k]) + (np.int32(i[k]) + top) * width
        place[k] = here if near else np.int32(0)
    # There are margins above and below; those at the sides are cells that never are inliers.
    n, margin = rows * columns, ARM * columns
    inliers = np.zeros(n + 2 * margin, np.uint8)
    for p in place:
        inliers[p] = 1
    inliers[0] = 0
    above, below = inliers[:n], inliers[2 * margin :]
    left, right = inliers[margin - ARM :], inliers[margin + ARM :]
    beside = np.zeros(n, np.uint8)
    for k in range(n):
        beside[k] = above[k] | below[k] | left[k] | right[k]
    return beside.reshape(rows, columns)


@kernel
def _reach_of(w: F4, lens: Lens, plane: F8, axes: F8, beside: U1) -> F8:
    """Return how far the plane reaches along `DIRECTIONS`, metres, with a margin."""
    across, along = axes[0], axes[1]
    reach = np.full(DIRECTIONS, -np.inf)
    for i in range(w.shape[0]):
        # The outline is convex in the image too: the first and last cell of each row tell it.
        first, last = _ends(w, plane, i, beside[i])
        if first > last:
            continue
        for j in (first, last):
            z = 1 / (plane[0] * j + plane[1] * i + plane[2])
            x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
            u = across[0] * x + across[1] * y + across[2] * z
            v = along[0] * x + along[1] * y + along[2] * z
            for k in range(DIRECTIONS):
                there = COS[k] * u + SIN[k] * v
                reach[k] = there if there > reach[k] else reach[k]
    return reach + MARGIN_M


@kernel(leaf=True)
def _ends(w: F4, plane: F8, i: int, beside: U1) -> tuple[int, int]:
    """Return the first and the last marked cell of a row in the plane; none: first > last."""
    none = np.int32(beside.size)
    first, last = none, np.int32(-1)
    for k in range(beside.size):  # no more than 32 bits, and this vectorises
        low = np.int32(k) if beside[k] else none
        high = np.int32(k) if beside[k] else np.int32(-1)
        first, last = (low if low < first else first), (high if high > last else last)
    while first <= last and not (beside[first] and _is_in(w, plane, i, first)):
        first += 1
    while first < last and not (beside[last] and _is_in(w, plane, i, last)):
        last -= 1
    return int(first), int(last)


@kernel(leaf=True)
def _is_in(w: F4, plane: F8, i: int, j: int) -> bool:
    level = plane[0] * j + plane[1] * i + plane[2]
    return bool(level > 0 and abs(w[i, j] - level) < TOLERANCE)


def corners_of(support: Support) -> F8:
    """Return the corners (k, 3) of the convex outline, sensor frame, in order, without repeats."""
    # Neighbouring sides x cos + y sin = reach meet at a corner.
    here, there = support.reach, support.reach[NEXT]
    along = (there - here * COS[1]) / SIN[1]
    flat = np.array([here * COS - along * SIN, here * SIN + along * COS]).T
    level = gravity_rotation(support.up)
    return np.asarray(flat @ level[:2] + support.offset * level[2])
