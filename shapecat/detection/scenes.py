"""Scenes: what segmentation found, as records in the sensor frame."""

import math
from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F4, F8, I4, U4, Bool
from shapecat.config import DetectionSettings
from shapecat.detection.candidates import Extents, extents_of, occluded, stands_of
from shapecat.detection.cells import NEAREST_M, Cells
from shapecat.detection.pieces import FEW, depths_of
from shapecat.detection.planes import Support, corners_of
from shapecat.detection.segmentation import Segmentation
from shapecat.geometry import (
    IDENTITY,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
    upright_box,
)
from shapecat.jit import kernel
from shapecat.types import Box, Candidate, Plane, Pose, Scene

__all__ = ["scene_of"]

BORDER = 0.12
"""Share of the image in which its readings may begin: a registered Kinect is blind in a tenth."""
ENOUGH = 60
"""Cells of what is no noise, however near and therefore small it is."""
BORDER_CELLS, STRAIGHT, LEAST_FORWARD = 2.5, 0.3, 0.2
"""The border of a cloud: its width, and the least share of a side that it is straight along; the
least cosine, about, of what is in front of a camera."""


def scene_of(
    cells: Cells,
    found: Segmentation,
    indices: Sequence[U4],
    sensor_from_view: Pose,
    *,
    settings: DetectionSettings,
    points: F4 | None = None,
) -> Scene:
    """Return the scene of the labels whose points are ``indices``.

    Lists beyond the labels are objects that the view does not show; their boxes are measured on
    ``points`` (n, 3), view frame.
    """
    count = found.leaders.size - 1
    least = np.full(len(indices), settings.min_points)
    if points is None:
        small = cells.small(depths_of(found.pieces)[found.leaders[1:]])
        least = np.maximum(least, np.minimum(small, ENOUGH) * cells.factor**2)
    kept = sorted(
        (k for k, index in enumerate(indices) if index.size >= least[k]),
        key=lambda k: int(indices[k][0]),
    )
    position = {k + 1: n for n, k in enumerate(kept)}
    boxes = _boxes(cells, found, indices, points)
    cut = _cut(cells, boxes) if points is None else _cut_cloud(cells, found, sensor_from_view)
    cut |= _out_of_range(cells, found, settings.max_range_m)
    stands, hidden, owners = stands_of(found), occluded(found), found.owners
    candidates = []
    for k in kept:
        seen = k < count
        on = position.get(stands[k].label) if seen else None
        candidates.append(
            Candidate(
                indices=indices[k],
                box=_moved(sensor_from_view, boxes.center[k], boxes.size[k], boxes.orientation[k]),
                plane=int(owners[k + 1]) if seen else None,
                on_candidate=on,
                support_m=0.0 if on is None else stands[k].height_m,
                touches_border=bool(seen and cut[k]),
                occluded=bool(seen and hidden[k]),
            )
        )
    lowest = found.supports[0].offset
    planes = tuple(_plane(s, lowest, sensor_from_view) for s in found.supports)
    return Scene(sensor_from_view.rotation @ found.up, planes, tuple(candidates))


def _boxes(cells: Cells, found: Segmentation, indices: Sequence[U4], points: F4 | None) -> Extents:
    """Measure on the cells what they show, and on the points what they do not."""
    boxes = extents_of(cells, found)
    extra = indices[found.leaders.size - 1 :]
    if points is None or not extra:
        return boxes
    more = [upright_box(points[index], found.up) for index in extra]
    return boxes._replace(
        center=np.concatenate([boxes.center, [box.center for box in more]]),
        size=np.concatenate([boxes.size, [box.size for box in more]]),
        orientation=np.concatenate([boxes.orientation, [box.orientation for box in more]]),
    )


