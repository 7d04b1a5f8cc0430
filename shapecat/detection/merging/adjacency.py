"""Adjacency: what segments meet along their outlines: each other, planes, and what hides them."""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.detection.merging.segments import (
    UPWARD,
    Segments,
    choose_samples,
)
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import DOWN, RIGHT, SurfaceGraph
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel

__all__ = ["measure_adjacency"]

GAP, SHADOW = 3, 15
"""Cells without a reading between two that are neighbours: of one surface, and of two, where the
nearer one keeps the light of the projector from the other."""
INWARD = 3
"""Cells from a border to where it is known which way the surface faces."""
DOWNWARD = 0.7
"""Cosine of the largest angle, in the image, of a neighbour below to straight down."""


@kernel
def measure_adjacency(
    inv_depth: F4, heights: HeightMap, graph: SurfaceGraph, labels: I4, up: F8, segments: Segments
) -> None:
    """Collect what segments meet, and their samples: what `measure_segments` leaves out."""
    change = np.zeros(inv_depth.shape[1], np.uint8)
    _follow(inv_depth, heights, graph, labels, up, change, segments)
    choose_samples(graph, labels, segments)


@kernel(leaf=True)
def _follow(
    inv_depth: F4,
    heights: HeightMap,
    graph: SurfaceGraph,
    labels: I4,
    up: F8,
    change: U1,
    segments: Segments,
) -> None:
    """Count what meets at each side of each cell; ``change`` (columns,) is room."""
    rows, columns = inv_depth.shape
    links = graph.links
    steep = DOWNWARD * math.hypot(up[0], up[1])
    for i in range(rows):
        if not _find_changes(links[i], labels[i], labels[min(i + 1, rows - 1)], change):
            continue
        for j in range(columns):
            if change[j] == 0 or _is_blank(inv_depth, heights.plane_id, labels, i, j):
                continue
            for d in range(2):
                _count_side(inv_depth, heights, graph, labels, up, steep, i, j, d, 1 - d, segments)


@kernel(leaf=True)
def _find_changes(links: U1, here: I4, below: I4, change: U1) -> bool:
    """Mark the cells of a row from which a segment does not just go on to the right and down.

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
def _is_blank(inv_depth: F4, plane_id: I4, labels: I4, i: int, j: int) -> bool:
    """Whether a cell has no reading, or is above a plane but of no segment."""
    return bool(inv_depth[i, j] <= 0 or (labels[i, j] == 0 and plane_id[i, j] > 0))


@kernel(inline=True, leaf=True)
def _count_side(
    inv_depth: F4,
    heights: HeightMap,
    graph: SurfaceGraph,
    labels: I4,
    up: F8,
    steep: float,
    i: int,
    j: int,
    di: int,
    dj: int,
    segments: Segments,
) -> None:
    """Count what meets to the right of a cell, or below it, for the segments on both sides.

    ``steep`` is how much a step in the image must fall to lead down.
    """
    rows, columns = inv_depth.shape
    y, x = i + di, j + dj
    if y >= rows or x >= columns:
        return
    p, link = labels[i, j], graph.links[i, j] & (DOWN if di else RIGHT)
    if labels[y, x] == p and (p == 0 or link):
        return
    gap = 0
    while (
        gap <= SHADOW
        and y < rows
        and x < columns
        and _is_blank(inv_depth, heights.plane_id, labels, y, x)
    ):
        gap, y, x = gap + 1, y + di, x + dj
    beyond = y >= rows or x >= columns
    q = 0 if beyond else labels[y, x]
    ends = gap == 0 or p != q  # else the segment goes on behind the gap
    segments.statistics[p].boundary += (p > 0) & ends
    if beyond or gap > SHADOW:
        return
    segments.statistics[q].boundary += (q > 0) & ends
    if p == q:
        return
    fall = -up[di]  # how much lower the neighbour is seen, however the image is turned
    link = 0 if gap > 0 else link
    _count(
        inv_depth, heights, graph, labels, up, i, j, y, x, gap, link, int(fall > steep), segments
    )
    _count(
        inv_depth, heights, graph, labels, up, y, x, i, j, gap, link, int(-fall > steep), segments
    )


@kernel(inline=True, leaf=True)
def _count(
    inv_depth: F4,
    heights: HeightMap,
    graph: SurfaceGraph,
    labels: I4,
    up: F8,
    i: int,
    j: int,
    y: int,
    x: int,
    gap: int,
    link: int,
    lower: int,
    segments: Segments,
) -> None:
    """Count for the segment at (i, j), if any, that it meets what is at (y, x).

    Parameters
    ----------
    gap : cells without a reading between them.
    link : not 0 if the surface goes on from one to the other.
    lower : 1 if (y, x) is seen below it.
    """
    p, q = labels[i, j], labels[y, x]
    if p == 0:
        return
    plane_id, ahead = heights.plane_id, inv_depth[i, j] - inv_depth[y, x]
    segments.statistics[p].upper_silhouette += lower and ahead > DISCONTINUITY
    if q == 0:
        if ahead < -DISCONTINUITY:
            segments.statistics[p].hidden += 1
        elif ahead < DISCONTINUITY and plane_id[y, x] < 0 and gap <= GAP:
            if plane_id[y, x] == -plane_id[i, j]:
                segments.statistics[p].plane_contact += 1
            else:
                segments.statistics[p].shelf_edge += 1
    elif link:
        segments.pairs[p, q].contact += 1
        _count_onto(heights.height, graph.normal, labels, up, i, j, y, x, segments)
    elif ahead >= DISCONTINUITY:
        segments.pairs[p, q].in_front += 1
    elif ahead > -DISCONTINUITY and gap <= GAP:
        segments.pairs[p, q].near += 1


@kernel(leaf=True)
def _count_onto(
    height: F4, normal: F4, labels: I4, up: F8, i: int, j: int, y: int, x: int, segments: Segments
) -> None:
    """Count the link from cell (i, j) to (y, x) if the segment of that faces up beyond it."""
    p, q = labels[i, j], labels[y, x]
    y = min(max(i + INWARD * (y - i), 0), labels.shape[0] - 1)
    x = min(max(j + INWARD * (x - j), 0), labels.shape[1] - 1)
    if labels[y, x] != q:
        return
    if normal[y, 0, x] * up[0] + normal[y, 1, x] * up[1] + normal[y, 2, x] * up[2] > UPWARD:
        segments.pairs[p, q].rests_on += 1
        segments.pairs[p, q].rests_on_height += height[y, x]
