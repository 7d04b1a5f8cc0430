"""Supporting planes: the up direction, horizontal levels, and their outlines (thesis 4.3)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.cells import JUMP, NEAREST_M, Cells, Lens
from shapecat.geometry import gravity_rotation
from shapecat.jit import kernel

__all__ = ["DIRECTIONS", "Support", "corners_of", "estimate_up", "find_supports", "find_walls"]

TOLERANCE = 0.01
"""Distance of an inlier from a plane in inverse depth, 1/m: three steps of a Kinect."""
TRIALS = 120
MOST_PLANES = 5
LEAST_SHARE = 0.04
"""A plane that tells the up direction covers at least this share of the readings."""
HINT_COS = math.cos(math.radians(15))
CORNER_COS = 0.3
SAME_COS = math.cos(math.radians(12))
FACING_COS = 0.94
HEIGHT_BINS, LEVEL_BIN_M = 80, 0.04
MOST_DIRECTIONS = 4
LEAST_FACETS = 12
WALL_COS = 0.2
WALL_AREA_M2 = 0.05
WALL_FILL = 0.3
DIRECTIONS = 16
MARGIN_M = 0.01
BIN_M = 0.01
MOST_LEVELS = 10
LEAST_AREA_M2 = 0.03
SURE_AREA_M2 = 0.25
LEAST_CELLS = 100
ARM = 3
"""Cells to each side over which a surface is seen to be level."""
STEADY_COS = math.cos(math.radians(6))
LIKELY_AREA_M2 = 0.1
LEAST_DROP_M = 0.06
EDGE_STEPS = 5
LEAST_DROPS = 20
CLOSED = 0.5


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


def estimate_up(
    cells: Cells, hint: F8 | None, *, upright: bool, rng: np.random.Generator
) -> F8 | None:
    """Return the normal of the dominant supporting plane, (3,) unit, or None if there is none.

    With a ``hint`` only planes within 15 degrees of being perpendicular to it count. Without, the
    direction wins that most of the surface faces: the normal of one of the largest planes, or the
    direction that two walls leave. Where the camera is thought ``upright``, directions that look
    down count less, so that the boards of a shelf beat its back.
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
            sign * np.cross(a, b) / np.linalg.norm(np.cross(a, b))
            for k, a in enumerate(directions)
            for b in directions[:k]
            if abs(a @ b) < CORNER_COS
            for sign in (1, -1)
        ]
    best = max(directions, key=lambda d: _merit(facets, d, least, upright=upright))
    return _settled(cells, facets, best)


def _directions(
    facets: F4, hint: F8 | None, least: float, rng: np.random.Generator
) -> list[F8]:
    """Return directions that many surfaces face, most first: RANSAC on one normal at a time."""
    free = np.ones(len(facets), np.bool_)
    if hint is not None:
        free &= _facing(facets, hint, HINT_COS)
    found: list[F8] = []
    while len(found) < MOST_DIRECTIONS and np.count_nonzero(free) >= least:
        trials = np.flatnonzero(free)[rng.integers(0, np.count_nonzero(free), TRIALS)]
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
    for k in range(len(facets)):
        f = facets[k]
        cos = f[0] * direction[0] + f[1] * direction[1] + f[2] * direction[2]
        result[k] = cos > least_cos
    return result


@kernel
def _most_faced(facets: F4, free: Bool, trials: I4, best: F8) -> int:
    """Write the direction most free facets face; return how many."""
    chosen = np.zeros((np.count_nonzero(free), 3), np.float32)
    n = 0
    for k in range(len(facets)):
        if free[k]:
            chosen[n] = facets[k, :3]
            n += 1
    most = -1
    for t in trials:
        x, y, z = facets[t, 0], facets[t, 1], facets[t, 2]
        votes = 0
        for k in range(n):
            votes += chosen[k, 0] * x + chosen[k, 1] * y + chosen[k, 2] * z > FACING_COS
        if votes > most:
            most = votes
            best[0], best[1], best[2] = x, y, z
    for _ in range(3):
        x, y, z = best
        sx = sy = sz = 0.0
        most = 0
        for k in range(n):
            if chosen[k, 0] * x + chosen[k, 1] * y + chosen[k, 2] * z > FACING_COS:
                most += 1
                sx += chosen[k, 0]
                sy += chosen[k, 1]
                sz += chosen[k, 2]
        norm = math.sqrt(sx * sx + sy * sy + sz * sz)
        best[0], best[1], best[2] = sx / norm, sy / norm, sz / norm
    return most


