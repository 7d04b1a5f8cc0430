"""Surfaces: a tangent plane for every object cell, the links between cells, and concave edges."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, U1
from shapecat.detection.cells import JUMP, Cells, Lens
from shapecat.detection.heights import Heights
from shapecat.detection.tangents import fit_tangents
from shapecat.jit import kernel

__all__ = ["DOWN", "RIGHT", "Surfaces", "surfaces_of"]

RIGHT, DOWN = 1, 2
"""Bits of `Surfaces.links`."""
BASE, BASE_DIAGONAL = 3, 2
"""Cells between an edge and the surfaces on its two sides."""
LEAST_CHORD = 3e-4
"""Squared distance of two normals from which their angle is a degree."""


class Surfaces(NamedTuple):
    """What every object cell knows of its surface.

    Attributes
    ----------
    tangent : (rows, columns, 3) float32: inverse depth of the fitted plane at the cell, and its
        change per column and per row. The first is 0 where there is no fit.
    normal : (rows, columns, 3) float32 unit normal towards the camera, sensor frame.
    links : (rows, columns) uint8: `RIGHT` and `DOWN` where the surface goes on to that neighbour.
    edge : (rows, columns) uint8: the largest concave angle across the cell, degrees.
    """

    tangent: F4
    normal: F4
    links: U1
    edge: U1


def surfaces_of(cells: Cells, heights: Heights) -> Surfaces:
    """Fit tangent planes to the object cells, link them and measure concave angles."""
    shape = cells.w.shape
    tangent, normal = np.zeros((2, *shape, 3), np.float32)
    links, edge = np.zeros((2, *shape), np.uint8)
    surfaces = Surfaces(tangent, normal, links, edge)
    _survey(cells.w, cells.lens, heights.owner, surfaces)
    return surfaces


@kernel
def _survey(w: F4, lens: Lens, owner: I4, surfaces: Surfaces) -> None:
    fit_tangents(w, lens, owner, surfaces.tangent, surfaces.normal)
    _link(w, owner, surfaces.tangent, surfaces.links)
    _bend(w, lens, surfaces.tangent, surfaces.normal, surfaces.edge)


@kernel(fast=True)
def _link(w: F4, owner: I4, tangent: F4, links: U1) -> None:
    """Link neighbours where either tangent plane, or the step itself, meets within one jump."""
    rows, columns = w.shape
    jump = np.float32(JUMP)
    for i in range(rows):
        for j in range(columns):
            me = owner[i, j]
            if me <= 0:
                continue
            v, t, bits = w[i, j], tangent[i, j, 0], 0
            if j + 1 < columns and owner[i, j + 1] == me:
                v1, t1 = w[i, j + 1], tangent[i, j + 1, 0]
                joined = abs(v - v1) < jump
                joined |= (t > 0) & (abs(t + tangent[i, j, 1] - v1) < jump)
                joined |= (t1 > 0) & (abs(t1 - tangent[i, j + 1, 1] - v) < jump)
                bits |= RIGHT if joined else 0
            if i + 1 < rows and owner[i + 1, j] == me:
                v1, t1 = w[i + 1, j], tangent[i + 1, j, 0]
                joined = abs(v - v1) < jump
                joined |= (t > 0) & (abs(t + tangent[i, j, 2] - v1) < jump)
                joined |= (t1 > 0) & (abs(t1 - tangent[i + 1, j, 2] - v) < jump)
                bits |= DOWN if joined else 0
            links[i, j] = bits


@kernel(fast=True)
def _bend(w: F4, lens: Lens, tangent: F4, normal: F4, edge: U1) -> None:
    """Measure the largest concave angle between the surfaces on two sides of each cell."""
    rows, columns = w.shape
    gate = np.float32(2 * JUMP)
    one = np.float32(1)
    degrees = np.float32(180 / math.pi)
    per_x, per_y = np.float32(1 / lens.fx), np.float32(1 / lens.fy)
    cx, cy = np.float32(lens.cx), np.float32(lens.cy)
    for i in range(rows):
        for j in range(columns):
            if not tangent[i, j, 0] > 0:
                continue
            here = w[i, j]
            worst = np.float32(LEAST_CHORD)
            for d in range(4):
                r = BASE if d < 2 else BASE_DIAGONAL
                di = 0 if d == 0 else r
                dj = r if d == 0 else (0 if d == 1 else (r if d == 2 else -r))
                i1, j1, i2, j2 = i - di, j - dj, i + di, j + dj
                if i1 < 0 or i2 >= rows or min(j1, j2) < 0 or max(j1, j2) >= columns:
                    continue
                w1, w2 = tangent[i1, j1, 0], tangent[i2, j2, 0]
                if not ((w1 > 0) & (w2 > 0)):
                    continue
                x, y = np.float32(dj), np.float32(di)
                meet1 = w1 + tangent[i1, j1, 1] * x + tangent[i1, j1, 2] * y
                meet2 = w2 - tangent[i2, j2, 1] * x - tangent[i2, j2, 2] * y
                if (abs(meet1 - here) > gate) | (abs(meet2 - here) > gate):
                    continue
                nx = normal[i1, j1, 0] - normal[i2, j2, 0]
                ny = normal[i1, j1, 1] - normal[i2, j2, 1]
                nz = normal[i1, j1, 2] - normal[i2, j2, 2]
                chord = nx * nx + ny * ny + nz * nz
                if chord <= worst:
                    continue
                z1, z2 = one / w1, one / w2
                px = per_x * ((np.float32(j1) - cx) * z1 - (np.float32(j2) - cx) * z2)
                py = per_y * ((np.float32(i1) - cy) * z1 - (np.float32(i2) - cy) * z2)
                if px * nx + py * ny + (z1 - z2) * nz < 0:
                    worst = chord
            half = np.sqrt(worst) * np.float32(0.5)
            # arcsin by its series: 1 degree off at a right angle
            angle = 2 * degrees * (half + half * half * half * np.float32(0.18))
            edge[i, j] = np.uint8(min(angle, np.float32(120)))
