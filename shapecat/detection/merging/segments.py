"""Segments: the statistics of each segment, and of each pair, which `adjacency` measures."""

import math
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Records, Row
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.merging.image_hull import extend_hull
from shapecat.detection.merging.settings import MERGING
from shapecat.detection.planes.extent import DIRECTIONS
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.bands import BAND_M, BANDS, lateral_axis
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.jit import kernel

__all__ = [
    "MIN_LINKS",
    "PAIR",
    "SAMPLES",
    "SEGMENT",
    "Segments",
    "add_statistics",
    "mean_depth",
    "measure_segments",
    "merge",
    "roots_of",
]

SEGMENT = np.dtype(
    [
        ("left", "f4"),  # minima: lateral position, metres,
        ("bottom", "f4"),  # and height above the plane, metres
        ("right", "f4"),  # maxima of both
        ("top", "f4"),
        ("count", "f4"),  # number of cells; this and the remaining fields are sums
        ("boundary", "f4"),  # sides of cells on the boundary
        ("area", "f4"),  # of the visible surface, m2, without cells that have no local plane
        ("depth_sum", "f4"),
        ("fitted", "f4"),  # cells with a local plane; the next eleven are sums over these:
        ("position_x_sum", "f4"),  # position, sensor frame
        ("position_y_sum", "f4"),
        ("position_z_sum", "f4"),
        ("facing_x_sum", "f4"),  # normal, sensor frame
        ("facing_y_sum", "f4"),
        ("facing_z_sum", "f4"),
        ("x_sum", "f4"),  # lateral position
        ("xx_sum", "f4"),
        ("normal_x_sum", "f4"),  # lateral component of the normal
        ("normal_xx_sum", "f4"),
        ("x_normal_x_sum", "f4"),
        ("plane_contact", "f4"),  # boundary with its plane
        ("hidden", "f4"),  # boundary behind a surface of no segment
        ("shelf_edge", "f4"),  # boundary with another plane
        ("lower_edge_free", "f4"),  # lower boundary in front of a farther surface
    ],
    align=True,
)
"""The statistics of a segment."""
_MINIMA = 2
"""Number of fields of a `SEGMENT`, at its start, that are minima."""
_MAXIMA = 4
"""Index of the first field after the maxima, which follow the minima."""
_FIELDS = SEGMENT.itemsize // 4
"""Number of fields of a `SEGMENT`."""
PAIR = np.dtype(
    [
        ("contact", "f4"),  # linked neighbours
        ("concavity", "f4"),  # the sum of the concave angles there, degrees
        ("in_front", "f4"),  # neighbours where the first is in front of the second
        ("near", "f4"),  # neighbours at the same depth that are not linked
        ("rests_on", "f4"),  # links beyond which the second faces up
        ("rests_on_height", "f4"),  # the sum of the heights there
    ],
    align=True,
)
"""The statistics of an ordered pair of segments: counts along their common border."""
MIN_LINKS = 3
"""Minimum count along a border; smaller counts are noise."""
SAMPLES = 48
"""Maximum number of samples of a segment, evenly spaced, used where all its cells would take too
long."""


class Segments(NamedTuple):
    """Statistics of segments 1..n; row 0 is unused. `merge` combines those of two segments.

    Attributes
    ----------
    pairs : (n + 1, n + 1) records of `PAIR`.
    statistics : (n + 1,) records of `SEGMENT`.
    top_area : (n + 1, BANDS) float32, area of upward-facing surface in each band of height, m2.
    hulls : (n + 1, DIRECTIONS) float32, support functions of the convex hulls in the image, cells.
    samples : (n + 1, SAMPLES) int32, flat indices of cells away from edges; -1 beyond the last.
    plane_id : (n + 1,) int8, the plane below each segment, as in `HeightMap.plane_id`.
    parent : (n + 1,) int16, the segment that each has been merged into, at first itself.
    """

    pairs: Records
    statistics: Records
    top_area: F4
    hulls: F4
    samples: I4
    plane_id: I4
    parent: I4


def measure_segments(
    grid: DepthGrid, heights: HeightMap, graph: SurfaceGraph, labels: I4, n: int, up: F8
) -> Segments:
    """Measure segments 1..n; `measure_adjacency` adds their boundaries and samples.

    ``labels`` (rows, columns) are the segments; ``up`` is a unit vector (3,), sensor frame.
    """
    segments: Segments = _blank(n + 1)
    _measure(grid, heights, graph, labels, up, segments)
    return segments


def _blank(size: int) -> Segments:
    """Return statistics of ``size`` - 1 segments that have no cells yet."""
    segments = Segments(
        np.zeros((size, size), PAIR),
        np.zeros(size, SEGMENT),
        np.zeros((size, BANDS), np.float32),
        np.full((size, DIRECTIONS), -1e9, np.float32),
        np.full((size, SAMPLES), -1, np.int32),
        np.zeros(size, np.int8),
        np.arange(size).astype(np.int16),
    )
    for low, high in (("left", "right"), ("bottom", "top")):
        segments.statistics[low], segments.statistics[high] = 1e9, -1e9
    return segments


def roots_of(segments: Segments) -> I4:
    """Return the segments that have not been merged into another, (r,), ascending."""
    return np.flatnonzero(segments.parent == np.arange(segments.parent.size))[1:]