def _merit(facets: F4, direction: F8, least: float, *, upright: bool) -> float:
    count = np.zeros(HEIGHT_BINS, np.int64)
    facing = _count_levels(facets, direction, count)
    # The boards of a shelf are several, its back is one.
    levels = max(np.count_nonzero((count[1:] + count[:-1])[::2] > least), 1)
    # Cameras look down at tables: +y is down in the optical frame.
    tilt = min(max(-direction[1] / 0.2, -1.0), 1.0) if upright else 0.0
    return float(facing * math.sqrt(levels) * (1.0 + 0.6 * tilt))


@kernel
def _count_levels(facets: F4, direction: F8, count: I4) -> int:
    """Count the facets that face a direction, in all and by their height below the sensor."""
    facing = 0
    for k in range(len(facets)):
        f = facets[k]
        if f[0] * direction[0] + f[1] * direction[1] + f[2] * direction[2] > FACING_COS:
            facing += 1
            height = f[3] * direction[0] + f[4] * direction[1] + f[5] * direction[2]
            level = int(math.floor(-height / LEVEL_BIN_M))
            if 0 <= level < count.size:
                count[level] += 1
    return facing


def _settled(cells: Cells, facets: F4, direction: F8) -> F8:
    """Return the exact normal of the largest plane that faces ``direction``."""
    count = np.zeros(HEIGHT_BINS, np.int64)
    _count_levels(facets, direction, count)
    offset = -(int(np.argmax(count)) + 0.5) * LEVEL_BIN_M
    sample, stride = _sample(cells.w)
    plane = _level_plane(cells.lens, direction, offset)
    for tolerance in (4, 3, 2, 1, 1):
        _refit(sample, stride, tolerance * TOLERANCE, plane)
    normal = _normal(plane, cells.lens)
    return normal if normal @ direction > SAME_COS else direction


def _level_plane(lens: Lens, up: F8, offset: float) -> F8:
    """Return the plane ``up @ p == offset`` as inverse depth (a, b, c)."""
    a, b = up[0] / lens.fx, up[1] / lens.fy
    return np.array([a, b, up[2] - a * lens.cx - b * lens.cy]) / offset


@kernel
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


def find_walls(
    cells: Cells, owner: I4, up: F8, *, largest_m: float, rng: np.random.Generator
) -> list[F8]:
    """Return the vertical planes among the object cells that are too large for an object.

    Each is (a, b, c): the inverse depth of the plane at cell (i, j) is ``a * j + b * i + c``.
    """
    sample, stride = _sample(np.where(owner > 0, cells.w, np.float32(0)))
    walls: list[F8] = []
    for _ in range(MOST_PLANES):
        plane, count = _best_plane(sample, stride, cells.lens, up, (-WALL_COS, WALL_COS), rng)
        if count < 50:
            break
        normal = _normal(plane, cells.lens)
        axes = np.stack([np.cross(normal, up), up])
        reach = np.zeros(3)
        _measure_wall(sample, stride, cells.lens, plane, normal, axes, reach)
        dense = reach[0] > WALL_FILL * reach[1] * reach[2]
        if reach[0] > WALL_AREA_M2 and dense and reach[1:].max() > largest_m:
            walls.append(plane)
        _clear(sample, stride, plane, 2 * TOLERANCE)
    return walls


@kernel
def _measure_wall(
    sample: F4, stride: int, lens: Lens, plane: F8, normal: F8, axes: F8, reach: F8
) -> None:
    """Write the area of the inliers of a plane, and how far they reach across and up."""
    shift = stride // 2
    bins = np.zeros((2, 400))
    for i in range(sample.shape[0]):
        for j in range(sample.shape[1]):
            x, y = j * stride + shift, i * stride + shift
            v = plane[0] * x + plane[1] * y + plane[2]
            if not (sample[i, j] > 0 and abs(sample[i, j] - v) < TOLERANCE):
                continue
            z = 1 / sample[i, j]
            px, py = (x - lens.cx) / lens.fx * z, (y - lens.cy) / lens.fy * z
            facing = -(px * normal[0] + py * normal[1] + z * normal[2]) / z
            area = stride * stride * z * z / (lens.fx * lens.fy) / max(facing, 0.1)
            reach[0] += area
            for d in range(2):
                along = axes[d, 0] * px + axes[d, 1] * py + axes[d, 2] * z
                bins[d, min(max(int(math.floor(along * 20)) + 200, 0), 399)] += area
    # A strip of 5 cm counts that holds 5 cm of wall.
    for d in range(2):
        for k in range(400):
            reach[1 + d] += 0.05 if bins[d, k] > 0.0025 else 0.0


