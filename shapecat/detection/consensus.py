"""Consensus: planes that many readings agree on (RANSAC, Fischler and Bolles 1981)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells, Lens
from shapecat.jit import kernel

__all__ = [
    "TOLERANCE",
    "Readings",
    "best_plane",
    "count_near",
    "level_plane",
    "normal_of",
    "readings_of",
    "refit",
    "without",
]

TOLERANCE = 0.01
"""Distance of an inlier from a plane in inverse depth, 1/m: three steps of a Kinect."""
TRIALS = 240
LEAST_DOUBLE_AREA = 30.0
"""Of the triangle of three readings, in cells squared: smaller ones are mostly noise."""
SAMPLE = 4800
"""About as many cells propose planes and vote."""


class Readings(NamedTuple):
    """Cells in a list: ``j`` (n,) columns, ``i`` (n,) rows, ``w`` (n,) inverse depth, float32.

    ``share`` is how many cells each stands for.
    """

    j: F4
    i: F4
    w: F4
    share: int


def readings_of(cells: Cells, owner: I4 | None = None) -> Readings:
    """Return evenly spaced cells with a reading, those of objects if there is an ``owner``."""
    stride = max(1, round(math.sqrt(cells.w.size / SAMPLE)))
    j, i, w = _listed(cells.w, cells.w if owner is None else owner, stride)
    return Readings(j, i, w, stride * stride)


@kernel
def _listed(w: F4, wanted: F4, stride: int) -> tuple[F4, F4, F4]:
    """Return the columns, rows and values above 0 of every so many cells, where ``wanted`` is."""
    rows, columns = w.shape
    result = np.zeros((3, (rows // stride + 1) * (columns // stride + 1)), np.float32)
    n = 0
    for i in range(stride // 2, rows, stride):
        for j in range(stride // 2, columns, stride):
            if w[i, j] > 0 and wanted[i, j] > 0:
                result[0, n], result[1, n], result[2, n] = j, i, w[i, j]
                n += 1
    return result[0, :n], result[1, :n], result[2, :n]


def without(readings: Readings, plane: F8, tolerance: float) -> Readings:
    """Return the readings that are not near a plane."""
    a, b, c = plane.astype(np.float32)
    far = abs(readings.w - (a * readings.j + b * readings.i + c)) > tolerance
    return Readings(readings.j[far], readings.i[far], readings.w[far], readings.share)


def normal_of(plane: F8, lens: Lens) -> F8:
    """Return the unit normal towards the camera of a plane (a, b, c) of inverse depth."""
    a, b, c = plane.tolist()
    x, y, z = -a * lens.fx, -b * lens.fy, -(a * lens.cx + b * lens.cy + c)
    norm = math.sqrt(x * x + y * y + z * z)
    return np.array([x / norm, y / norm, z / norm])


def level_plane(lens: Lens, up: F8, offset: float) -> F8:
    """Return the plane ``up @ p == offset`` as inverse depth (a, b, c)."""
    a, b = up[0] / lens.fx, up[1] / lens.fy
    return np.array([a, b, up[2] - a * lens.cx - b * lens.cy]) / offset


def best_plane(
    readings: Readings,
    lens: Lens,
    guide: F8,
    cosines: tuple[float, float],
    rng: np.random.Generator,
    *,
    tolerance: float = TOLERANCE,
) -> tuple[F8, int]:
    """Return the plane (a, b, c) with most inliers, and how many readings these are.

    Only planes count whose normal towards the camera has a cosine within ``cosines`` to
    ``guide``. No readings agree on a plane: 0.
    """
    plane = np.zeros(3)
    n = readings.w.size
    triples = rng.integers(0, max(n, 1), (TRIALS if n >= 3 else 0, 3))
    return plane, _consensus(readings, triples, lens, guide, cosines, tolerance, plane)


@kernel
def _consensus(
    readings: Readings,
    triples: I4,
    lens: Lens,
    guide: F8,
    cosines: tuple[float, float],
    tolerance: float,
    best: F8,
) -> int:
    most = 0
    for t in range(triples.shape[0]):
        # (1) three readings propose a plane
        p, q, r = triples[t]
        w0 = float(readings.w[p])
        j1, i1 = readings.j[q] - readings.j[p], readings.i[q] - readings.i[p]
        j2, i2 = readings.j[r] - readings.j[p], readings.i[r] - readings.i[p]
        double = i1 * j2 - i2 * j1
        if abs(double) < LEAST_DOUBLE_AREA:
            continue
        a = (i1 * (readings.w[r] - w0) - i2 * (readings.w[q] - w0)) / double
        b = (j2 * (readings.w[q] - w0) - j1 * (readings.w[r] - w0)) / double
        c = w0 - a * readings.j[p] - b * readings.i[p]
        nx, ny, nz = a * lens.fx, b * lens.fy, a * lens.cx + b * lens.cy + c
        along = -(nx * guide[0] + ny * guide[1] + nz * guide[2])
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if not ((along >= cosines[0] * norm) & (along <= cosines[1] * norm)):
            continue
        # (2) all vote
        votes = count_near(readings, a, b, c, tolerance)
        if votes > most:
            most = votes
            best[0], best[1], best[2] = a, b, c
    # (3) the inliers refit
    for _ in range(4):
        refit(readings.j, readings.i, readings.w, tolerance, best)
    return count_near(readings, best[0], best[1], best[2], tolerance) if most >= 3 else 0


@kernel(fast=True)
def count_near(readings: Readings, a: float, b: float, c: float, tolerance: float) -> int:
    """Count the readings near a plane."""
    a4, b4, c4, gate = np.float32(a), np.float32(b), np.float32(c), np.float32(tolerance)
    total = np.int32(0)
    for k in range(readings.w.size):
        level = a4 * readings.j[k] + b4 * readings.i[k] + c4
        total += np.int32(abs(readings.w[k] - level) < gate)
    return int(total)


@kernel(fast=True, leaf=True)
def refit(j: F4, i: F4, w: F4, tolerance: float, plane: F8) -> int:
    """Fit a plane (a, b, c) to its inliers by least squares; return how many they are.

    The plane stays as it is if they do not span one.
    """
    if w.size == 0:
        return 0
    a, b, c = plane[0], plane[1], plane[2]
    j0, i0, w0 = float(j[0]), float(i[0]), float(w[0])
    n = mx = my = mw = xx = xy = yy = xw = yw = 0.0
    for k in range(w.size):
        # A sum of products with 0 or 1 vectorises.
        near = 1.0 if abs(w[k] - (a * j[k] + b * i[k] + c)) < tolerance else 0.0
        x, y, v = near * (j[k] - j0), near * (i[k] - i0), near * (w[k] - w0)
        n += near
        mx += x
        my += y
        mw += v
        xx += x * x
        xy += x * y
        yy += y * y
        xw += x * v
        yw += y * v
    if n < 3:
        return int(n)
    mx, my, mw = mx / n, my / n, mw / n
    xx, xy, yy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    xw, yw = xw / n - mx * mw, yw / n - my * mw
    determinant = xx * yy - xy * xy
    if determinant > 1e-6 * (xx + yy) ** 2:
        a = (xw * yy - yw * xy) / determinant
        b = (yw * xx - xw * xy) / determinant
        plane[0], plane[1] = a, b
        plane[2] = w0 + mw - a * (mx + j0) - b * (my + i0)
    return int(n)