@kernel
def _measure(
    grid: DepthGrid, heights: HeightMap, graph: SurfaceGraph, labels: I4, up: F8, segments: Segments
) -> None:
    """Add the cells of labels 1..n to the statistics.

    ``labels`` (rows, columns) and ``up`` are as in `measure_segments`.
    """
    inv_depth, intrinsics, side = grid.inverse_depth, grid.intrinsics, lateral_axis(up)
    plane_ids, top_area = segments.plane_id, segments.top_area
    plane_id, height = heights.plane_id, heights.height
    zero, one, inf = np.float32(0), np.float32(1), np.float32(np.inf)
    per_x, per_y = np.float32(1 / intrinsics.fx), np.float32(1 / intrinsics.fy)
    cx, cy = np.float32(intrinsics.cx), np.float32(intrinsics.cy)
    edge_on = np.float32(MERGING.edge_on_cos)
    sx, sy, sz = np.float32(side[0]), np.float32(side[1]), np.float32(side[2])
    ux, uy, uz = np.float32(up[0]), np.float32(up[1]), np.float32(up[2])
    local_plane, normal, spans = graph.local_plane, graph.normal, graph.spans
    for i in range(inv_depth.shape[0]):
        j, end = spans[i]
        while j < end:
            p, first = labels[i, j], j
            if p == 0:
                j += 1
                continue
            # Sums over a run of cells of one segment.
            depths = fitted = sides = sides2 = turns = turns2 = products = areas = zero
            px = py = pz = nxs = nys = nzs = zero
            left, right, bottom, top = inf, -inf, inf, -inf
            while j < end and labels[i, j] == p:
                z = one / inv_depth[i, j]
                x, y = (np.float32(j) - cx) * per_x * z, (np.float32(i) - cy) * per_y * z
                along = x * sx + y * sy + z * sz
                h = height[i, j]
                depths += z
                left, right = min(left, along), max(right, along)
                bottom, top = min(bottom, h), max(top, h)
                if local_plane[i, 0, j] > 0:
                    nx, ny, nz = normal[i, 0, j], normal[i, 1, j], normal[i, 2, j]
                    turn = nx * sx + ny * sy + nz * sz
                    fitted += one
                    px += x
                    py += y
                    pz += z
                    nxs += nx
                    nys += ny
                    nzs += nz
                    sides += along
                    sides2 += along * along
                    turns += turn
                    turns2 += turn * turn
                    products += along * turn
                    facing = -(nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z)
                    area = z * z * per_x * per_y / max(facing, edge_on)
                    areas += area
                    if nx * ux + ny * uy + nz * uz > np.float32(MERGING.up_cos):
                        band = min(max(int(h / np.float32(BAND_M)), 0), BANDS - 1)
                        top_area[p, band] += area
                j += 1
            extend_hull(segments.hulls[p], i, first, j - 1)
            plane_ids[p] = plane_id[i, first]
            row = segments.statistics[p]
            row.count += j - first
            row.depth_sum += depths
            row.left, row.right = min(row.left, left), max(row.right, right)
            row.top, row.bottom = max(row.top, top), min(row.bottom, bottom)
            row.fitted += fitted
            row.position_x_sum += px
            row.position_y_sum += py
            row.position_z_sum += pz
            row.facing_x_sum += nxs
            row.facing_y_sum += nys
            row.facing_z_sum += nzs
            row.x_sum += sides
            row.xx_sum += sides2
            row.normal_x_sum += turns
            row.normal_xx_sum += turns2
            row.x_normal_x_sum += products
            row.area += areas


@kernel
def merge(segments: Segments, p: int, q: int) -> None:
    """Merge segment ``q`` into ``p``, in place; neither may already be merged into another."""
    n, pairs, hulls = segments.parent.size, segments.pairs.view(np.float32), segments.hulls
    fields = pairs.shape[1] // n
    for k in range(n * fields):
        pairs[p, k] += pairs[q, k]
        pairs[q, k] = 0
    for k in range(n):
        for f in range(fields):
            pairs[k, p * fields + f] += pairs[k, q * fields + f]
            pairs[k, q * fields + f] = 0
    for f in range(fields):
        pairs[p, p * fields + f] = 0
    for band in range(BANDS):
        segments.top_area[p, band] += segments.top_area[q, band]
    for d in range(DIRECTIONS):
        hulls[p, d] = max(hulls[p, d], hulls[q, d])
    add_statistics(segments.statistics, p, q)
    # The samples of both alternate until there are enough.
    samples, first, count = segments.samples, segments.samples[p].copy(), 0
    for k in range(2 * SAMPLES):
        cell = samples[q, k // 2] if k % 2 else first[k // 2]
        if cell >= 0 and count < SAMPLES:
            samples[p, count] = cell
            count += 1
    for k in range(n):
        if segments.parent[k] == q:
            segments.parent[k] = p


@kernel
def add_statistics(statistics: Records, p: int, q: int) -> None:
    """Add the statistics of segment ``q`` to those of ``p``, in place.

    ``statistics`` (n + 1,) are records of `SEGMENT`.
    """
    values = statistics.view(np.float32)
    for f in range(_FIELDS):
        a, b = values[p * _FIELDS + f], values[q * _FIELDS + f]
        combined = min(a, b) if f < _MINIMA else max(a, b) if f < _MAXIMA else a + b
        values[p * _FIELDS + f] = combined


@kernel(inner=True)
def mean_depth(row: Row) -> Any:
    """Return the mean depth of a segment, metres; ``row`` is a `SEGMENT`."""
    return row.depth_sum / row.count
