"""Labels of points: the labels of cells transferred to the points of a cloud."""

import numpy as np

from shapecat.arrays import F4, I4, U1, U4, Bool, Row
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.output.label_upsampling import (
    assign_labels,
    dilate_row,
)
from shapecat.detection.output.occluded_points import label_occluded_points
from shapecat.detection.output.pixel_runs import pixels_by_label, split_by_label
from shapecat.detection.output.settings import OUTPUT
from shapecat.detection.planes.height_map import distance_outside, height_above, min_height_at
from shapecat.detection.records import Segmentation
from shapecat.detection.virtual_camera import VirtualImage
from shapecat.jit import kernel

__all__ = ["label_points"]


def label_points(
    view: VirtualImage, segmentation: Segmentation, *, fused: bool, max_height_m: float
) -> list[U4]:
    """Return the points of each label 1, 2, ...: ascending indices (k,) uint32.

    If ``fused``, points behind the visible surface, at most ``max_height_m``, metres, above a
    plane, join the objects they touch. Those that touch no visible object form clusters, which are
    further lists at the end, up to label `OUTPUT.max_label`.
    """
    points, grid, labels = view.points, view.grid, segmentation.plane_ids.size
    marks = np.zeros(len(points), np.int16)
    _mark_points(points, view.cell, grid, segmentation, marks)
    if fused:
        above = marks > 0
        for plane in segmentation.model.planes:
            above |= _above(points, view.cell, grid.intrinsics, plane, max_height_m)
        indices = np.flatnonzero(above)
        if indices.size:
            spread = label_occluded_points(points[indices], marks[indices].astype(np.int64), labels)
            marks[indices] = np.where(spread <= OUTPUT.max_label, spread, 0)
            labels = max(labels, int(marks.max()) + 1)
    edges = np.flatnonzero(np.diff(marks, prepend=0, append=0)).astype(np.int32)
    runs = np.stack([marks[edges[:-1]], edges[:-1], edges[1:]], 1, dtype=np.int32)
    return split_by_label(*pixels_by_label(runs, labels))


@kernel
def _above(
    points: F4, cell: I4, intrinsics: PinholeIntrinsics, plane: Row, max_height_m: float
) -> Bool:
    """Return which points (n, 3), view frame, are above a plane and inside its outline, (n,).

    The result is False for points out of view. ``cell`` (n,) is as in `VirtualImage`;
    ``max_height_m`` is the maximum height above the plane, metres.
    """
    result = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        if cell[k] >= 0:
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            i, j = intrinsics.fy * y / z + intrinsics.cy, intrinsics.fx * x / z + intrinsics.cx
            h = height_above(plane, i, j, z)
            result[k] = (
                h > min_height_at(z) and h < max_height_m and distance_outside(plane, x, y, z) <= 0
            )
    return result


@kernel(inline=True)
def _dilate(labels: I4) -> U1:
    """Return 1 for the cells that have a label or a neighbour with one, (rows, columns)."""
    dilated = np.zeros(labels.shape, np.uint8)
    scratch = np.zeros(labels.shape[1] + 2, np.int16)
    for i in range(labels.shape[0]):
        dilate_row(labels, i, scratch, dilated)
    return dilated


@kernel
def _mark_points(
    points: F4, cell: I4, grid: DepthGrid, segmentation: Segmentation, marks: I4
) -> None:
    """Write the labels of points (n, 3) in the view frame to ``marks`` (n,).

    ``cell`` (n,) is the flat index of each point's cell; -1 out of view.
    """
    intrinsics, columns = grid.intrinsics, grid.inverse_depth.shape[1]
    dilated = _dilate(segmentation.labels).reshape(-1)
    count = points.shape[0]
    cells, positions = np.zeros((2, count), np.int64), np.zeros((3, count))
    indices, labels = np.zeros(count, np.int64), np.zeros(count, np.int16)
    n = 0
    for k in range(count):
        p = cell[k]
        if p < 0 or not dilated[p]:
            continue
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        cells[0, n], cells[1, n], indices[n] = p // columns, p % columns, k
        positions[0, n] = intrinsics.fx * x / z + intrinsics.cx
        positions[1, n] = intrinsics.fy * y / z + intrinsics.cy
        positions[2, n] = z
        n += 1
    assign_labels(grid, segmentation, cells, positions, n, labels)
    for m in range(n):
        marks[indices[m]] = labels[m]