def _best_plane(
    sample: F4,
    stride: int,
    lens: Lens,
    guide: F8,
    cosines: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[F8, int]:
    plane = np.zeros(3)
    triples = _triples(sample, rng)
    return plane, _consensus(sample, stride, triples, TOLERANCE, lens, guide, cosines, plane)


def _sample(w: F4) -> tuple[F4, int]:
    stride = max(1, round(math.sqrt(w.size / 4800)))
    return w[stride // 2 :: stride, stride // 2 :: stride].copy(), stride


def _triples(sample: F4, rng: np.random.Generator) -> I4:
    """Return (2 TRIALS, 3, 2) positions: a reading and two places near it, or three readings."""
    readings = np.flatnonzero(sample)
    if readings.size == 0:
        return np.zeros((0, 3, 2), np.int64)
    size = np.array(sample.shape)
    chosen = readings[rng.integers(0, readings.size, (2 * TRIALS, 3))]
    triples = np.stack(np.divmod(chosen, size[1]), axis=-1)
    radius = rng.uniform(0.05, 0.3, (TRIALS, 1, 1)) * size.max()
    near = np.rint(rng.uniform(-1, 1, (TRIALS, 2, 2)) * radius).astype(np.int64)
    triples[:TRIALS, 1:] = np.clip(triples[:TRIALS, :1] + near, 0, size - 1)
    return triples


def _normal(plane: F8, lens: Lens) -> F8:
    a, b, c = plane
    n = -np.array([a * lens.fx, b * lens.fy, a * lens.cx + b * lens.cy + c])
    return n / np.linalg.norm(n)


@kernel(fast=True)
def _count(sample: F4, stride: int, a: float, b: float, c: float, tolerance: float) -> int:
    rows, columns = sample.shape
    total = 0
    shift = stride // 2
    step = np.float32(a * stride)
    gate = np.float32(tolerance)
    for i in range(rows):
        base = np.float32(b * (i * stride + shift) + a * shift + c)
        line = sample[i]
        number = np.int32(0)
        for j in range(columns):
            w = line[j]
            number += np.int32((abs(w - (step * np.float32(j) + base)) < gate) & (w > 0))
        total += number
    return total


@kernel
def _consensus(
    sample: F4,
    stride: int,
    triples: I4,
    tolerance: float,
    lens: Lens,
    guide: F8,
    cosines: tuple[float, float],
    best: F8,
) -> int:
    """Write the plane (a, b, c) with most inliers to ``best``; return how many there are.

    RANSAC (Fischler and Bolles 1981): three readings propose, all vote, inliers refit.
    """
    most = 0
    shift = stride // 2
    guided = abs(guide[0]) + abs(guide[1]) + abs(guide[2]) > 0
    for t in range(triples.shape[0]):
        i0, j0 = triples[t, 0, 0], triples[t, 0, 1]
        w0 = sample[i0, j0]
        w1 = sample[triples[t, 1, 0], triples[t, 1, 1]]
        w2 = sample[triples[t, 2, 0], triples[t, 2, 1]]
        if not ((w0 > 0) & (w1 > 0) & (w2 > 0)):
            continue
        i1, j1 = triples[t, 1, 0] - i0, triples[t, 1, 1] - j0
        i2, j2 = triples[t, 2, 0] - i0, triples[t, 2, 1] - j0
        double = i1 * j2 - i2 * j1
        if abs(double) < 4:
            continue
        a = (i1 * (w2 - w0) - i2 * (w1 - w0)) / (double * stride)
        b = (j2 * (w1 - w0) - j1 * (w2 - w0)) / (double * stride)
        c = w0 - a * (j0 * stride + shift) - b * (i0 * stride + shift)
        if guided:
            nx, ny, nz = a * lens.fx, b * lens.fy, a * lens.cx + b * lens.cy + c
            along = -(nx * guide[0] + ny * guide[1] + nz * guide[2])
            norm = math.sqrt(nx * nx + ny * ny + nz * nz)
            if not ((along >= cosines[0] * norm) & (along <= cosines[1] * norm)):
                continue
        votes = _count(sample, stride, a, b, c, tolerance)
        if votes > most:
            most = votes
            best[0], best[1], best[2] = a, b, c
    if most < 3:
        return 0
    for _ in range(4):
        _refit(sample, stride, tolerance, best)
    return _count(sample, stride, best[0], best[1], best[2], tolerance)


@kernel
def _refit(sample: F4, stride: int, tolerance: float, plane: F8) -> None:
    """Fit the plane to its inliers by least squares; leave it alone if they do not span one."""
    rows, columns = sample.shape
    shift = stride // 2
    a, b, c = plane[0], plane[1], plane[2]
    m = np.zeros(9)
    j0, i0 = columns * stride * 0.5, rows * stride * 0.5
    for i in range(rows):
        y = i * stride + shift
        for j in range(columns):
            w = sample[i, j]
            x = j * stride + shift
            if w > 0 and abs(w - (a * x + b * y + c)) < tolerance:
                dx, dy = x - j0, y - i0
                m[0] += 1
                m[1] += dx
                m[2] += dy
                m[3] += dx * dx
                m[4] += dx * dy
                m[5] += dy * dy
                m[6] += w
                m[7] += dx * w
                m[8] += dy * w
    if m[0] < 3:
        return
    n, mx, my, mw = m[0], m[1] / m[0], m[2] / m[0], m[6] / m[0]
    xx, xy, yy = m[3] / n - mx * mx, m[4] / n - mx * my, m[5] / n - my * my
    xw, yw = m[7] / n - mx * mw, m[8] / n - my * mw
    determinant = xx * yy - xy * xy
    if not determinant > 1e-6 * (xx + yy) ** 2:
        return
    a = (xw * yy - yw * xy) / determinant
    b = (yw * xx - xw * xy) / determinant
    plane[0], plane[1] = a, b
    plane[2] = mw - a * (mx + j0) - b * (my + i0)


@kernel
def _clear(sample: F4, stride: int, plane: F8, tolerance: float) -> None:
    """Remove the readings near a plane from the sample."""
    shift = stride // 2
    for i in range(sample.shape[0]):
        for j in range(sample.shape[1]):
            w = plane[0] * (j * stride + shift) + plane[1] * (i * stride + shift) + plane[2]
            if abs(sample[i, j] - w) < tolerance:
                sample[i, j] = 0


def find_supports(cells: Cells, up: F8) -> list[Support]:
    """Return the horizontal planes of the scene, lowest first (thesis Alg. 1)."""
    # (1), (2) readings whose surface is level
    index = np.zeros(cells.w.shape[0] * cells.w.shape[1] // 4 + 1, np.int32)
    height = np.zeros(index.size, np.float32)
    n = _level_readings(cells.w, cells.lens, up, index, height)
    if n < LEAST_CELLS:
        return []
    # (3) one plane candidate for each accumulation in height
    index, height = index[:n], height[:n]
    base = float(height.min())
    done = np.zeros(int((float(height.max()) - base) / BIN_M) + 1, bool)
    supports: list[tuple[Support, I4]] = []
    order, starts = _by_height(index, height, base, done.size)
    for _ in range(MOST_LEVELS):
        count = np.where(done, 0, np.diff(starts))
        peak = int(np.argmax(np.convolve(count, [1, 2, 1], "same")))
        low, high = max(peak - 2, 0), min(peak + 3, done.size)
        near = order[starts[low] : starts[high]]
        if near.size < LEAST_CELLS:
            break
        # (4) refine, and keep what lies in the plane
        support = _refined(cells, index[near], float(np.median(height[near])), up)
        done[low:high] = True
        if support is not None:
            supports.append((support, index[near]))
            rest = _off_plane(cells.w, index, support.a, support.b, support.c, 3 * TOLERANCE)
            index, height = index[rest], height[rest]
            order, starts = _by_height(index, height, base, done.size)
    # (5) ascending
    return _boards(cells, sorted(supports, key=lambda found: found[0].offset))


@kernel
def _off_plane(w: F4, index: I4, a: float, b: float, c: float, tolerance: float) -> Bool:
    """Return which of the listed cells are not near a plane."""
    columns = w.shape[1]
    result = np.zeros(index.size, np.bool_)
    for k in range(index.size):
        i, j = index[k] // columns, index[k] % columns
        result[k] = abs(w[i, j] - (a * j + b * i + c)) > tolerance
    return result


@kernel
def _level_readings(w: F4, lens: Lens, up: F8, index: I4, height: F4) -> int:
    """Collect every second cell whose surface is level within 25 degrees: its index and height."""
    rows, columns = w.shape
    r = ARM
    n = 0
    bend = np.float32(0.024)
    for i in range(r, rows - r, 2):
        y = (i - lens.cy) / lens.fy
        for j in range(r, columns - r, 2):
            center = w[i, j]
            left, right, top, bottom = w[i, j - r], w[i, j + r], w[i - r, j], w[i + r, j]
            if not ((center > 0) & (left > 0) & (right > 0) & (top > 0) & (bottom > 0)):
                continue
            if (abs(left + right - 2 * center) > bend) | (abs(top + bottom - 2 * center) > bend):
                continue
            wu, wv = (right - left) / (2 * r), (bottom - top) / (2 * r)
            nx, ny = lens.fx * wu, lens.fy * wv
            nz = center - wu * (j - lens.cx) - wv * (i - lens.cy)
            along = -(nx * up[0] + ny * up[1] + nz * up[2])
            if along > 0 and along * along > 0.82 * (nx * nx + ny * ny + nz * nz):
                index[n] = i * columns + j
                x = (j - lens.cx) / lens.fx
                height[n] = (x * up[0] + y * up[1] + up[2]) / center
                n += 1
    return n


@kernel
def _by_height(index: I4, height: F4, base: float, bins: int) -> tuple[I4, I4]:
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


def _refined(cells: Cells, index: I4, offset: float, up: F8) -> Support | None:
    lens = cells.lens
    if offset > -MARGIN_M:  # not seen from above
        return None
    level = _level_plane(lens, up, offset)
    plane = level.copy()
    for _ in range(3):
        count = _refit_cells(cells.w, index, 1.5 * TOLERANCE, plane)
        if count < LEAST_CELLS:
            return None
        if _normal(plane, lens) @ up < STEADY_COS:
            plane = level
            break
    normal = _normal(plane, lens)
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
def _refit_cells(w: F4, index: I4, tolerance: float, plane: F8) -> int:
    """Fit the plane to the listed cells near it by least squares; return how many they are."""
    columns = w.shape[1]
    a, b, c = plane[0], plane[1], plane[2]
    j0, i0 = columns * 0.5, w.shape[0] * 0.5
    n = 0
    mx = my = mw = xx = xy = yy = xw = yw = 0.0
    for p in index:
        i, j = p // columns, p % columns
        v = w[i, j]
        if abs(v - (a * j + b * i + c)) < tolerance:
            x, y = j - j0, i - i0
            n += 1
            mx += x
            my += y
            mw += v
            xx += x * x
            xy += x * y
            yy += y * y
            xw += x * v
            yw += y * v
    if n < 3:
        return 0
    mx, my, mw = mx / n, my / n, mw / n
    xx, xy, yy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    xw, yw = xw / n - mx * mw, yw / n - my * mw
    determinant = xx * yy - xy * xy
    if determinant > 1e-6 * (xx + yy) ** 2:
        a = (xw * yy - yw * xy) / determinant
        b = (yw * xx - xw * xy) / determinant
        plane[0], plane[1] = a, b
        plane[2] = mw - a * (mx + j0) - b * (my + i0)
    return n


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
        i0, j0 = p // columns, p % columns
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
            level = plane[0] * j + plane[1] * i + plane[2]
            if level > 0 and abs(w[i, j] - level) < tolerance:
                first[i] = min(first[i], j)
                last[i] = max(last[i], j)
    step = 2 * math.pi / DIRECTIONS
    for i in range(rows):
        for j in (first[i], last[i]):
            if first[i] > last[i]:
                continue
            z = 1 / (plane[0] * j + plane[1] * i + plane[2])
            x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
            u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
            v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
            for k in range(DIRECTIONS):
                reach[k] = max(reach[k], math.cos(k * step) * u + math.sin(k * step) * v)
    return area


def _boards(cells: Cells, found: list[tuple[Support, I4]]) -> list[Support]:
    """Leave out the tops of objects; ``found`` are planes, lowest first, and their cells.

    Under the front edge of a table or shelf there is nothing; a box is closed down to what it
    stands on. Things lower than 6 cm are never furniture, planes over a quarter of a square metre
    always.
    """
    kept: list[Support] = []
    for support, index in found:
        below = [s for s in kept if _overlaps(s, support)]
        drop = support.offset - below[-1].offset if below else math.inf
        if drop < LEAST_DROP_M:
            continue
        if below and support.area_m2 < SURE_AREA_M2:
            axes = gravity_rotation(support.up)
            seen = np.zeros(2, np.int64)
            plane = np.array([support.a, support.b, support.c])
            _drop(cells.w, cells.lens, index, plane, support.up, axes, drop, seen)
            if seen.sum() >= LEAST_DROPS:
                if seen[0] > CLOSED * seen.sum():
                    continue
            elif support.area_m2 < LIKELY_AREA_M2:
                continue
        kept.append(support)
    return kept


def _overlaps(lower: Support, upper: Support) -> bool:
    """Whether the middle of ``upper`` lies over the outline of ``lower``."""
    middle = corners_of(upper).mean(axis=0)
    flat = gravity_rotation(lower.up)[:2] @ middle
    angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    along = np.cos(angle) * flat[0] + np.sin(angle) * flat[1]
    return bool((along < lower.reach).all())


@kernel
def _drop(w: F4, lens: Lens, index: I4, plane: F8, up: F8, axes: F8, drop: float, seen: I4) -> None:
    """Look below the edge of a plane: count readings on a wall down from it, and beyond it."""
    rows, columns = w.shape
    for p in index[::3]:
        i, j = p // columns, p % columns
        level = plane[0] * j + plane[1] * i + plane[2]
        if level <= 0 or abs(w[i, j] - level) >= TOLERANCE:
            continue
        z = 1 / level
        x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
        # Towards the camera, along the plane.
        h = x * up[0] + y * up[1] + z * up[2]
        tx, ty, tz = h * up[0] - x, h * up[1] - y, h * up[2] - z
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        if length < 0.1 or z < 0.2:
            continue
        tx, ty, tz = 0.01 * tx / length, 0.01 * ty / length, 0.01 * tz / length
        edge = False
        for _ in range(EDGE_STEPS):
            v = int(lens.cy + lens.fy * (y + ty) / (z + tz) + 0.5)
            u = int(lens.cx + lens.fx * (x + tx) / (z + tz) + 0.5)
            if v < 0 or u < 0 or v >= rows or u >= columns or w[v, u] <= 0:
                break
            ahead = w[v, u] - 1 / (z + tz)
            edge = ahead < -2 * TOLERANCE
            if edge or ahead > 2 * TOLERANCE:  # the end of the plane, or something on it
                break
            x, y, z = x + tx, y + ty, z + tz
        if not edge:
            continue
        for k in range(4, 20):
            s = 0.01 * k
            if s > drop - 0.01:
                break
            dx, dy, dz = x - s * up[0], y - s * up[1], z - s * up[2]
            if dz <= NEAREST_M:
                break
            v, u = int(lens.cy + lens.fy * dy / dz + 0.5), int(lens.cx + lens.fx * dx / dz + 0.5)
            if v < 0 or u < 0 or v >= rows or u >= columns:
                break
            if w[v, u] > 0:
                behind = 1 / w[v, u] - dz
                seen[0] += abs(behind) < 0.03
                seen[1] += behind >= 0.03


def corners_of(support: Support) -> F8:
    """Return the corners (k, 3) of the convex outline, sensor frame, in order, without repeats."""
    angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    # Neighbouring sides x cos + y sin = reach meet at a corner.
    step = 2 * np.pi / DIRECTIONS
    here, there = support.reach, np.roll(support.reach, -1)
    along = (there - here * np.cos(step)) / np.sin(step)
    flat = np.stack(
        [
            here * np.cos(angle) - along * np.sin(angle),
            here * np.sin(angle) + along * np.cos(angle),
        ],
        1,
    )
    level = gravity_rotation(support.up)
    corners = flat @ level[:2] + support.offset * level[2]
    return corners
