"""Views: an unorganized cloud as the image a depth camera would have taken of it."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import CELL_M, JUMP, NEAREST_M, Cells, Lens
from shapecat.jit import kernel
from shapecat.types import Pose

__all__ = ["View", "view_of"]

FIELD = 1.5
"""Largest tangent of the angle between a point and the optical axis."""
MOST_CELLS = 400_000


class View(NamedTuple):
    """A cloud in a virtual camera.

    Attributes
    ----------
    cells : the image of the nearest points.
    points : (n, 3) float32 in the frame of the virtual camera; 0 where not used.
    cell : (n,) int32 flat cell of each point, -1 outside.
    view_from_sensor : pose of the cloud in the frame of the virtual camera.
    crowded : share of the points that lie well behind others of their cell.
    """

    cells: Cells
    points: F4
    cell: I4
    view_from_sensor: Pose
    crowded: float


def view_of(points: F4, *, range_m: float, origin: F8 | None = None) -> View | None:
    """Look at ``points`` (n, 3), sensor frame, from ``origin``; None if there are too few.

    The optical axis points at the middle of the cloud; the cells are as wide as the points are
    apart, and not narrower than those of depth images.
    """
    used = np.isfinite(points).all(axis=1)
    used &= np.abs(points, where=used[:, None], out=np.full(points.shape, np.inf, np.float32)).max(
        axis=1, initial=0
    ) <= 100 * range_m
    if np.count_nonzero(used) < 100:
        return None
    origin = np.zeros(3) if origin is None else origin
    local = np.where(used[:, None], points - origin.astype(np.float32), np.float32(0))
    distance = np.sqrt(np.einsum("ij,ij->i", local, local))
    used &= (distance >= NEAREST_M) & (distance <= range_m * 1.5)
    if np.count_nonzero(used) < 100:
        return None
    axis = (local[used] / distance[used, None]).mean(axis=0, dtype=np.float64)
    if np.linalg.norm(axis) < 0.3:  # all around the sensor
        return None
    pose = Pose(_facing(axis), -_facing(axis) @ origin)
    turned = (local @ pose.rotation.T.astype(np.float32)).astype(np.float32)
    used &= (turned[:, 2] >= NEAREST_M) & (turned[:, 2] <= range_m)
    turned[~used] = 0
    return _imaged(turned, used, pose)


def _facing(axis: F8) -> F8:
    """Return the rotation that turns ``axis`` to +z and keeps +x right as well as it can."""
    z = axis / np.linalg.norm(axis)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.8 else np.array([0.0, -1.0, 0.0])
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _imaged(turned: F4, used: I4, pose: Pose) -> View | None:
    z = turned[used, 2]
    if z.size < 100:
        return None
    x, y = turned[used, 0] / z, turned[used, 1] / z
    inside = np.maximum(abs(x), abs(y)) < FIELD
    x, y, z = x[inside], y[inside], z[inside]
    if z.size < 100:
        return None
    pitch = max(CELL_M / float(np.median(z)), 1.2 * _spacing(x, y))
    box = float(np.ptp(x)) * float(np.ptp(y))
    pitch = max(pitch, math.sqrt(box / MOST_CELLS), 1e-6)
    left, top = float(x.min()), float(y.min())
    lens = Lens(1 / pitch, 1 / pitch, -left / pitch, -top / pitch)
    shape = (int(np.ptp(y) / pitch + 1.5), int(np.ptp(x) / pitch + 1.5))
    w = np.zeros(shape, np.float32)
    cell = np.full(len(turned), -1, np.int32)
    behind = _project(turned, lens, FIELD, w, cell)
    _close_holes(w)
    return View(Cells(w, lens, 1), turned, cell, pose, behind / z.size)


def _spacing(x: F4, y: F4) -> float:
    """Return the typical distance of neighbours in the image plane.

    Squares are halved until they hold one point or two on average.
    """
    span = max(float(np.ptp(x)), float(np.ptp(y)), 1e-6)
    cut = span / 32
    for _ in range(9):
        key = ((x - x.min()) / cut).astype(np.int64) * 100_000 + ((y - y.min()) / cut).astype(
            np.int64
        )
        load = x.size / np.unique(key).size
        if load < 3:
            break
        cut /= 1.5
    return cut * math.sqrt(1 / load)


@kernel
def _project(points: F4, lens: Lens, field: float, w: F4, cell: I4) -> int:
    """Average the nearest points of each cell; return how many lie well behind them."""
    rows, columns = w.shape
    nearest = np.zeros(w.shape, np.float32)
    count = np.zeros(w.shape, np.float32)
    for k in range(points.shape[0]):
        z = points[k, 2]
        if not z > 0:
            continue
        x, y = points[k, 0] / z, points[k, 1] / z
        if not ((abs(x) < field) & (abs(y) < field)):
            continue
        j, i = int(lens.fx * x + lens.cx + 0.5), int(lens.fy * y + lens.cy + 0.5)
        if i < 0 or j < 0 or i >= rows or j >= columns:
            continue
        cell[k] = i * columns + j
        nearest[i, j] = max(nearest[i, j], np.float32(1) / z)
    behind = 0
    for k in range(points.shape[0]):
        if cell[k] < 0:
            continue
        i, j = cell[k] // columns, cell[k] % columns
        v = np.float32(1) / points[k, 2]
        if v > nearest[i, j] - JUMP:
            w[i, j] += v
            count[i, j] += 1
        elif v < nearest[i, j] - 3 * JUMP:
            behind += 1
    for i in range(rows):
        for j in range(columns):
            if count[i, j] > 0:
                w[i, j] /= count[i, j]
    return behind


@kernel
def _close_holes(w: F4) -> None:
    """Give cells between two neighbours of one surface their mean."""
    rows, columns = w.shape
    source = w.copy()
    for i in range(1, rows - 1):
        for j in range(1, columns - 1):
            if source[i, j] > 0:
                continue
            total, n = np.float32(0), 0
            a, b = source[i, j - 1], source[i, j + 1]
            if (a > 0) & (b > 0) & (abs(a - b) < JUMP):
                total += a + b
                n += 2
            a, b = source[i - 1, j], source[i + 1, j]
            if (a > 0) & (b > 0) & (abs(a - b) < JUMP):
                total += a + b
                n += 2
            if n > 0:
                w[i, j] = total / n
