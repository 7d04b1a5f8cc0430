"""Scene builder: planes and objects as records in the sensor frame."""

from collections.abc import Sequence
from itertools import count

import numpy as np

from shapecat.arrays import F4, I4, U4, Bool, Records, Row, freeze
from shapecat.config import DetectionSettings
from shapecat.detection.depth_grid import STRAIGHT_SHARE, DepthGrid, find_borders
from shapecat.detection.output.measurements import ObjectMeasurements
from shapecat.detection.output.settings import OUTPUT
from shapecat.detection.planes.extent import outline_corners
from shapecat.detection.planes.height_map import CUT_OFF_M
from shapecat.detection.records import Segmentation
from shapecat.geometry import (
    IDENTITY,
    NEAREST_M,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
    upright_box,
)
from shapecat.types import Box, Candidate, Plane, Pose, Scene

__all__ = ["build_scene"]


def build_scene(
    grid: DepthGrid,
    segmentation: Segmentation,
    indices: Sequence[U4],
    sensor_from_view: Pose,
    *,
    settings: DetectionSettings,
    points: F4 | None = None,
) -> Scene:
    """Build the scene, in the sensor frame, from labelled cells and the points of each label.

    Left out are objects with too few points, objects above an assumed plane that the border or the
    range limit cuts off, and objects that the view does not show and that are too large.

    Parameters
    ----------
    indices : for each label from 1, the ascending indices of its points in the frame. Further lists
        are objects that the view does not show.
    sensor_from_view : pose of the virtual camera in the sensor frame; `IDENTITY` for an image.
    points : (n, 3) metres, view frame, for the boxes of objects that the view does not show; None
        for an image.
    """
    measured, visible_count = segmentation.measured, segmentation.plane_ids.size - 1
    model = segmentation.model
    numbers = _number_visible(model.planes)
    plane_id = [numbers[k] for k in segmentation.plane_ids[1:].tolist()]
    supported_by, occluded = measured.supported_by.tolist(), measured.occluded.tolist()
    at_border = _at_image_border if points is None else _at_view_border
    truncated = at_border(grid, segmentation, sensor_from_view)
    truncated |= measured.at_range_limit
    selected = _select_objects(grid, measured, indices, settings.min_points, image=points is None)
    boxes = _boxes(segmentation, indices, points, sensor_from_view)

    def is_object(k: int) -> bool:
        if k >= visible_count:
            return _has_object_size(boxes[k], settings)
        # An object that the border cuts off and that has no visible plane is probably furniture.
        return plane_id[k] is not None or not truncated[k]

    selected = [k for k in selected if is_object(k)]
    position = {k + 1: n for n, k in enumerate(selected)}
    candidates = []
    for k in selected:
        support = position.get(supported_by[k]) if k < visible_count else None
        candidates.append(
            Candidate(
                indices=indices[k],
                box=boxes[k],
                plane=plane_id[k] if k < visible_count else None,
                on_candidate=support,
                support_m=0.0 if support is None else float(measured.support_m[k]),
                touches_border=k < visible_count and bool(truncated[k]),
                occluded=k < visible_count and occluded[k],
            )
        )
    visible = model.planes[model.planes["area_m2"] > 0]
    planes = tuple(_plane(plane, visible[0]["offset"], sensor_from_view) for plane in visible)
    return Scene(sensor_from_view.rotation @ model.up, planes, tuple(candidates))


def _number_visible(planes: Records) -> list[int | None]:
    """Return the index of each plane among the visible planes; None for an assumed plane."""
    numbers = count()
    return [next(numbers) if area_m2 > 0 else None for area_m2 in planes["area_m2"]]


def _select_objects(
    grid: DepthGrid,
    measured: ObjectMeasurements,
    indices: Sequence[U4],
    min_points: int,
    *,
    image: bool,
) -> list[int]:
    """Return the indices of the lists with enough points, in the order of their first points.

    ``indices`` are the pixels or points of each label; ``image`` says whether they are pixels. A
    list needs ``min_points`` and, in an image, as many pixels as `ObjectMeasurements.min_cells`
    cells have.
    """
    limits = [float(min_points)] * len(indices)
    if image:
        limits = [max(min_points, n * grid.factor**2) for n in measured.min_cells.tolist()]
    selected = (k for k, limit in enumerate(limits) if indices[k].size >= limit)
    return sorted(selected, key=lambda k: int(indices[k][0]))


def _has_object_size(box: Box, settings: DetectionSettings) -> bool:
    """Return whether an object that the view does not show is small enough not to be structure.

    `find_background` checks the visible objects.
    """
    length, width, height = box.size.tolist()
    low = height <= settings.max_height_m - CUT_OFF_M
    return bool(low and max(length, width) <= settings.max_size_m)


