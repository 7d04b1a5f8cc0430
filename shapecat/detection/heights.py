"""Heights: which plane every cell stands above, and how far (thesis Alg. 2, step 2)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells, Lens
from shapecat.detection.planes import DIRECTIONS, Support
from shapecat.geometry import gravity_rotation
from shapecat.jit import kernel

__all__ = ["LEAST_M", "NOISE", "Heights", "heights_of", "inside", "table_of"]

ANGLES = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COS, SIN = np.cos(ANGLES), np.sin(ANGLES)
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


@kernel
def _stand(
    w: F4, lens: Lens, plane: F8, number: int, highest: float, owner: I4, height: F4
) -> None:
    rows, columns = w.shape
    a, scale = np.float32(plane[0]), np.float32(plane[3])
    least, noise = np.float32(LEAST_M), np.float32(NOISE)
    line = np.zeros(columns, np.float32)
    # A plane seen edge on has heights between the steps of the sensor; so no division is unsafe.
    for i in range(rows):
        base = np.float32(plane[1] * i + plane[2])
        for j in range(columns):
            v = w[i, j]
            inverse = np.float32(1) / v if v > 0 else np.float32(0)
            h = (v - (a * np.float32(j) + base)) * inverse * scale
            gate = least + noise * inverse * inverse
            line[j] = h if (v > 0) & (h > -gate) & (h < highest) else np.float32(-9)
        for j in range(columns):
            if line[j] == np.float32(-9) or owner[i, j] != 0:
                continue
            z = 1.0 / w[i, j]
            x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
            above = line[j] > least + noise * z * z
            if inside(plane, x, y, z, 0.0 if above else BEYOND_M):
                owner[i, j] = number if above else -number
                height[i, j] = line[j]


@kernel
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