def _cut(cells: Cells, extents: Extents) -> Bool:
    """Return whether each object reaches the border of the image, or of its readings near it."""
    result = np.zeros(len(extents.low), bool)
    reach = max(1, round(2 / cells.factor))
    for axis in range(2):
        last = cells.w.shape[axis] - 1
        result |= extents.low[:, axis] < _begin(cells.w, axis, 1, reach) + reach
        result |= extents.high[:, axis] > last - _begin(cells.w, axis, -1, reach) - reach
    return result


@kernel(leaf=True)
def _begin(w: F4, axis: int, step: int, reach: int) -> int:
    """Return the line at which the readings begin: the first with any, if more than one thing is.

    The top of a tall thing with nothing behind it is no border. Lines are rows (``axis`` 0) or
    columns, from the first on or, with ``step`` -1, from the last.
    """
    lines, length = w.shape[axis], w.shape[1 - axis]
    first, low, high = -1, length, -1
    for k in range(math.ceil(BORDER * lines)):
        if first >= 0 and k >= first + reach:
            break
        line = k if step > 0 else lines - 1 - k
        for n in range(length):
            if (w[line, n] if axis == 0 else w[n, line]) > 0:
                first = k if first < 0 else first
                low, high = min(low, n), max(high, n)
    return first if first >= 0 and high - low > STRAIGHT * length else 0


def _out_of_range(cells: Cells, found: Segmentation, range_m: float) -> Bool:
    """Return whether each object reaches the range, beyond which readings are left out."""
    count = cells.count_last(found.labels, found.leaders.size, range_m=range_m)
    return np.asarray(count[1:] >= FEW)


def _cut_cloud(cells: Cells, found: Segmentation, sensor_from_view: Pose) -> Bool:
    """Return whether each object reaches a border of what the sensor of a cloud saw.

    Such a border is a straight side of the cloud as seen from the sensor's place, with more than
    one thing along it. A cloud fused from several views has none.
    """
    result = np.zeros(found.leaders.size, bool)
    valid = cells.w > 0
    if np.linalg.norm(sensor_from_view.translation) > NEAREST_M or not valid.any():
        return result[1:]
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    last_row, last_column = valid.shape[0] - 1, valid.shape[1] - 1
    i = np.concatenate([rows, rows, *_ends(valid[:, columns], last_row)])
    j = np.concatenate([*_ends(valid[rows].T, last_column), columns, columns])
    lens = cells.lens
    ray = np.stack([(j - lens.cx) / lens.fx, (i - lens.cy) / lens.fy, np.ones(i.size)], 1)
    seen = ray @ sensor_from_view.rotation.T
    ray = seen if (seen[:, 2] > LEAST_FORWARD).all() else ray  # else no optical frame
    place = ray[:, :2] / ray[:, 2:]
    spans = np.ptp(place, axis=0)
    for axis in range(2):
        for along in (place[:, axis], -place[:, axis]):
            near = along > along.max() - BORDER_CELLS / lens.fx
            if np.ptp(place[near, 1 - axis]) > STRAIGHT * spans[1 - axis]:
                result[found.labels[i[near], j[near]]] = True
    return result[1:]


def _ends(valid: Bool, last: int) -> tuple[I4, I4]:
    """Return the first and the last row with a reading of every column; each has one."""
    return np.argmax(valid, axis=0), last - np.argmax(valid[::-1], axis=0)


def _moved(sensor_from_view: Pose, center: F8, size: F8, orientation: F8) -> Box:
    if sensor_from_view is IDENTITY:
        return Box(center, size, orientation)
    rotation = sensor_from_view.rotation @ rotation_from_quaternion(orientation)
    return Box(transform(sensor_from_view, center), size, quaternion_from_rotation(rotation))


def _plane(support: Support, lowest: float, sensor_from_view: Pose) -> Plane:
    normal = sensor_from_view.rotation @ support.up
    return Plane(
        normal=normal,
        offset=support.offset + float(normal @ sensor_from_view.translation),
        outline=transform(sensor_from_view, corners_of(support)),
        area_m2=support.area_m2,
        height_m=support.offset - lowest,
    )
