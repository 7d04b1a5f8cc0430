"""Measurements of labelled cells: boxes, support relations, and flags."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool, Records
from shapecat.detection.connected_components import spans_of
from shapecat.detection.depth_grid import DepthGrid, smallest_object_at
from shapecat.detection.merging.segments import MIN_LINKS, Segments
from shapecat.detection.output.settings import OUTPUT
from shapecat.geometry import gravity_rotation, level_box
from shapecat.jit import kernel

__all__ = ["ObjectMeasurements", "measure_objects"]


class Boxes(NamedTuple):
    """The boxes of the objects 1..n, in 3D and in the image, one row each.

    The view frame is the frame of the virtual camera; for a depth image, it is the sensor frame.

    Attributes
    ----------
    center, size : (n, 3) metres, of the upright box, view frame.
    orientation : (n, 4) quaternion x, y, z, w of the box, view frame.
    low, high : (n, 2) the first, and the last, row and column of the cells of each object.
    """

    center: F8
    size: F8
    orientation: F8
    low: I4
    high: I4


def _blank_boxes(count: int) -> Boxes:
    low, high = np.zeros((2, count, 2), np.int64)
    return Boxes(np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 4)), low, high)


class ObjectMeasurements(NamedTuple):
    """Measurements of the objects 1..n, one row each.

    Attributes
    ----------
    boxes : the boxes of the objects.
    supported_by : (n,) the label of the object that each object stands on; 0 for its plane.
    support_m : (n,) the height of that support above the plane, metres.
    occluded : (n,) whether a nearer surface hides part of the object.
    at_range_limit : (n,) whether the range limit cuts the object off.
    min_cells : (n,) float32, number of cells of the smallest object at the depth of this one.
    """

    boxes: Boxes
    supported_by: I4
    support_m: F8
    occluded: Bool
    at_range_limit: Bool
    min_cells: F4


def measure_objects(
    grid: DepthGrid,
    labels: I4,
    segments: Segments,
    representatives: I4,
    features: Records,
    up: F8,
    plane_offsets: F8,
) -> ObjectMeasurements:
    """Measure the boxes, the supports and the flags of the objects.

    A box is a `shapecat.geometry.upright_box` around the outermost and some inner cells of an
    object. If the object stands on its plane, the box reaches down to the plane.

    Parameters
    ----------
    labels : (rows, columns) objects 1..n, 0 elsewhere.
    representatives : (n + 1,) from `number_objects`.
    features : (segments + 1,) from `measure_object_features`.
    up : (3,) unit vector, view frame.
    plane_offsets : (n,) ``up @ p`` for the points p of the plane below each object, metres.
    """
    roots = representatives[1:]
    boxes = _blank_boxes(roots.size)
    _measure_boxes(grid, labels, gravity_rotation(up), boxes)
    supported_by, support_m = _find_supports(segments, representatives, boxes, up)
    touches = segments.statistics["plane_contact"][roots] >= MIN_LINKS
    _extend_to_planes(boxes, touches & (supported_by == 0), up, plane_offsets)
    objects = features[roots]
    segment, visibility = objects["segment"], objects["visibility"]
    cells_at_limit = np.rint(objects["surroundings"]["range_limit"] * visibility["cells"])
    return ObjectMeasurements(
        boxes,
        supported_by,
        support_m,
        segment["hidden"] + segment["behind"] > OUTPUT.occluded_share,
        cells_at_limit >= OUTPUT.min_cells_at_limit,
        smallest_object_at(grid, visibility["depth_m"]),
    )


def _extend_to_planes(boxes: Boxes, standing: Bool, up: F8, plane_offsets: F8) -> None:
    """Extend boxes down to their planes, in place, over gaps of at most `OUTPUT.lifted_m`.

    The lowest millimetres of an object are labelled as plane. ``standing`` (n,) is whether each
    object touches its plane and stands on no other object; ``up`` (3,) and ``plane_offsets`` (n,),
    metres, are as in `measure_objects`.
    """
    gaps = boxes.center @ up - boxes.size[:, 2] / 2 - plane_offsets
    gaps[~standing | (gaps < 0) | (gaps > OUTPUT.lifted_m)] = 0
    boxes.size[:, 2] += gaps
    boxes.center[:] -= np.outer(gaps / 2, up)


@kernel
def _find_supports(segments: Segments, representatives: I4, boxes: Boxes, up: F8) -> tuple[I4, F8]:
    """Return the label below each object, 0 for its plane, and the height there, metres: (n,) each.

    Object A stands on object B if A is over B, and has more contact with the upward-facing surface
    of B than with the plane. If that contact is hidden, the bottom of A must be at the top of B.
    ``representatives`` and ``up`` are as in `measure_objects`.
    """
    count = representatives.size - 1
    supported_by, support_m = np.zeros(count, np.int64), np.zeros(count)
    for k in range(count):
        below = _objects_below(boxes, up, k)
        supported_by[k], support_m[k] = _supporting_object(
            segments, representatives, representatives[k + 1], below
        )
    _break_cycles(supported_by, support_m)
    return supported_by, support_m


@kernel(inline=True)
def _objects_below(boxes: Boxes, up: F8, k: int) -> Bool:
    """Return for each label, (n + 1,), whether the middle of object ``k`` is over that object.

    An object may extend a little behind its visible part. If the middle of ``k`` is farther behind,
    ``k`` stands behind the object, even if the visible part of ``k`` begins at the object's top.
    ``up`` (3,) is a unit vector, view frame; ``k`` counts from 0.
    """
    count = boxes.center.shape[0]
    below = np.zeros(count + 1, np.bool_)
    for q in range(count):
        x, y, z, w = boxes.orientation[q]
        axis = (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w))
        height = rise = 0.0
        for d in range(3):
            height += boxes.center[q, d] * up[d]
            rise += (boxes.center[k, d] - boxes.center[q, d]) * up[d]
        distance2 = behind = apart2 = turn = 0.0
        for d in range(3):
            away = boxes.center[q, d] - height * up[d]
            shift = boxes.center[k, d] - boxes.center[q, d] - rise * up[d]
            distance2 += away * away
            behind += shift * away
            apart2 += shift * shift
            turn += axis[d] * away
        distance = max(np.sqrt(distance2), 1e-9)
        behind /= distance
        beside = np.sqrt(max(apart2 - behind * behind, 0.0))
        c = min(abs(turn) / distance, 1.0)
        s = np.sqrt(1 - c * c)
        depth = (c * boxes.size[q, 0] + s * boxes.size[q, 1]) / 2
        width = (s * boxes.size[q, 0] + c * boxes.size[q, 1]) / 2
        below[q + 1] = (
            beside < width + OUTPUT.beside_m
            and -depth - OUTPUT.beside_m < behind < depth + OUTPUT.behind_m
        )
    return below


@kernel(inline=True)
def _supporting_object(
    segments: Segments, representatives: I4, p: int, below: Bool
) -> tuple[int, float]:
    """Return the label below segment p, 0 for its plane, and the height of this support, metres.

    ``representatives`` is as in `measure_objects`; ``below`` (n + 1,) is from `_objects_below`.
    """
    pairs, statistics, segment = segments.pairs[p], segments.statistics, segments.statistics[p]
    best = 0
    for k in range(1, representatives.size):
        larger = pairs[representatives[k]].rests_on > pairs[representatives[best]].rests_on
        best = k if larger and below[k] else best
    contact = pairs[representatives[best]].rests_on
    if contact >= MIN_LINKS and contact > segment.plane_contact:
        height = float(pairs[representatives[best]].rests_on_height / contact)
        return (0, 0.0) if segment.bottom < height - OUTPUT.sunk_m else (best, height)
    if segment.bottom > OUTPUT.lifted_m and segment.plane_contact < MIN_LINKS:
        best = _hidden_support(segments, representatives, p, below)
        return best, float(statistics[representatives[best]].top) if best else 0.0
    return 0, 0.0


@kernel(inline=True)
def _hidden_support(segments: Segments, representatives: I4, p: int, below: Bool) -> int:
    """Return the label below segment ``p`` with the longest border to it; 0 if there is none.

    A segment that lies mostly below the top of an object is not on the object, but behind it. The
    parameters are as in `_supporting_object`.
    """
    statistics, pairs = segments.statistics, segments.pairs
    max_overlap = min(OUTPUT.overlap_m, (statistics[p].top - statistics[p].bottom) / 2)
    middle = (statistics[p].left + statistics[p].right) / 2
    best, best_border = 0, 0.0
    for k in range(1, representatives.size):
        q = representatives[k]
        border = (
            pairs[p, q].contact + pairs[p, q].near + pairs[p, q].in_front + pairs[q, p].in_front
        )
        overlap = statistics[q].top - statistics[p].bottom
        lower = -OUTPUT.gap_m < overlap < max_overlap
        beside = statistics[q].left < middle < statistics[q].right
        if q != p and below[k] and lower and beside and border > best_border:
            best, best_border = k, border
    return best if best_border >= MIN_LINKS else 0


@kernel(inline=True)
def _break_cycles(supported_by: I4, support_m: F8) -> None:
    """Put an object on its plane if the objects below it, one after the other, form a cycle.

    ``supported_by`` and ``support_m`` (n,) are as in `ObjectMeasurements`, changed in place.
    """
    for k in range(supported_by.size):
        support = supported_by[k]
        for _ in range(supported_by.size):
            support = supported_by[support - 1] if support > 0 else 0
        if support > 0:
            supported_by[k], support_m[k] = 0, 0.0


@kernel(fast=True)
def _measure_boxes(grid: DepthGrid, labels: I4, level: F8, boxes: Boxes) -> None:
    """Write the boxes of the objects 1..n in ``labels`` (rows, columns).

    The rows of ``level`` (3, 3) are the level axes in the view frame (see `Boxes`).
    """
    points, start = _outer_points(grid, labels, level, boxes)
    for k in range(start.size - 1):
        if start[k] < start[k + 1]:
            center, size, orientation = level_box(points[:, start[k] : start[k + 1]], level)
            for d in range(4):  # assigning whole rows would compile a check of their sizes
                boxes.orientation[k, d] = orientation[d]
            for d in range(3):
                boxes.center[k, d], boxes.size[k, d] = center[d], size[d]


@kernel(fast=True, inline=True)
def _outer_points(grid: DepthGrid, labels: I4, level: F8, boxes: Boxes) -> tuple[F4, I4]:
    """Return points (3, p) of the objects, level frame, and the index where each object begins.

    The points are the outermost cells, and the cells inside at every 4th row and column, since the
    nearest point of a ball is inside its outline. The indices (n + 1,) end with p. Also writes
    ``boxes.low`` and ``boxes.high``. The parameters are as in `_measure_boxes`.
    """
    rows, columns = labels.shape
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    low, high = boxes.low, boxes.high
    spans, outer = spans_of(labels), np.zeros(columns, np.bool_)
    cells = n = 0
    for i in range(rows):
        cells += spans[i, 1] - spans[i, 0]
    selected = np.zeros((cells, 2), np.int32)
    start = np.zeros(low.shape[0] + 1, np.int64)
    for i in range(rows):
        first, end = spans[i, 0], spans[i, 1]
        _find_outer(labels, i, first, end, outer)
        for j in range(first, end):
            if outer[j]:
                k = labels[i, j] - 1
                if start[k + 1] == 0:
                    low[k, 0], low[k, 1] = i, j
                start[k + 1] += 1
                low[k, 1] = min(low[k, 1], j)
                high[k, 0], high[k, 1] = i, max(high[k, 1], j)
                selected[n, 0], selected[n, 1] = i, j
                n += 1
    for k in range(1, start.size):
        start[k] += start[k - 1]
    offset, points = start.copy(), np.zeros((3, n), np.float32)
    for m in range(n):
        i, j = selected[m, 0], selected[m, 1]
        k = labels[i, j] - 1
        z = 1 / inv_depth[i, j]
        x, y = (j - intrinsics.cx) / intrinsics.fx * z, (i - intrinsics.cy) / intrinsics.fy * z
        for d in range(3):
            points[d, offset[k]] = level[d, 0] * x + level[d, 1] * y + level[d, 2] * z
        offset[k] += 1
    return points, start


@kernel(inner=True)
def _find_outer(labels: I4, i: int, first: int, end: int, outer: Bool) -> None:
    """Mark the labelled cells in part of row ``i`` that are next to other labels.

    Labelled cells at the edge of the grid, and those whose row and column are multiples of 4, are
    marked too. ``labels`` is (rows, columns); the part is from column ``first`` to before ``end``;
    the marks go to ``outer`` (columns,).
    """
    rows, columns = labels.shape
    if i == 0 or i == rows - 1:
        for j in range(first, end):
            outer[j] = labels[i, j] > 0
        return
    a, b = max(first, 1), min(end, columns - 1)
    row, row_above, row_below = labels[i, a:b], labels[i - 1, a:b], labels[i + 1, a:b]
    left, right, out = labels[i, a - 1 : b - 1], labels[i, a + 1 : b + 1], outer[a:b]
    for j in range(row.size):
        edge = (row_above[j] != row[j]) | (row_below[j] != row[j])
        edge |= (left[j] != row[j]) | (right[j] != row[j])
        out[j] = edge & (row[j] > 0)
    outer[0], outer[columns - 1] = labels[i, 0] > 0, labels[i, columns - 1] > 0
    if i % 4 == 0:
        for j in range(first + -first % 4, end, 4):
            outer[j] = labels[i, j] > 0
