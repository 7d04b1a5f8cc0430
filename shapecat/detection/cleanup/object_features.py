"""Object features: named features that distinguish objects from structure and noise.

They describe the shape of a segment, where it ends, and where its surface continues: walls of bins
are at the outline of their floor, walls of rooms continue beyond all planes, and furniture is cut
off by the image border.
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, I4, Records, Row
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.connected_components import SIDES
from shapecat.detection.depth_grid import DepthGrid, back_project, find_borders, row_and_column
from shapecat.detection.foreground.walls import CLEARED, ON_WALL
from shapecat.detection.merging.segment_features import (
    SEGMENT_FEATURES,
    share,
    write_segment_features,
)
from shapecat.detection.merging.segments import mean_depth
from shapecat.detection.planes.height_map import distance_outside, min_height_at
from shapecat.detection.records import OverSegmentation, PlaneModel
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel

__all__ = ["OBJECT_FEATURES", "measure_object_features"]

_SURROUNDINGS = np.dtype(
    [
        ("image_border", "f4"),  # cells there divided by the perimeter of a square of equal area
        ("range_limit", "f4"),  # fractions of the cells: at the range limit,
        ("on_wall", "f4"),  # and on walls
        ("beyond", "f4"),  # fraction of the boundary where the surface continues beyond all planes
        ("into_wall", "f4"),  # and into a wall
        ("least_outside_m", "f4"),  # distance of the samples outside the outline of the plane
        ("mean_outside_m", "f4"),
        ("most_outside_m", "f4"),
        ("low_profile", "f4"),  # fraction of the cells on low-profile objects
        ("depth_edge", "f4"),  # fraction of the boundary in front of farther surfaces
        # The mean and the standard deviation of the heights of the plane's samples around the
        # segment, divided by the minimum height of an object's sample.
        ("plane_height", "f4"),
        ("plane_noise", "f4"),
    ],
    align=True,
)
"""Where a segment ends, where its surface continues, and how level the plane is around it."""
_VISIBILITY = np.dtype(
    [
        ("cells", "f4"),
        ("depth_m", "f4"),
        ("cell_m", "f4"),
        ("down", "f4"),  # cosine between the optical axis and up
        ("top_by_noise", "f4"),  # top divided by the minimum height of a sample at that depth
        ("slant", "f4"),  # area divided by that of the same cells if they faced the camera
        ("ragged", "f4"),  # squared boundary divided by the number of cells: 16 for a square
    ],
    align=True,
)
"""How well a segment is visible: its size in cells, its depth, and the angle of view."""
OBJECT_FEATURES = np.dtype(
    [("segment", SEGMENT_FEATURES), ("surroundings", _SURROUNDINGS), ("visibility", _VISIBILITY)],
    align=True,
)
"""The features of a segment that may be an object; all are float32, lengths in metres. The trees
index them in this order."""


def measure_object_features(
    grid: DepthGrid,
    model: PlaneModel,
    oversegmentation: OverSegmentation,
    range_m: float,
) -> Records:
    """Return the `OBJECT_FEATURES` (n + 1,) of the segments after merging.

    Rows of segments that were merged into another are zeros. ``range_m`` is the range limit,
    metres.
    """
    features = np.zeros(oversegmentation.segments.parent.size, OBJECT_FEATURES)
    limits = ViewLimits(*_border_lines(grid), 1 / range_m + DISCONTINUITY / 2)
    _measure(grid, model, oversegmentation, limits, features)
    return features


class ViewLimits(NamedTuple):
    """Limits of the view: the borders of the image and the range.

    Attributes
    ----------
    top, bottom, left, right : first and last row, and first and last column, inside the blank
        borders of the image.
    inverse_depth : a cell with a smaller inverse depth is at the range limit, 1/m.
    """

    top: int
    bottom: int
    left: int
    right: int
    inverse_depth: float


def _border_lines(grid: DepthGrid) -> tuple[int, int, int, int]:
    """Return the first and last row, and the first and last column, inside the blank borders."""
    rows, columns = grid.inverse_depth.shape
    top, bottom, left, right = find_borders(grid.inverse_depth, 1).tolist()
    return top, rows - 1 - bottom, left, columns - 1 - right


@kernel
def _measure(
    grid: DepthGrid,
    model: PlaneModel,
    oversegmentation: OverSegmentation,
    limits: ViewLimits,
    out: Records,
) -> None:
    """Write the features of the segments that were not merged into another to ``out`` (n + 1,)."""
    segments, down = oversegmentation.segments, model.up[2]
    near_plane = _count_by_segment(grid, model, oversegmentation, limits, out)
    for p in range(1, segments.parent.size):
        if segments.parent[p] != p:
            continue
        segment, around, view = segments.statistics[p], out[p].surroundings, out[p].visibility
        depth = mean_depth(segment)
        cell, min_height = depth / grid.intrinsics.fx, min_height_at(depth)
        write_segment_features(segments, p, out[p].segment)
        around.image_border = share(around.image_border, 4 * math.sqrt(segment.count))
        around.range_limit = share(around.range_limit, segment.count)
        around.on_wall = share(around.on_wall, segment.count)
        around.low_profile = share(around.low_profile, segment.count)
        around.beyond = share(around.beyond, segment.boundary)
        around.into_wall = share(around.into_wall, segment.boundary)
        around.depth_edge = share(around.depth_edge, segment.boundary)
        if near_plane[p] > 0:
            mean = around.plane_height / near_plane[p]
            variance = max(around.plane_noise / near_plane[p] - mean * mean, 0.0)
            around.plane_height = mean / min_height
            around.plane_noise = math.sqrt(variance) / min_height
        plane = model.planes[segments.plane_id[p] - 1]
        _measure_outside(grid, plane, segments.samples[p], around)
        view.cells, view.depth_m, view.cell_m, view.down = segment.count, depth, cell, down
        view.top_by_noise = segment.top / min_height
        view.slant = share(segment.area, segment.count * cell * depth / grid.intrinsics.fy)
        view.ragged = share(segment.boundary * segment.boundary, segment.count)


@kernel(inline=True)
def _count_by_segment(
    grid: DepthGrid,
    model: PlaneModel,
    oversegmentation: OverSegmentation,
    limits: ViewLimits,
    out: Records,
) -> F8:
    """Write the counts for the surroundings of each segment to ``out`` (n + 1,), zeros before.

    The fields ``plane_height`` and ``plane_noise`` are sums of heights and of squared heights over
    the samples of planes near each segment. Returns the number of these samples, (n + 1,).
    """
    inv_depth, jump = grid.inverse_depth, grid.discontinuity
    _, planes, (plane_id, height), low, walls = model
    (_, _, _, _, spans), labels, segments = oversegmentation
    owner = segments.parent
    (lines, columns), near_plane = labels.shape, np.zeros(len(out))
    top, bottom, left, right, last = limits
    for i in range(lines):
        for j in range(spans[i, 0], spans[i, 1]):
            if labels[i, j] == 0:
                continue
            p, w = owner[labels[i, j]], inv_depth[i, j]
            row = out[p].surroundings
            # Most of these are rare: a branch is faster than adding 0.
            if i in (top, bottom) or j in (left, right):
                row.image_border += 1
            if w < last:
                row.range_limit += 1
            if walls[i, j] == ON_WALL:
                row.on_wall += 1
            if low[i, j]:
                row.low_profile += 1
            for di, dj in SIDES:
                y, x = i + CLEANUP.around_cells * di, j + CLEANUP.around_cells * dj
                if 0 <= y < lines and 0 <= x < columns and plane_id[y, x] < 0:
                    near_plane[p] += 1
                    row.plane_height += height[y, x]
                    row.plane_noise += height[y, x] ** 2
                y, x = min(max(i + di, 0), lines - 1), min(max(j + dj, 0), columns - 1)
                if 0 < inv_depth[y, x] <= w - jump:
                    row.depth_edge += 1
                if plane_id[y, x] != 0 or abs(inv_depth[y, x] - w) >= jump:
                    continue
                plane = planes[plane_id[i, j] - 1]
                if inv_depth[y, x] > max(plane.a * x + plane.b * y + plane.c, 0):
                    row.into_wall += walls[y, x] == CLEARED
                    row.beyond += walls[y, x] != CLEARED
    return near_plane


@kernel(inline=True)
def _measure_outside(grid: DepthGrid, plane: Row, samples: I4, out: Row) -> None:
    """Write how far samples are outside the outline of a `PLANE`: least, mean and largest distance.

    The distances are in metres, negative inside. ``samples`` (n,) are flat cell indices, -1 after
    the last.
    """
    total, n = 0.0, 0
    for s in samples:
        if s < 0:
            break
        i, j = row_and_column(s, grid.inverse_depth.shape[1])
        z = 1 / grid.inverse_depth[i, j]
        x, y = back_project(grid.intrinsics, i, j, z)
        outside = distance_outside(plane, x, y, z)
        out.least_outside_m = min(out.least_outside_m, outside) if n > 0 else outside
        out.most_outside_m = max(out.most_outside_m, outside) if n > 0 else outside
        total += outside
        n += 1
    out.mean_outside_m = share(total, n)
