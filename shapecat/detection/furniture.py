"""Furniture: pieces that are no object but parts of tables and shelves, walls, or noise."""

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.cells import JUMP, NEAREST_M, Cells, Lens
from shapecat.detection.heights import LEAST_M, NOISE
from shapecat.detection.pieces import AREA, COUNT, FAR, FEW, LEFT, RIGHTMOST, RIM, TOP, Pieces
from shapecat.jit import kernel

__all__ = ["is_no_object", "posts_of"]

RIM_LINKS, RIM_SHARE = 8, 0.1
FAINT, FAINT_M2, FAINT_CELLS = 2.5, 3e-3, 120
"""A piece this small must rise so many times above the least height of an object cell."""
POST_M = 0.06
"""A post goes on for so far above and below the level of a board."""


def is_no_object(pieces: Pieces, posts: Bool, *, largest_m: float) -> Bool:
    """Return for each piece whether it is no object, (n + 1,) bool.

    The edge of a board and the legs below it meet the board from below; walls and the sides of
    shelves are larger than ``largest_m``; noise of the plane is small and low.
    """
    shape = pieces.shape
    rim = pieces.single[:, RIM]
    edge = (rim >= RIM_LINKS) & (rim >= RIM_SHARE * pieces.boundary)
    large = shape[:, RIGHTMOST] - shape[:, LEFT] > largest_m
    depth = shape[:, FAR] / shape[:, COUNT].clip(1)
    low = shape[:, TOP] < FAINT * (LEAST_M + NOISE * depth**2)
    faint = low & ((shape[:, AREA] < FAINT_M2) | (shape[:, COUNT] < FAINT_CELLS))
    return np.asarray(edge | large | faint | posts)


def posts_of(cells: Cells, owner: I4, regions: I4, pieces: Pieces, up: F8) -> Bool:
    """Return for each piece whether it goes on through the level of a board, as posts do."""
    through = np.zeros(pieces.group.size, np.int64)
    if owner.max() > 1:
        _through(cells.w, cells.lens, owner, regions, pieces.group, up, through)
    return np.asarray(through >= FEW)


@kernel
def _through(w: F4, lens: Lens, owner: I4, labels: I4, group: I4, up: F8, through: I4) -> None:
    """Count where what is above and below the level of a board is one upright surface."""
    columns = w.shape[1]
    for i in range(w.shape[0]):
        for j in range(columns):
            if labels[i, j] == 0:
                continue
            above = _followed(w, lens, i, j, up, POST_M)
            if above < 0:
                continue
            y, x = above // columns, above % columns
            if labels[y, x] == 0 or owner[y, x] == owner[i, j]:
                continue
            if _followed(w, lens, i, j, up, -POST_M) >= 0:
                through[group[labels[i, j]]] += 1
                through[group[labels[y, x]]] += 1


@kernel
def _followed(w: F4, lens: Lens, i: int, j: int, up: F8, rise: float) -> int:
    """Return the flat cell ``rise`` metres above a cell if the surface is seen there, else -1."""
    z = 1 / w[i, j]
    x = (j - lens.cx) / lens.fx * z + rise * up[0]
    y = (i - lens.cy) / lens.fy * z + rise * up[1]
    z += rise * up[2]
    if z <= NEAREST_M:
        return -1
    v, u = int(lens.cy + lens.fy * y / z + 0.5), int(lens.cx + lens.fx * x / z + 0.5)
    if v < 0 or u < 0 or v >= w.shape[0] or u >= w.shape[1] or abs(w[v, u] - 1 / z) >= JUMP:
        return -1
    return int(v * w.shape[1] + u)
