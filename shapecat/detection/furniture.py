"""Furniture: pieces that are no object but parts of tables and shelves, walls, or noise."""

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, Bool
from shapecat.detection.cells import JUMP, NEAREST_M, Cells, Lens
from shapecat.detection.heights import LEAST_M, NOISE
from shapecat.detection.pieces import (
    AREA,
    BOTTOM,
    CONTACT,
    COUNT,
    FEW,
    FRONT,
    HIDDEN,
    LEFT,
    RIGHTMOST,
    RIM,
    SAMPLES,
    TOP,
    Pieces,
    depths_of,
    is_group,
)
from shapecat.detection.walls import CLEARED, ON_WALL
from shapecat.jit import kernel

__all__ = [
    "cut_by_range",
    "is_no_object",
    "posts_of",
    "remains_of",
    "sides_of",
    "towers_of",
    "unbounded",
]

RIM_LINKS, RIM_SHARE = 8, 0.1
"""Links with a higher plane, from below, of the edge of a board or its legs; share of the boundary.
"""
FAINT, FAINT_NOISE, FAINT_M2, FAINT_CELLS = 2.5, 3.5, 3e-3, 250
"""A piece this small must rise so many times above the least height of an object cell, and of the
noise in it: spots of noise gather where there is much of a plane far away."""
POST_M = 0.06
"""A post goes on for so far above and below the level of a board."""
REMAINS = 0.8
"""Share of the cells of a piece on a wall."""
UNBOUNDED, WALLED = 0.1, 0.45
"""Share of the boundary of a piece across which its surface goes on to where no plane reaches, and
in a wall: of the front of the side of a shelf half does, of a bowl that stands against one less."""
CUT = 0.2
"""Share of the cells of a piece that are the last before the end of the range."""
STEP_M, STEPS, MISSES = 0.02, 64, 2.0
"""A surface is followed up or down in at most so many steps, until it was not seen in more than
two; where something hides it, half a step counts."""
TOWERING = 0.5
"""Share of a piece below surface that goes on beyond the greatest height."""
EDGE_ON, SPECKLED, SPECKS = 3.0, 2.3, 100
"""Surface by what it covers of the view from which it is seen edge on, whether or not many readings
fail there: the square of its boundary by its cells is 16 for a square."""
UPRIGHT, SLENDER, COVERED = 0.03, 0.65, 0.5
"""What is seen edge on: share that faces up; width by height; and the share of its boundary behind
other things from which they may hide the rest."""


def is_no_object(pieces: Pieces, furniture: Bool, raised: Bool, *, largest_m: float) -> Bool:
    """Return for each piece whether it is no object, (n + 1,) bool, ``furniture`` included.

    The edge of a board and the legs below it meet the board from below; walls and the sides of
    shelves are larger than ``largest_m``; noise of the plane is small and low, and was not
    ``raised``.
    """
    shape = pieces.shape
    rim = pieces.single[:, RIM]
    edge = (rim >= RIM_LINKS) & (rim >= RIM_SHARE * pieces.boundary)
    large = shape[:, RIGHTMOST] - shape[:, LEFT] > largest_m
    depth = depths_of(pieces)
    low = shape[:, TOP] < FAINT * LEAST_M + FAINT_NOISE * NOISE * depth**2
    faint = low & ((shape[:, AREA] < FAINT_M2) | (shape[:, COUNT] < FAINT_CELLS))
    return np.asarray(edge | large | (faint & ~raised) | furniture)


def posts_of(cells: Cells, owner: I4, regions: I4, spans: I4, pieces: Pieces, up: F8) -> Bool:
    """Return for each piece whether it goes on through the level of a board, as posts do."""
    through = np.zeros(pieces.group.size, np.int64)
    if owner.max() > 1:
        _through(cells.w, cells.lens, owner, regions, spans, pieces.group, up, through)
    return np.asarray(through >= FEW)


def remains_of(walls: U1, regions: I4, pieces: Pieces) -> Bool:
    """Return for each piece whether it is a small part of a wall, between the objects before it."""
    size = pieces.group.size
    on = np.bincount(pieces.group[regions[walls == ON_WALL]], minlength=size)
    return np.asarray(on > REMAINS * pieces.shape[:, COUNT])


def cut_by_range(cells: Cells, regions: I4, pieces: Pieces, *, range_m: float) -> Bool:
    """Return for each piece whether it ends where the range of the readings does.

    What is left of a wall or a floor there has an outline that is not its own.
    """
    size = pieces.group.size
    cut = np.bincount(pieces.group, cells.count_last(regions, size, range_m=range_m), size)
    return np.asarray(cut > CUT * pieces.shape[:, COUNT])


