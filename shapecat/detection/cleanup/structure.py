"""Furniture: pieces that are no object but parts of tables and shelves, walls, or noise."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, Bool
from shapecat.detection.depth_grid import Lens, count_last, place_of
from shapecat.detection.foreground.walls import CLEARED, ON_WALL
from shapecat.detection.merging.segment_features import top_band
from shapecat.detection.merging.segments import (
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
    TOP,
    Pieces,
    depth_of,
    is_group,
)
from shapecat.detection.planes.height_map import LEAST_M, NOISE
from shapecat.geometry import DISCONTINUITY, NEAREST_M
from shapecat.jit import kernel

__all__ = ["Field", "Limits", "is_no_object"]

THROUGH, BEYOND, TO_WALL, ON, LAST = range(5)
"""Counts of cells of each region: from which it goes on through the level of a board; of their
neighbours on the same surface beyond every plane and in walls; on walls; at the end of the range.
"""
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


class Field(NamedTuple):
    """What is known of the cells, as in `Cells`, `Heights`, `OverSegmentation` and `Surfaces`."""

    w: F4
    lens: Lens
    planes: F8
    owner: I4
    walls: U1
    regions: I4
    spans: I4


class Limits(NamedTuple):
    """Of objects, metres: how high above a plane, how wide, and how far away they are at most."""

    highest_m: float
    largest_m: float
    range_m: float


@kernel
def is_no_object(field: Field, pieces: Pieces, up: F8, known: Bool, limits: Limits) -> Bool:
    """Return for each piece whether it is no object, (n + 1,) bool.

    What has been merged into another is left out. What is ``known`` to be an object is no noise.
    """
    n = pieces.group.size
    counts, refused = np.zeros((5, n), np.int64), np.zeros(n, np.bool_)
    counts[LAST] = count_last(field.w, field.regions, n, limits.range_m)
    _count_through(field, up, counts[THROUGH])
    _count_leaving(field, counts)
    for p in range(n):
        if not is_group(pieces, p):
            counts[:, pieces.group[p]] += counts[:, p]
    for p in range(1, n):
        if not is_group(pieces, p):
            continue
        cells, boundary = pieces.shape[p, COUNT], pieces.boundary[p]
        refused[p] = (
            _is_rim(pieces, p)
            or pieces.shape[p, RIGHTMOST] - pieces.shape[p, LEFT] > limits.largest_m
            or (not known[p] and _is_faint(pieces, p))
            or counts[THROUGH, p] >= FEW
            or counts[ON, p] > REMAINS * cells
            or counts[LAST, p] > CUT * cells
            or counts[BEYOND, p] > UNBOUNDED * boundary
            or counts[TO_WALL, p] > WALLED * boundary
            or _is_side(pieces, p, field.lens)
            or _is_tower(field, pieces, p, up, limits.highest_m)
        )
    return refused


@kernel(leaf=True)
def _is_rim(pieces: Pieces, p: int) -> bool:
    """Whether a piece meets a board from below, as its edge and the legs below it do."""
    rim = pieces.single[p, RIM]
    return bool(rim >= RIM_LINKS and rim >= RIM_SHARE * pieces.boundary[p])


@kernel(leaf=True)
def _is_faint(pieces: Pieces, p: int) -> bool:
    """Whether a piece is as small and low as noise of the plane."""
    shape = pieces.shape[p]
    if shape[TOP] >= FAINT * LEAST_M + FAINT_NOISE * NOISE * depth_of(pieces, p) ** 2:
        return False
    return bool(shape[AREA] < FAINT_M2 or shape[COUNT] < FAINT_CELLS)


@kernel(leaf=True)
def _is_side(pieces: Pieces, p: int, lens: Lens) -> bool:
    """Whether a piece is upright and seen only edge on, as sides of shelves are.

    An object has a front too, unless something hides it.
    """
    shape, boundary = pieces.shape[p], pieces.boundary[p]
    covered = shape[COUNT] * depth_of(pieces, p) ** 2 / (lens.fx * lens.fy)
    speckled = boundary * boundary > SPECKS * shape[COUNT]
    if shape[AREA] <= (SPECKLED if speckled else EDGE_ON) * covered:
        return False
    if shape[RIGHTMOST] - shape[LEFT] >= SLENDER * (shape[TOP] - shape[BOTTOM]):
        return False
    upward, touching, hidden = 0.0, 0.0, pieces.single[p, HIDDEN]
    for band in range(top_band(shape) + 1):
        upward += pieces.lid[p, band]
    for q in range(pieces.group.size):
        touching += pieces.pairs[CONTACT, p, q]
        hidden += pieces.pairs[FRONT, q, p]
    upright = upward < UPRIGHT * shape[AREA]
    return bool(upright and touching < FEW and hidden < COVERED * boundary)


@kernel
def _count_leaving(field: Field, counts: I4) -> None:
    """Count the cells of each region on walls, and the neighbours on the same surface beyond.

    Walls and floors are cut off where no plane reaches, or go on in a wall; an object ends where
    it ends.
    """
    w, owner, regions = field.w, field.owner, field.regions
    rows, columns = w.shape
    out = np.zeros(columns, np.bool_)
    for i in range(rows):
        first, end = field.spans[i]
        some = False
        for j in range(first, end):
            some |= field.walls[i, j] == ON_WALL  # few rows have any, and this vectorises
        if some:
            for j in range(first, end):
                if field.walls[i, j] == ON_WALL:
                    counts[ON, regions[i, j]] += 1
        first, end = max(first, 1), min(end, columns - 1)
        if i == 0 or i == rows - 1 or not _find_out(owner, regions, i, first, end, out):
            continue
        for j in range(first, end):
            if not out[j]:
                continue
            plane = field.planes[owner[i, j] - 1]
            for y, x in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)):
                if (
                    owner[y, x] == 0
                    and w[y, x] > max(plane[0] * x + plane[1] * y + plane[2], 0)
                    and abs(w[y, x] - w[i, j]) < DISCONTINUITY
                ):
                    which = TO_WALL if field.walls[y, x] == CLEARED else BEYOND
                    counts[which, regions[i, j]] += 1


@kernel(leaf=True)
def _find_out(owner: I4, regions: I4, i: int, first: int, end: int, out: Bool) -> bool:
    """Mark the cells of a part of a row next to what no plane is below; whether there are any."""
    above, below, mine = owner[i - 1, first:end], owner[i + 1, first:end], regions[i, first:end]
    left, right = owner[i, first - 1 : end - 1], owner[i, first + 1 : end + 1]
    part, some = out[first:end], False
    for j in range(mine.size):
        beside = (above[j] == 0) | (below[j] == 0) | (left[j] == 0) | (right[j] == 0)
        part[j] = beside & (mine[j] > 0)
    for j in range(mine.size):
        some |= part[j]
    return some


@kernel(leaf=True)
def _is_tower(field: Field, pieces: Pieces, p: int, up: F8, highest: float) -> bool:
    """Whether the surface of a piece goes straight up and down for ``highest`` metres.

    The sides of shelves, door frames and whatever stands before the table reach higher above a
    plane than objects on it, or down below it, also where only pieces of them are seen.
    """
    w, lens = field.w, field.lens
    columns = w.shape[1]
    if pieces.owner[p] <= 0:
        return False
    plane = field.planes[pieces.owner[p] - 1]
    n = high = 0
    for s in pieces.samples[p]:
        if s < 0:
            break
        i, j = place_of(s, columns)
        h = (1 - (plane[0] * j + plane[1] * i + plane[2]) / w[i, j]) * plane[3]
        n += 1
        rise = _rise(w, lens, i, j, up, 1, highest)
        if h + rise > highest - STEP_M:
            high += 1
        else:
            high += rise + _rise(w, lens, i, j, up, -1, highest - rise) > highest - STEP_M
    return bool(high > TOWERING * n)


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
        inverse = 1 / depth
        v = int(lens.cy + lens.fy * (y + along * up[1]) * inverse + 0.5)
        u = int(lens.cx + lens.fx * (x + along * up[0]) * inverse + 0.5)
        if v < 0 or u < 0 or v >= w.shape[0] or u >= w.shape[1]:
            break
        ahead = w[v, u] - inverse
        if abs(ahead) < DISCONTINUITY:
            reach, misses = d, 0.0
            continue
        misses += 0.5 if ahead > 0 else 1.0  # something in front of it hides it
        if misses > MISSES:
            break
    return reach


@kernel(leaf=True)
def _count_through(field: Field, up: F8, through: I4) -> None:
    """Count where each region goes on through the level of a board, as posts do.

    What is above and below the level is one upright surface there.
    """
    w, lens, owner, regions = field.w, field.lens, field.owner, field.regions
    columns = w.shape[1]
    if len(field.planes) < 2:
        return
    for i in range(w.shape[0]):
        for j in range(field.spans[i, 0], field.spans[i, 1]):
            if regions[i, j] == 0:
                continue
            above = _followed(w, lens, i, j, up, POST_M)
            if above < 0:
                continue
            y, x = above // columns, above % columns
            if regions[y, x] == 0 or owner[y, x] == owner[i, j]:
                continue
            if _followed(w, lens, i, j, up, -POST_M) >= 0:
                through[regions[i, j]] += 1
                through[regions[y, x]] += 1


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
    if (
        v < 0
        or u < 0
        or v >= w.shape[0]
        or u >= w.shape[1]
        or abs(w[v, u] - 1 / z) >= DISCONTINUITY
    ):
        return -1
    return int(v * w.shape[1] + u)
