"""Adjacency: the other segments, planes and occluders along the boundary of each segment."""

import math

import numpy as np

from shapecat.arrays import F8, I4, U1
from shapecat.detection.connected_components import DOWN, RIGHT
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.merging.segments import SAMPLES, Segments
from shapecat.detection.merging.settings import MERGING
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.jit import kernel

__all__ = ["measure_adjacency"]


@kernel
def measure_adjacency(
    grid: DepthGrid, heights: HeightMap, graph: SurfaceGraph, labels: I4, up: F8, segments: Segments
) -> None:
    """Measure the boundaries and contacts of segments, and choose some cells of each as samples.

    ``labels`` (rows, columns) are the segments, ``up`` is a unit vector (3,), sensor frame, and
    ``segments`` are from `measure_segments`; the results are written into them.
    """
    inv_depth = grid.inverse_depth
    rows, columns = inv_depth.shape
    plane_id, links, statistics = heights.plane_id, graph.links, segments.statistics
    change, border = np.zeros(columns, np.uint8), np.zeros((2 * columns, 6), np.int32)
    for i in range(rows):
        if not _find_changes(links[i], labels[i], labels[min(i + 1, rows - 1)], change):
            continue
        n = 0
        for j in range(columns):
            p = labels[i, j]
            if change[j] == 0 or inv_depth[i, j] <= 0 or (p == 0 and plane_id[i, j] > 0):
                continue
            for down in range(2):  # the neighbour on the right, the one below
                y, x = i + down, j + 1 - down
                if y >= rows or x >= columns:
                    continue
                link = links[i, j] & (DOWN if down else RIGHT)
                if labels[y, x] == p and (p == 0 or link):
                    continue
                gap = 0
                while gap <= MERGING.shadow_cells and y < rows and x < columns:
                    if inv_depth[y, x] > 0 and not (labels[y, x] == 0 and plane_id[y, x] > 0):
                        break
                    gap, y, x = gap + 1, y + down, x + 1 - down
                beyond = y >= rows or x >= columns
                q = 0 if beyond else labels[y, x]
                ends = gap == 0 or p != q  # else the segment continues behind the gap
                statistics[p].boundary += (p > 0) & ends
                if beyond or gap > MERGING.shadow_cells:
                    continue
                statistics[q].boundary += (q > 0) & ends
                if p != q:
                    border[n, 0], border[n, 1], border[n, 2], border[n, 3] = j, y, x, down
                    border[n, 4], border[n, 5] = gap, 0 if gap > 0 else link
                    n += 1
        _count(grid, heights, graph, labels, up, i, border[:n], segments)
    _choose_samples(graph, labels, segments)


@kernel(inline=True)
def _find_changes(links: U1, row: I4, row_below: I4, change: U1) -> bool:
    """Mark the cells of a row whose segment does not continue both to the right and down.

    Returns whether there are any such cells. ``row`` and ``row_below`` (columns,) are labels,
    ``links`` (columns,) as in `SurfaceGraph`; ``change`` (columns,) is written.
    """
    for j in range(row.size):
        change[j] = (row[j] != row_below[j]) | ((row[j] > 0) & (links[j] != RIGHT | DOWN))
    for j in range(row.size - 1):
        change[j] |= row[j] != row[j + 1]
    any_changed = False
    for j in range(row.size):
        any_changed |= change[j] != 0
    return any_changed


@kernel(inline=True)
def _count(
    grid: DepthGrid,
    heights: HeightMap,
    graph: SurfaceGraph,
    labels: I4,
    up: F8,
    row: int,
    border: I4,
    segments: Segments,
) -> None:
    """Add pairs of cells on a boundary to the counts of the segments on both sides.

    The first cell of each pair is in row ``row``. The columns of ``border`` (n, 6) are the column
    of the first cell; the row and the column of the second; 1 if the second is below the first, 0
    if it is to the right; the number of cells without depth between the two; and a number that is 0
    unless the surface continues from one to the other. ``labels`` and ``up`` are as in
    `measure_adjacency`.
    """
    inv_depth, jump = grid.inverse_depth, grid.discontinuity
    plane_id, height = heights.plane_id, heights.height
    normal, concavity = graph.normal, graph.concavity
    statistics, pairs = segments.statistics, segments.pairs
    steep = MERGING.down_cos * math.hypot(up[0], up[1])
    for m in range(2 * border.shape[0]):
        i, j, y, x = row, border[m // 2, 0], border[m // 2, 1], border[m // 2, 2]
        fall = -up[border[m // 2, 3]]  # above 0 if (y, x) is lower, however the image is turned
        gap, link = border[m // 2, 4], border[m // 2, 5]
        if m % 2 == 1:
            i, j, y, x, fall = y, x, row, border[m // 2, 0], -fall
        p, q = labels[i, j], labels[y, x]
        if p == 0:
            continue
        ahead = inv_depth[i, j] - inv_depth[y, x]
        statistics[p].lower_edge_free += fall > steep and ahead > jump
        if q == 0:
            if ahead < -jump:
                statistics[p].hidden += 1
            elif ahead < jump and plane_id[y, x] < 0 and gap <= MERGING.gap_cells:
                if plane_id[y, x] == -plane_id[i, j]:
                    statistics[p].plane_contact += 1
                else:
                    statistics[p].shelf_edge += 1
        elif link:
            pairs[p, q].contact += 1
            pairs[p, q].concavity += max(concavity[i, j], concavity[y, x])
            # Whether the segment at (y, x) faces up, a few cells inside.
            v = min(max(i + MERGING.inward_cells * (y - i), 0), labels.shape[0] - 1)
            u = min(max(j + MERGING.inward_cells * (x - j), 0), labels.shape[1] - 1)
            facing = normal[v, 0, u] * up[0] + normal[v, 1, u] * up[1] + normal[v, 2, u] * up[2]
            if labels[v, u] == q and facing > MERGING.up_cos:
                pairs[p, q].rests_on += 1
                pairs[p, q].rests_on_height += height[v, u]
        elif ahead >= jump:
            pairs[p, q].in_front += 1
        elif ahead > -jump and gap <= MERGING.gap_cells:
            pairs[p, q].near += 1


@kernel(inline=True)
def _choose_samples(graph: SurfaceGraph, labels: I4, segments: Segments) -> None:
    """Write evenly spaced samples of each segment, away from edges, to ``segments.samples``.

    ``labels`` (rows, columns) are the segments.
    """
    rows, columns = labels.shape
    spans, local_plane, concavity = graph.spans, graph.local_plane, graph.concavity
    n = segments.parent.size
    stride, countdown, counts = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int32)
    for p in range(n):
        stride[p] = countdown[p] = max(int(segments.statistics[p].count) // SAMPLES, 1)
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            p = labels[i, j]
            if p == 0 or concavity[i, j] > MERGING.flat_deg or not local_plane[i, 0, j] > 0:
                continue
            countdown[p] -= 1
            if countdown[p] == 0 and counts[p] < SAMPLES:
                segments.samples[p, counts[p]] = i * columns + j
                counts[p] += 1
                countdown[p] = stride[p]
