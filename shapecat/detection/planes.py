"""Planes: the horizontal levels of the scene and their outlines (thesis 4.3, Alg. 1)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.cells import Cells, Lens, middle_of, place_of
from shapecat.detection.consensus import (
    TOLERANCE,
    Readings,
    best_plane,
    count_near,
    level_plane,
    normal_of,
    refit,
)
from shapecat.geometry import gravity_rotation
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
    "listed",
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
"""Cells to each side over which a surface is seen to be level."""
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


def find_planes(cells: Cells, up: F8, rng: np.random.Generator) -> list[tuple[Support, I4]]:
    """Return the horizontal planes of the scene, lowest first, each with its cells (flat)."""
    # (1), (2) readings whose surface is level
    index = np.zeros(cells.w.size // 4 + 1, np.int32)
    height = np.zeros(index.size, np.float32)
    n = _level_readings(cells.w, cells.lens, up, index, height)
    if n < LEAST_CELLS:
        return []
    # (3) one plane candidate for each accumulation in height
    index, height = index[:n], height[:n]
    base = float(height.min())
    done = np.zeros(int((float(height.max()) - base) / BIN_M) + 1, bool)
    supports: list[tuple[Support, I4]] = []
    order, starts = by_height(index, height, base, done.size)
    for _ in range(MOST_LEVELS):
        peak = fullest(starts, done)
        low, high = max(peak - 2, 0), min(peak + 3, done.size)
        near = order[starts[low] : starts[high]]
        if near.size < LEAST_CELLS:
            break
        # (4) refine, and keep what lies in the plane
        middle = middle_of(height[near[:: 1 + near.size // MOST_HEIGHTS]])
        near = index[near]
        support = _refined(cells, near, middle, up, rng)
        done[low:high] = True
        if support is not None:
            supports.append((support, near))
            n = _keep_off(cells.w, support.a, support.b, support.c, index, height)
            index, height = index[:n], height[:n]
            order, starts = by_height(index, height, base, done.size)
    # (5) ascending
    return sorted(supports, key=lambda found: found[0].offset)


@kernel(leaf=True)
def _keep_off(w: F4, a: float, b: float, c: float, index: I4, height: F4) -> int:
    """Move the listed cells that are not near a plane to the front; return how many they are."""
    columns = w.shape[1]
    n = 0
    for k in range(index.size):
        i, j = place_of(index[k], columns)
        if abs(w[i, j] - (a * j + b * i + c)) > 3 * TOLERANCE:
            index[n], height[n] = index[k], height[k]
            n += 1
    return n


@kernel(leaf=True)
def _level_readings(w: F4, lens: Lens, up: F8, index: I4, height: F4) -> int:
    """Collect every second cell whose surface is level within 25 degrees: its index and height."""
    rows, columns = w.shape
    r = ARM
    n = 0
    bend = np.float32(BEND)
    for i in range(r, rows - r, 2):
        y = (i - lens.cy) / lens.fy
        for j in range(r, columns - r, 2):
            center = w[i, j]
            left, right = w[i, j - r], w[i, j + r]
            if not ((center > 0) & (left > 0) & (right > 0)):
                continue
            # A level surface near the height of the camera is narrow in the image.
            x = (j - lens.cx) / lens.fx
            rise = x * up[0] + y * up[1] + up[2]
            s = 1 if rise * rise < GRAZING_SIN2 * (x * x + y * y + 1) else r
            top, bottom = w[i - s, j], w[i + s, j]
            if not ((top > 0) & (bottom > 0)):
                continue
            if (abs(left + right - 2 * center) > bend) | (abs(top + bottom - 2 * center) > bend):
                continue
            wu, wv = (right - left) / (2 * r), (bottom - top) / (2 * s)
            nx, ny = lens.fx * wu, lens.fy * wv
            nz = center - wu * (j - lens.cx) - wv * (i - lens.cy)
            along = -(nx * up[0] + ny * up[1] + nz * up[2])
            if along > 0 and along * along > LEVEL_COS2 * (nx * nx + ny * ny + nz * nz):
                index[n] = i * columns + j
                height[n] = rise / center
                n += 1
    return n


@kernel
def fullest(starts: I4, done: Bool) -> int:
    """Return the bin that with its neighbours holds most readings; those done count as empty."""
    count = np.zeros(done.size + 2, np.int64)
    for k in range(done.size):
        count[k + 1] = 0 if done[k] else starts[k + 1] - starts[k]
    return int(np.argmax(count[:-2] + 2 * count[1:-1] + count[2:]))


@kernel
def by_height(index: I4, height: F4, base: float, bins: int) -> tuple[I4, I4]:
    """Return the positions in ``index`` sorted by bins of height, and where each bin starts."""
    starts = np.zeros(bins + 1, np.int64)
    bin_of = np.zeros(index.size, np.int32)
    for k in range(index.size):
        bin_of[k] = min(int((height[k] - base) / BIN_M), bins - 1)
        starts[bin_of[k] + 1] += 1
    for k in range(bins):
        starts[k + 1] += starts[k]
    place = starts[:-1].copy()
    order = np.zeros(index.size, np.int32)
    for k in range(index.size):
        order[place[bin_of[k]]] = k
        place[bin_of[k]] += 1
    return order, starts


def _refined(
    cells: Cells, index: I4, offset: float, up: F8, rng: np.random.Generator
) -> Support | None:
    lens = cells.lens
    if offset > -MARGIN_M:  # not seen from above
        return None
    level = level_plane(lens, up, offset)
    j, i, w = listed(cells.w, index)
    readings = Readings(j, i, w, 1)
    plane = level.copy()
    for _ in range(3):
        near = refit(j, i, w, 1.5 * TOLERANCE, plane)
        if near < LEAST_CELLS:
            return None
        if normal_of(plane, lens) @ up < STEADY_COS:
            plane = level
            break
    close = count_near(readings, *plane, CLOSE * TOLERANCE)
    if close < CLOSE_SHARE * near:
        other, votes = best_plane(
            readings, lens, up, (STEADY_COS, 1.0), rng, tolerance=CLOSE * TOLERANCE
        )
        plane = other if votes > close else plane
    return support_of(cells, index, plane)


def support_of(cells: Cells, index: I4, plane: F8) -> Support | None:
    """Measure a plane (a, b, c) on its cells (flat); None if little of it is seen."""
    lens = cells.lens
    normal = normal_of(plane, lens)
    reach = np.full(DIRECTIONS, -np.inf)
    axes = gravity_rotation(normal)
    area = _spread(cells.w, lens, index, plane, normal, axes, TOLERANCE, reach)
    if area < LEAST_AREA_M2:
        return None
    n = (plane[0] * lens.fx, plane[1] * lens.fy, plane[0] * lens.cx + plane[1] * lens.cy + plane[2])
    offset = -1 / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
    a, b, c = (float(v) for v in plane)
    return Support(a, b, c, normal, offset, reach + MARGIN_M, area)


@kernel
def listed(w: F4, index: I4) -> tuple[F4, F4, F4]:
    """Return the columns, rows and values of the listed cells."""
    columns = w.shape[1]
    result = np.zeros((3, index.size), np.float32)
    for k in range(index.size):
        i, j = place_of(index[k], columns)
        result[0, k], result[1, k], result[2, k] = j, i, w[i, j]
    return result[0], result[1], result[2]


@kernel
def _spread(
    w: F4, lens: Lens, index: I4, plane: F8, normal: F8, axes: F8, tolerance: float, reach: F8
) -> float:
    """Measure how far the plane reaches along `DIRECTIONS`; return its visible area in m2."""
    rows, columns = w.shape
    area = 0.0
    # The outline is convex in the image too: the first and last cell of each row tell it.
    first, last = np.full(rows, columns, np.int64), np.full(rows, -1, np.int64)
    for p in index:
        i0, j0 = place_of(p, columns)
        level = plane[0] * j0 + plane[1] * i0 + plane[2]
        if level <= 0 or abs(w[i0, j0] - level) >= tolerance:
            continue
        x, y, z = (j0 - lens.cx) / lens.fx, (i0 - lens.cy) / lens.fy, 1 / level
        facing = -(x * normal[0] + y * normal[1] + normal[2])
        area += 4 * z * z / (lens.fx * lens.fy) / max(facing, 0.05)
        # The surface was seen to go on to all four sides.
        for d in range(4):
            i = i0 + (ARM if d == 0 else -ARM if d == 1 else 0)
            j = j0 + (ARM if d == 2 else -ARM if d == 3 else 0)
            if first[i] <= j <= last[i]:
                continue
            level = plane[0] * j + plane[1] * i + plane[2]
            if level > 0 and abs(w[i, j] - level) < tolerance:
                first[i] = min(first[i], j)
                last[i] = max(last[i], j)
    for i in range(rows):
        if first[i] > last[i]:
            continue
        for j in (first[i], last[i]):
            z = 1 / (plane[0] * j + plane[1] * i + plane[2])
            x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
            u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
            v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
            for k in range(DIRECTIONS):
                reach[k] = max(reach[k], COS[k] * u + SIN[k] * v)
    return area


def corners_of(support: Support) -> F8:
    """Return the corners (k, 3) of the convex outline, sensor frame, in order, without repeats."""
    # Neighbouring sides x cos + y sin = reach meet at a corner.
    here, there = support.reach, support.reach[NEXT]
    along = (there - here * COS[1]) / SIN[1]
    flat = np.array([here * COS - along * SIN, here * SIN + along * COS]).T
    level = gravity_rotation(support.up)
    return np.asarray(flat @ level[:2] + support.offset * level[2])
