"""Borders: what pieces meet along their outlines: each other, planes, and what hides them."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.detection.merging.segments import (
    CONTACT,
    FRONT,
    HIDDEN,
    NEAR,
    ONTO,
    ONTO_HEIGHT,
    OVER,
    RIM,
    TABLE,
    UPWARD,
    Pieces,
    choose_samples,
)
from shapecat.detection.planes.height_map import Heights
from shapecat.detection.segmentation.connectivity import DOWN, RIGHT, Surfaces
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel

__all__ = ["meet"]

GAP, SHADOW = 3, 15
"""Cells without a reading between two that are neighbours: of one surface, and of two, where the
nearer one keeps the light of the projector from the other."""
INWARD = 3
"""Cells from a border to where it is known which way the surface faces."""
DOWNWARD = 0.7
"""Cosine of the largest angle, in the image, of a neighbour below to straight down."""


@kernel
def meet(w: F4, heights: Heights, surfaces: Surfaces, labels: I4, up: F8, pieces: Pieces) -> None:
    """Collect what pieces meet, and their samples: what `pieces_of` leaves for after the cuts."""
    change = np.zeros(w.shape[1], np.uint8)
    _follow(w, heights, surfaces, labels, up, change, pieces)
    choose_samples(surfaces, labels, pieces)


@kernel(leaf=True)
def _follow(
    w: F4,
    heights: Heights,
    surfaces: Surfaces,
    labels: I4,
    up: F8,
    change: U1,
    pieces: Pieces,
) -> None:
    """Count what meets at each side of each cell; ``change`` (columns,) is room."""
    rows, columns = w.shape
    links = surfaces.links
    steep = DOWNWARD * math.hypot(up[0], up[1])
    for i in range(rows):
        if not _find_changes(links[i], labels[i], labels[min(i + 1, rows - 1)], change):
            continue
        for j in range(columns):
            if change[j] == 0 or _is_blank(w, heights.owner, labels, i, j):
                continue
            for d in range(2):
                _count_side(w, heights, surfaces, labels, up, steep, i, j, d, 1 - d, pieces)


@kernel(leaf=True)
def _find_changes(links: U1, here: I4, below: I4, change: U1) -> bool:
    """Mark the cells of a row from which a piece does not just go on to the right and down.

    Returns whether there are any.
    """
    for j in range(here.size):
        change[j] = (here[j] != below[j]) | ((here[j] > 0) & (links[j] != RIGHT | DOWN))
    for j in range(here.size - 1):
        change[j] |= here[j] != here[j + 1]
    some = False
    for j in range(here.size):
        some |= change[j] != 0
    return some


@kernel(leaf=True)
def _is_blank(w: F4, owner: I4, labels: I4, i: int, j: int) -> bool:
    """Whether a cell has no reading, or is above a plane but of no piece."""
    return bool(w[i, j] <= 0 or (labels[i, j] == 0 and owner[i, j] > 0))


@kernel(inline=True, leaf=True)
def _count_side(
    w: F4,
    heights: Heights,
    surfaces: Surfaces,
    labels: I4,
    up: F8,
    steep: float,
    i: int,
    j: int,
    di: int,
    dj: int,
    pieces: Pieces,
) -> None:
    """Count what meets to the right of a cell, or below it, for the pieces on both sides.

    ``steep`` is how much a step in the image must fall to lead down.
    """
    rows, columns = w.shape
    y, x = i + di, j + dj
    if y >= rows or x >= columns:
        return
    p, link = labels[i, j], surfaces.links[i, j] & (DOWN if di else RIGHT)
    if labels[y, x] == p and (p == 0 or link):
        return
    gap = 0
    while gap <= SHADOW and y < rows and x < columns and _is_blank(w, heights.owner, labels, y, x):
        gap, y, x = gap + 1, y + di, x + dj
    beyond = y >= rows or x >= columns
    q = 0 if beyond else labels[y, x]
    ends = gap == 0 or p != q  # else the piece goes on behind the gap
    pieces.boundary[p] += (p > 0) & ends
    if beyond or gap > SHADOW:
        return
    pieces.boundary[q] += (q > 0) & ends
    if p == q:
        return
    fall = -up[di]  # how much lower the neighbour is seen, however the image is turned
    link = 0 if gap > 0 else link
    _count(w, heights, surfaces, labels, up, i, j, y, x, gap, link, int(fall > steep), pieces)
    _count(w, heights, surfaces, labels, up, y, x, i, j, gap, link, int(-fall > steep), pieces)


@kernel(inline=True, leaf=True)
def _count(
    w: F4,
    heights: Heights,
    surfaces: Surfaces,
    labels: I4,
    up: F8,
    i: int,
    j: int,
    y: int,
    x: int,
    gap: int,
    link: int,
    lower: int,
    pieces: Pieces,
) -> None:
    """Count for the piece at (i, j), if any, that it meets what is at (y, x).

    Parameters
    ----------
    gap : cells without a reading between them.
    link : not 0 if the surface goes on from one to the other.
    lower : 1 if (y, x) is seen below it.
    """
    p, q = labels[i, j], labels[y, x]
    if p == 0:
        return
    owner, ahead = heights.owner, w[i, j] - w[y, x]
    pieces.single[p, OVER] += lower and ahead > DISCONTINUITY
    if q == 0:
        if ahead < -DISCONTINUITY:
            pieces.single[p, HIDDEN] += 1
        elif ahead < DISCONTINUITY and owner[y, x] < 0 and gap <= GAP:
            pieces.single[p, TABLE if owner[y, x] == -owner[i, j] else RIM] += 1
    elif link:
        pieces.pairs[CONTACT, p, q] += 1
        _count_onto(heights.height, surfaces.normal, labels, up, i, j, y, x, pieces)
    elif ahead >= DISCONTINUITY:
        pieces.pairs[FRONT, p, q] += 1
    elif ahead > -DISCONTINUITY and gap <= GAP:
        pieces.pairs[NEAR, p, q] += 1


@kernel(leaf=True)
def _count_onto(
    height: F4, normal: F4, labels: I4, up: F8, i: int, j: int, y: int, x: int, pieces: Pieces
) -> None:
    """Count the link from cell (i, j) to (y, x) if the piece of that faces up beyond it."""
    p, q = labels[i, j], labels[y, x]
    y = min(max(i + INWARD * (y - i), 0), labels.shape[0] - 1)
    x = min(max(j + INWARD * (x - j), 0), labels.shape[1] - 1)
    if labels[y, x] != q:
        return
    if normal[y, 0, x] * up[0] + normal[y, 1, x] * up[1] + normal[y, 2, x] * up[2] > UPWARD:
        pieces.pairs[ONTO, p, q] += 1
        pieces.pairs[ONTO_HEIGHT, p, q] += height[y, x]
