"""Directions: which way is up, as the surfaces of the scene tell it."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.cells import JUMP, Cells, Lens
from shapecat.detection.consensus import TOLERANCE, level_plane, normal_of, readings_of, refit
from shapecat.geometry import cross
from shapecat.jit import kernel

__all__ = ["estimate_up"]

ARM = 3
"""Cells to each side over which a surface is seen to be smooth."""
LEAST_SHARE, LEAST_FACETS = 0.04, 12
"""A direction that may be up is faced by this share of the surface, and so many facets."""
HINT_COS = math.cos(math.radians(15))
FACING_COS = math.cos(math.radians(20))
SAME_COS = math.cos(math.radians(12))
CORNER_COS = 0.3
TRIALS = 120
MOST_DIRECTIONS = 4
HEIGHT_BINS, LEVEL_BIN_M = 80, 0.04
LEVELS_APART = 2
"""Bins between two levels."""
SEVERAL, CLEAR, UPRIGHT = 1.5, 2, 0.25
"""How much it counts that levels are several, by the power of their number; that what faces a
direction lies in them, by the power of the share; and an upright camera."""


def estimate_up(
    cells: Cells, hint: F8 | None, *, upright: bool, rng: np.random.Generator
) -> F8 | None:
    """Return the normal of the dominant supporting plane, (3,) unit, or None if there is none.

    With a ``hint`` only planes within 15 degrees of being perpendicular to it count. Without, the
    direction wins that faces most large levels: the normal of one of the largest planes, or the
    direction that two walls leave. Where the camera is thought ``upright``, directions that look
    down count a little less, so that the boards of a shelf beat its back.
    """
    facets = np.zeros((cells.w.size // 16 + cells.w.shape[0] + cells.w.shape[1], 6), np.float32)
    facets = facets[: _facets(cells.w, cells.lens, facets)]
    least = max(LEAST_SHARE * len(facets), LEAST_FACETS)
    directions = _directions(facets, hint, least, rng)
    if not directions:
        return None
    if hint is None:
        # Two walls leave one direction, up or down.
        directions += [
            sign * cross(a, b) / np.linalg.norm(cross(a, b))
            for k, a in enumerate(directions)
            for b in directions[:k]
            if abs(a @ b) < CORNER_COS
            for sign in (1, -1)
        ]
    best = max(directions, key=lambda d: _merit(facets, d, least, upright=upright))
    return _settled(cells, facets, best)


def _directions(facets: F4, hint: F8 | None, least: float, rng: np.random.Generator) -> list[F8]:
    """Return directions that many surfaces face, most first: RANSAC on one normal at a time."""
    free = np.ones(len(facets), np.bool_)
    if hint is not None:
        free &= _facing(facets, hint, HINT_COS)
    found: list[F8] = []
    while len(found) < MOST_DIRECTIONS and (left := np.flatnonzero(free)).size >= least:
        trials = left[rng.integers(0, left.size, TRIALS)]
        best = np.zeros(3)
        if _most_faced(facets, free, trials, best) < least:
            break
        found.append(best)
        free &= ~_facing(facets, best, FACING_COS)
    return found


@kernel
def _facing(facets: F4, direction: F8, least_cos: float) -> Bool:
    """Return which facets face a direction."""
    result = np.zeros(len(facets), np.bool_)
    x, y, z = direction
    for k in range(len(facets)):
        cos = facets[k, 0] * x + facets[k, 1] * y + facets[k, 2] * z
        result[k] = cos > least_cos
    return result


@kernel(fast=True)
def _most_faced(facets: F4, free: Bool, trials: I4, best: F8) -> int:
    """Write the direction most free facets face; return how many."""
    n = 0
    chosen = np.zeros((3, np.count_nonzero(free)), np.float32)
    for k in range(len(facets)):
        if free[k]:
            chosen[0, n], chosen[1, n], chosen[2, n] = facets[k, 0], facets[k, 1], facets[k, 2]
            n += 1
    xs, ys, zs = chosen[0], chosen[1], chosen[2]  # unpacked they would not be contiguous
    least = np.float32(FACING_COS)
    most = -1
    for t in trials:
        x, y, z = facets[t, 0], facets[t, 1], facets[t, 2]
        votes = np.int32(0)
        for k in range(n):
            votes += np.int32(xs[k] * x + ys[k] * y + zs[k] * z > least)
        if votes > most:
            most = int(votes)
            best[0], best[1], best[2] = x, y, z
    for _ in range(3):
        x, y, z = np.float32(best[0]), np.float32(best[1]), np.float32(best[2])
        sx = sy = sz = np.float64(0)
        votes = np.int32(0)
        for k in range(n):
            near = xs[k] * x + ys[k] * y + zs[k] * z > least
            votes += np.int32(near)
            sx += xs[k] if near else np.float32(0)
            sy += ys[k] if near else np.float32(0)
            sz += zs[k] if near else np.float32(0)
        most = int(votes)
        norm = math.sqrt(sx * sx + sy * sy + sz * sz)
        best[0], best[1], best[2] = sx / norm, sy / norm, sz / norm
    return most


def _merit(facets: F4, direction: F8, least: float, *, upright: bool) -> float:
    """Return how well a direction explains the surface: what of it lies in large levels."""
    count = np.zeros(HEIGHT_BINS, np.int64)
    _count_levels(facets, direction, count)
    level, squares = _large_levels(count, least)
    if level == 0:
        return 0.0
    # The boards of a shelf are several, its back is one; what stands before a wall makes it several
    # as well, but these are unlike in size, and much of what faces as it does lies in none.
    levels, clear = level**2 / squares, level / int(count.sum())
    # Cameras look down at tables: +y is down in the optical frame.
    tilt = min(max(-direction[1] / 0.2, -1.0), 1.0) if upright else 0.0
    return float(level * levels**SEVERAL * clear**CLEAR * (1.0 + UPRIGHT * tilt))


@kernel
def _large_levels(count: I4, least: float) -> tuple[int, int]:
    """Return how many facets lie in levels of more than ``least``, and the sum of their squares.

    A level fills two bins and stands out from the next ones: a slanted surface has many heights.
    """
    facets = squares = 0
    last = count.size - 1
    for k in range(last):
        here = count[k] + count[k + 1]
        stands_out = here > least
        for m in range(max(0, k - LEVELS_APART), min(last, k + LEVELS_APART + 1)):
            there = count[m] + count[m + 1]
            stands_out &= here > there if m < k else here >= there
        if stands_out:
            facets += here
            squares += here * here
    return facets, squares


@kernel
def _count_levels(facets: F4, direction: F8, count: I4) -> None:
    """Count the facets that face a direction by their height below the sensor."""
    x, y, z = direction
    for k in range(len(facets)):
        if facets[k, 0] * x + facets[k, 1] * y + facets[k, 2] * z > FACING_COS:
            height = facets[k, 3] * x + facets[k, 4] * y + facets[k, 5] * z
            level = math.floor(-height / LEVEL_BIN_M)
            if 0 <= level < count.size:
                count[level] += 1


def _settled(cells: Cells, facets: F4, direction: F8) -> F8:
    """Return the exact normal of the largest plane that faces ``direction``."""
    count = np.zeros(HEIGHT_BINS, np.int64)
    _count_levels(facets, direction, count)
    plane = level_plane(cells.lens, direction, -(int(np.argmax(count)) + 0.5) * LEVEL_BIN_M)
    readings = readings_of(cells)
    for tolerance in (4, 3, 2, 1, 1):
        refit(readings.j, readings.i, readings.w, tolerance * TOLERANCE, plane)
    normal = normal_of(plane, cells.lens)
    return normal if normal @ direction > SAME_COS else direction


@kernel(leaf=True)
def _facets(w: F4, lens: Lens, facets: F4) -> int:
    """Collect the normal and the position of every fourth cell on a smooth surface."""
    rows, columns = w.shape
    bend = np.float32(2 * JUMP)
    n = 0
    for i in range(ARM, rows - ARM, 4):
        for j in range(ARM, columns - ARM, 4):
            center = w[i, j]
            left, right, top, bottom = w[i, j - ARM], w[i, j + ARM], w[i - ARM, j], w[i + ARM, j]
            if not ((center > 0) & (left > 0) & (right > 0) & (top > 0) & (bottom > 0)):
                continue
            if (abs(left + right - 2 * center) > bend) | (abs(top + bottom - 2 * center) > bend):
                continue
            wu, wv = (right - left) / (2 * ARM), (bottom - top) / (2 * ARM)
            nx, ny = -lens.fx * wu, -lens.fy * wv
            nz = wu * (j - lens.cx) + wv * (i - lens.cy) - center
            norm = math.sqrt(nx * nx + ny * ny + nz * nz)
            facets[n, 0], facets[n, 1], facets[n, 2] = nx / norm, ny / norm, nz / norm
            facets[n, 3] = (j - lens.cx) / lens.fx / center
            facets[n, 4] = (i - lens.cy) / lens.fy / center
            facets[n, 5] = 1 / center
            n += 1
    return n
