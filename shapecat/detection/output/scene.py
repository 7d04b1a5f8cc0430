"""Scene builder: planes and objects as records in the sensor frame."""

from collections.abc import Sequence
from itertools import count

import numpy as np

from shapecat.arrays import F4, I4, U4, Bool, freeze
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.depth_grid import DepthGrid, find_borders
from shapecat.detection.output.measurements import ObjectMeasurements
from shapecat.detection.output.settings import OUTPUT
from shapecat.detection.planes.extent import SupportingPlane, outline_corners
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
    found: Segmentation,
    indices: Sequence[U4],
    sensor_from_view: Pose,
    *,
    settings: DetectionSettings,
    points: F4 | None = None,
) -> Scene:
    """Build the scene, in the sensor frame, from labelled cells and the points of each label.

    Parameters
    ----------
    indices : for each label from 1, the ascending indices of its points in the frame. Lists beyond
        the labels are objects that the view does not show.
    sensor_from_view : pose of the virtual camera in the sensor frame; `IDENTITY` for an image.
    points : (n, 3) metres, view frame, for the boxes of objects that the view does not show; None
        for an image.
    """
    measured, seen = found.measured, found.plane_ids.size - 1
    numbers = _number_visible(found.model.supports)
    plane_id = [numbers[k] for k in found.plane_ids[1:].tolist()]
    supported_by, occluded = measured.supported_by.tolist(), measured.occluded.tolist()
    at_border = _at_image_border if points is None else _at_view_border
    cut = at_border(grid, found, sensor_from_view)
    cut |= measured.at_range_limit
    kept = _kept(grid, measured, indices, settings.min_points, image=points is None)
    boxes = _boxes(found, indices, points, sensor_from_view)
    # Without a visible plane below it, an object cut off by the border is probably furniture.
    kept = [
        k
        for k in kept
        if (_fits(boxes[k], settings) if k >= seen else plane_id[k] is not None or not cut[k])
    ]
    position = {k + 1: n for n, k in enumerate(kept)}
    candidates = []
    for k in kept:
        on = position.get(supported_by[k]) if k < seen else None
        candidates.append(
            Candidate(
                indices=indices[k],
                box=boxes[k],
                plane=plane_id[k] if k < seen else None,
                on_candidate=on,
                support_m=0.0 if on is None else float(measured.support_m[k]),
                touches_border=k < seen and bool(cut[k]),
                occluded=k < seen and occluded[k],
            )
        )
    seen_planes = [s for s in found.model.supports if s.area_m2 > 0]
    planes = tuple(_plane(s, seen_planes[0].offset, sensor_from_view) for s in seen_planes)
    return Scene(sensor_from_view.rotation @ found.model.up, planes, tuple(candidates))


def _number_visible(supports: Sequence[SupportingPlane]) -> list[int | None]:
    """Return the index of each plane among the visible planes; None for an assumed plane."""
    numbers = count()
    return [next(numbers) if support.area_m2 > 0 else None for support in supports]


def _kept(
    grid: DepthGrid, measured: ObjectMeasurements, indices: Sequence[U4], least: int, *, image: bool
) -> list[int]:
    """Return the lists with enough points for an object, in the order of their first points."""
    limits = [float(least)] * len(indices)
    if image:
        limits = [max(least, n * grid.factor**2) for n in measured.least_cells.tolist()]
    enough = (k for k, limit in enumerate(limits) if indices[k].size >= limit)
    return sorted(enough, key=lambda k: int(indices[k][0]))


def _fits(box: Box, settings: DetectionSettings) -> bool:
    """Return whether a box is that of an object, not of a wall or furniture."""
    length, width, height = box.size.tolist()
    low = height <= settings.max_height_m - CLEANUP.cut_off_m
    return bool(low and max(length, width) <= settings.max_size_m)


def _boxes(
    found: Segmentation, indices: Sequence[U4], points: F4 | None, sensor_from_view: Pose
) -> list[Box]:
    """Return the boxes of all lists: measured on cells, or on points for hidden objects."""
    measured = found.measured
    sizes = [measured.center, measured.size, measured.orientation]
    if sensor_from_view is IDENTITY:  # rows of a frozen array are frozen
        sizes = [freeze(rows, "n k", "f4") for rows in sizes]
    boxes = [Box(*row) for row in zip(*sizes, strict=True)]
    if points is not None:
        extra = indices[found.plane_ids.size - 1 :]
        boxes += [upright_box(points[index], found.model.up) for index in extra]
    return [_transform_box(sensor_from_view, box) for box in boxes]


def _at_image_border(grid: DepthGrid, found: Segmentation, _: Pose) -> Bool:
    """Return whether each object reaches the border of the image, or a blank strip along it."""
    measured, near = found.measured, max(1, round(2 / grid.factor))
    shape = grid.inverse_depth.shape
    cut = np.zeros(len(measured.low), bool)
    for side, (blank, extent) in enumerate(find_borders(grid.inverse_depth, near).tolist()):
        axis = side // 2
        # The top of a tall object with nothing behind it is no border.
        first = near + (blank if extent > OUTPUT.straight_share * shape[1 - axis] else 0)
        if side % 2 == 0:
            cut |= measured.low[:, axis] < first
        else:
            cut |= measured.high[:, axis] > shape[axis] - 1 - first
    return cut


def _at_view_border(grid: DepthGrid, found: Segmentation, sensor_from_view: Pose) -> Bool:
    """Return whether each object reaches the border of the sensor's view, for a point cloud.

    Such a border is a long straight side of the cloud as seen from the sensor. A cloud fused from
    several views has none.
    """
    result = np.zeros(found.plane_ids.size, bool)
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
    seen = ray @ sensor_from_view.rotation.T
    ray = seen if (seen[:, 2] > OUTPUT.forward_cos).all() else ray  # else no optical frame
    place = ray[:, :2] / ray[:, 2:]
    spans = np.ptp(place, axis=0)
    for axis in range(2):
        for along in (place[:, axis], -place[:, axis]):
            near = along > along.max() - OUTPUT.border_cells / intrinsics.fx
            if np.ptp(place[near, 1 - axis]) > OUTPUT.straight_share * spans[1 - axis]:
                result[found.labels[i[near], j[near]]] = True
    return result[1:]


def _ends(valid: Bool, last: int) -> tuple[I4, I4]:
    """Return the first and last row with depth in each column; each column must have one."""
    return np.argmax(valid, axis=0), last - np.argmax(valid[::-1], axis=0)


def _transform_box(sensor_from_view: Pose, box: Box) -> Box:
    if sensor_from_view is IDENTITY:
        return box
    rotation = sensor_from_view.rotation @ rotation_from_quaternion(box.orientation)
    center = transform(sensor_from_view, box.center)
    return Box(center, box.size, quaternion_from_rotation(rotation))


def _plane(support: SupportingPlane, lowest: float, sensor_from_view: Pose) -> Plane:
    normal, offset, outline = support.up, support.offset, outline_corners(support)
    if sensor_from_view is not IDENTITY:
        normal = sensor_from_view.rotation @ normal
        offset += float(normal @ sensor_from_view.translation)
        outline = transform(sensor_from_view, outline)
    return Plane(normal, offset, outline, support.area_m2, support.offset - lowest)
