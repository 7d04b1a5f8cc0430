"""Heights: which plane every cell stands above, and how far (thesis Alg. 2, step 2)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells, Lens
from shapecat.detection.planes import COS, DIRECTIONS, SIN, Support
from shapecat.geometry import gravity_rotation
from shapecat.jit import kernel

__all__ = ["LEAST_M", "NOISE", "Heights", "heights_of", "inside", "table_of"]

LEAST_M = 0.004
"""Lowest height of an object cell, to which `NOISE` times the squared range is added."""
NOISE = 0.0025
BEYOND_M = 0.1
"""What is level with a plane and this near to its outline is the plane, not an object below."""


class Heights(NamedTuple):
    """What every cell stands on.

    Attributes
    ----------
    owner : (rows, columns) int8: k + 1 above plane k and inside its outline, -(k + 1) on its
        surface, 0 elsewhere.
    height : (rows, columns) float32, metres above the plane of `owner`.
    """

    owner: I4
    height: F4


def table_of(supports: list[Support], lens: Lens) -> F8:
    """Return one row of numbers per plane, for the kernels."""
    rows = np.zeros((len(supports), 13 + DIRECTIONS))
    quarter, half = DIRECTIONS // 4, DIRECTIONS // 2
    for row, s in zip(rows, supports, strict=True):
        n = (s.a * lens.fx, s.b * lens.fy, s.a * lens.cx + s.b * lens.cy + s.c)
        level = gravity_rotation(s.up)
        row[:4] = s.a, s.b, s.c, 1.0 / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
        row[4:10] = level[:2].ravel()
        # A circle inside the outline, for a quick answer.
        middle = (s.reach[[0, quarter]] - s.reach[[half, half + quarter]]) / 2
        row[10:12] = middle
        room = s.reach - middle[0] * COS - middle[1] * SIN
        row[12] = max(float(room.min()), 0.0) ** 2
        row[13:] = s.reach
    return rows


def heights_of(cells: Cells, planes: F8, *, highest_m: float) -> Heights:
    """Give every cell to the highest plane it is above; ``planes`` are the rows of `table_of`."""
    owner = np.zeros(cells.w.shape, np.int8)
    height = np.zeros(cells.w.shape, np.float32)
    for k, row in reversed(list(enumerate(planes))):
        _stand(cells.w, cells.lens, row, k + 1, highest_m, owner, height)
    return Heights(owner, height)


@kernel(fast=True)
def _stand(
    w: F4, lens: Lens, plane: F8, number: int, highest: float, owner: I4, height: F4
) -> None:
    """Give the free cells inside the outline of a plane to it; the loops over a row vectorise."""
    rows, columns = w.shape
    a, scale, zero, one = np.float32(plane[0]), np.float32(plane[3]), np.float32(0), np.float32(1)
    least, noise, below = np.float32(LEAST_M), np.float32(NOISE), np.float32(-9)
    beyond, high = np.float32(BEYOND_M), np.float32(highest)
    above, surface = np.int8(number), np.int8(-number)
    x = np.arange(columns).astype(np.float32)
    line, slack = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    # Level coordinates times inverse depth are linear in the image: (per column, per row, rest).
    sides = np.zeros((DIRECTIONS // 2, 3))
    for d in range(2):
        p, q = plane[4 + 3 * d] / lens.fx, plane[5 + 3 * d] / lens.fy
        for k in range(DIRECTIONS // 2):
            part = SIN[k] if d else COS[k]
            sides[k, 0] += part * p
            sides[k, 1] += part * q
            sides[k, 2] += part * (plane[6 + 3 * d] - p * lens.cx - q * lens.cy)
    # A plane seen edge on has heights between the steps of the sensor; so no division is unsafe.
    for i in range(rows):
        base = np.float32(plane[1] * i + plane[2])
        values, owners, heights = w[i], owner[i], height[i]
        some = False
        for j in range(columns):
            v = values[j]
            z = one / v if v > zero else zero
            h = (v - (a * x[j] + base)) * z * scale
            gate = least + noise * z * z
            use = (v > zero) & (h > -gate) & (h < high) & (owners[j] == 0)
            line[j] = h if use else below
            slack[j] = zero if h > gate else beyond * v
            some |= use
        if not some:
            continue
        for k in range(0, DIRECTIONS // 2, 2):  # two at a time: less to load and to store
            step, first = np.float32(sides[k, 0]), np.float32(sides[k, 1] * i + sides[k, 2])
            far, near = np.float32(plane[13 + k]), np.float32(plane[13 + k + DIRECTIONS // 2])
            m = k + 1
            step1, first1 = np.float32(sides[m, 0]), np.float32(sides[m, 1] * i + sides[m, 2])
            far1, near1 = np.float32(plane[13 + m]), np.float32(plane[13 + m + DIRECTIONS // 2])
            for j in range(columns):
                v, room = values[j], slack[j]
                t, t1 = step * x[j] + first, step1 * x[j] + first1
                within = (t <= far * v + room) & (-t <= near * v + room)
                within &= (t1 <= far1 * v + room) & (-t1 <= near1 * v + room)
                line[j] = line[j] if within else below
        for j in range(columns):
            mine = above if slack[j] == zero else surface
            owners[j] = mine if line[j] > below else owners[j]
        for j in range(columns):
            heights[j] = line[j] if line[j] > below else heights[j]


@kernel(leaf=True)
def inside(plane: F8, x: float, y: float, z: float, slack: float) -> bool:
    """Whether a point is within the outline of a row of `table_of`, or ``slack`` beyond it."""
    p = plane[4] * x + plane[5] * y + plane[6] * z
    q = plane[7] * x + plane[8] * y + plane[9] * z
    if (p - plane[10]) ** 2 + (q - plane[11]) ** 2 < plane[12]:
        return True
    for k in range(DIRECTIONS):  # noqa: SIM110  kernels have no generators
        if COS[k] * p + SIN[k] * q > plane[13 + k] + slack:
            return False
    return True