def _boxes(
    segmentation: Segmentation, indices: Sequence[U4], points: F4 | None, sensor_from_view: Pose
) -> list[Box]:
    """Return the box of each list in ``indices``, measured on cells, or on points if not in view.

    ``indices`` and ``points`` are as in `build_scene`. The boxes are in the sensor frame.
    """
    measured = segmentation.measured.boxes
    sizes = [measured.center, measured.size, measured.orientation]
    if sensor_from_view is IDENTITY:  # rows of a frozen array are frozen
        sizes = [freeze(rows, "n k", "f4") for rows in sizes]
    boxes = [Box(*row) for row in zip(*sizes, strict=True)]
    if points is not None:
        extra = indices[segmentation.plane_ids.size - 1 :]
        boxes += [upright_box(points[index], segmentation.model.up) for index in extra]
    return [_transform_box(sensor_from_view, box) for box in boxes]


def _at_image_border(grid: DepthGrid, segmentation: Segmentation, _: Pose) -> Bool:
    """Return for each object (n,) whether it reaches the image border or a blank strip along it."""
    boxes, band = segmentation.measured.boxes, max(1, round(2 / grid.factor))
    shape = grid.inverse_depth.shape
    truncated = np.zeros(len(boxes.low), bool)
    for side, blank in enumerate(find_borders(grid.inverse_depth, band).tolist()):
        axis, first = side // 2, band + blank
        if side % 2 == 0:
            truncated |= boxes.low[:, axis] < first
        else:
            truncated |= boxes.high[:, axis] > shape[axis] - 1 - first
    return truncated


def _at_view_border(grid: DepthGrid, segmentation: Segmentation, sensor_from_view: Pose) -> Bool:
    """Return for each object (n,) whether it reaches the border of the sensor's view.

    Such a border is a long straight side of the cloud as seen from the sensor. If the virtual
    camera is elsewhere (`top_view`), none is searched for.
    """
    result = np.zeros(segmentation.plane_ids.size, bool)
    valid = grid.inverse_depth > 0
    if np.linalg.norm(sensor_from_view.translation) > NEAREST_M or not valid.any():
        return result[1:]
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    last_row, last_column = valid.shape[0] - 1, valid.shape[1] - 1
    i = np.concatenate([rows, rows, *_ends(valid[:, columns], last_row)])
    j = np.concatenate([*_ends(valid[rows].T, last_column), columns, columns])
    intrinsics = grid.intrinsics
    x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
    ray = np.stack([x, y, np.ones(i.size)], 1)
    rotated = ray @ sensor_from_view.rotation.T
    ray = rotated if (rotated[:, 2] > OUTPUT.forward_cos).all() else ray  # else no optical frame
    slopes = ray[:, :2] / ray[:, 2:]
    spans = np.ptp(slopes, axis=0)
    for axis in range(2):
        for along in (slopes[:, axis], -slopes[:, axis]):
            at_border = along > along.max() - OUTPUT.border_cells / intrinsics.fx
            if np.ptp(slopes[at_border, 1 - axis]) > STRAIGHT_SHARE * spans[1 - axis]:
                result[segmentation.labels[i[at_border], j[at_border]]] = True
    return result[1:]


def _ends(valid: Bool, last: int) -> tuple[I4, I4]:
    """Return the first and last row with depth in each column; each column must have one.

    ``valid`` (rows, columns) is where depth is; ``last`` is the last row. The results are
    (columns,).
    """
    return np.argmax(valid, axis=0), last - np.argmax(valid[::-1], axis=0)


def _transform_box(sensor_from_view: Pose, box: Box) -> Box:
    if sensor_from_view is IDENTITY:
        return box
    rotation = sensor_from_view.rotation @ rotation_from_quaternion(box.orientation)
    center = transform(sensor_from_view, box.center)
    return Box(center, box.size, quaternion_from_rotation(rotation))


def _plane(plane: Row, lowest: float, sensor_from_view: Pose) -> Plane:
    """Return a `PLANE` as a `Plane` in the sensor frame, with its height above ``lowest``.

    ``lowest`` is the offset of the lowest visible plane, metres.
    """
    normal, offset = plane["up"], float(plane["offset"])
    outline = outline_corners(normal, offset, plane["extent"])
    if sensor_from_view is not IDENTITY:
        normal = sensor_from_view.rotation @ normal
        offset += float(normal @ sensor_from_view.translation)
        outline = transform(sensor_from_view, outline)
    return Plane(normal, offset, outline, float(plane["area_m2"]), float(plane["offset"] - lowest))