def sides_of(cells: Cells, pieces: Pieces) -> Bool:
    """Return for each piece whether it is upright and seen only edge on, as sides of shelves are.

    An object has a front too, unless something hides it.
    """
    shape, lens = pieces.shape, cells.lens
    covered = shape[:, COUNT] * depths_of(pieces) ** 2 / (lens.fx * lens.fy)
    speckled = pieces.boundary**2 > SPECKS * shape[:, COUNT]
    edge_on = shape[:, AREA] > np.where(speckled, SPECKLED, EDGE_ON) * covered
    upright = pieces.lid.sum(axis=1) < UPRIGHT * shape[:, AREA]
    upright &= shape[:, RIGHTMOST] - shape[:, LEFT] < SLENDER * (shape[:, TOP] - shape[:, BOTTOM])
    hidden = pieces.pairs[FRONT].sum(axis=0) + pieces.single[:, HIDDEN]
    alone = pieces.pairs[CONTACT].sum(axis=1) < FEW
    return np.asarray(edge_on & upright & alone & (hidden < COVERED * pieces.boundary))


def unbounded(
    cells: Cells, planes: F8, owner: I4, walls: U1, regions: I4, spans: I4, pieces: Pieces
) -> Bool:
    """Return for each piece whether its surface goes on to where no plane reaches, or in a wall.

    Walls and floors are cut off there; an object ends where it ends.
    """
    size = pieces.group.size
    leaving = np.zeros((2, size), np.int64)
    _leave(cells.w, planes, owner, walls, regions, spans, leaving)
    beyond, to_wall = (np.bincount(pieces.group, count, size) for count in leaving)
    limit = pieces.boundary
    return np.asarray((beyond > UNBOUNDED * limit) | (to_wall > WALLED * limit))


def towers_of(cells: Cells, planes: F8, pieces: Pieces, up: F8, *, highest_m: float) -> Bool:
    """Return for each piece whether its surface goes straight up and down for ``highest_m``.

    The sides of shelves, door frames and whatever stands before the table reach higher above a
    plane than objects on it, or down below it, also where only pieces of them are seen.
    """
    share = np.zeros(pieces.group.size)
    _tower(cells.w, cells.lens, planes, pieces, up, highest_m, share)
    return np.asarray(share > TOWERING)


@kernel
def _leave(w: F4, planes: F8, owner: I4, walls: U1, regions: I4, spans: I4, leaving: I4) -> None:
    """Count the neighbours of each region on the same surface beyond its plane and on walls."""
    rows, columns = w.shape
    for i in range(1, rows - 1):
        for j in range(max(spans[i, 0], 1), min(spans[i, 1], columns - 1)):
            if regions[i, j] == 0:
                continue
            plane = planes[owner[i, j] - 1]
            for y, x in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)):
                if (
                    owner[y, x] == 0
                    and w[y, x] > max(plane[0] * x + plane[1] * y + plane[2], 0)
                    and abs(w[y, x] - w[i, j]) < JUMP
                ):
                    leaving[int(walls[y, x] == CLEARED), regions[i, j]] += 1


@kernel(leaf=True)
def _tower(
    w: F4, lens: Lens, planes: F8, pieces: Pieces, up: F8, highest: float, share: F8
) -> None:
    """Write the share of the samples of each piece from which the surface goes on so high."""
    columns = w.shape[1]
    for p in range(1, share.size):
        if not is_group(pieces, p) or pieces.owner[p] <= 0:
            continue
        plane = planes[pieces.owner[p] - 1]
        n = high = 0
        for t in range(SAMPLES):
            s = pieces.samples[p, t]
            if s < 0:
                break
            i, j = s // columns, s % columns
            z = 1 / w[i, j]
            h = (w[i, j] - (plane[0] * j + plane[1] * i + plane[2])) * z * plane[3]
            n += 1
            rise = _rise(w, lens, i, j, up, 1, highest)
            if h + rise > highest - STEP_M:
                high += 1
            else:
                high += rise + _rise(w, lens, i, j, up, -1, highest - rise) > highest - STEP_M
        share[p] = high / max(n, 1)


@kernel(leaf=True)
def _rise(w: F4, lens: Lens, i: int, j: int, up: F8, sign: int, most: float) -> float:
    """Return how far the surface of a cell goes straight on upwards, up to about ``most``.

    With ``sign`` -1 downwards.
    """
    z = 1 / w[i, j]
    x, y = (j - lens.cx) / lens.fx * z, (i - lens.cy) / lens.fy * z
    reach = misses = 0.0
    for k in range(1, STEPS):
        d = STEP_M * k
        along = sign * d
        depth = z + along * up[2]
        if d > most + STEP_M or depth <= NEAREST_M:
            break
        v = int(lens.cy + lens.fy * (y + along * up[1]) / depth + 0.5)
        u = int(lens.cx + lens.fx * (x + along * up[0]) / depth + 0.5)
        if v < 0 or u < 0 or v >= w.shape[0] or u >= w.shape[1]:
            break
        ahead = w[v, u] - 1 / depth
        if abs(ahead) < JUMP:
            reach, misses = d, 0.0
            continue
        misses += 0.5 if ahead > 0 else 1.0  # something in front of it hides it
        if misses > MISSES:
            break
    return reach


@kernel(leaf=True)
def _through(
    w: F4, lens: Lens, owner: I4, labels: I4, spans: I4, group: I4, up: F8, through: I4
) -> None:
    """Count where what is above and below the level of a board is one upright surface."""
    columns = w.shape[1]
    for i in range(w.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
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


@kernel(leaf=True)
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
