"""Detection: from one frame to planes and object candidates (thesis ch. 4)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8, U4
from shapecat.config import DetectionSettings
from shapecat.detection.candidates import boxes_of, occluded, stands_of
from shapecat.detection.cells import Cells, cells_of
from shapecat.detection.heights import table_of
from shapecat.detection.pixels import pixels_of, points_of
from shapecat.detection.planes import Support, corners_of
from shapecat.detection.segmentation import Segmentation, segment
from shapecat.detection.views import view_of
from shapecat.geometry import IDENTITY, compose, inverse, quaternion_from_rotation, transform
from shapecat.types import Box, Candidate, Frame, Plane, Pose, Scene

__all__ = ["detect"]

DEFAULT_UP = (0.0, -1.0, 0.0)
"""Up in an upright optical frame, where nothing else is known."""


def detect(
    frame: Frame,
    *,
    up: ArrayLike | None = None,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Scene:
    """Find the supporting planes of a frame and the objects on them.

    Parameters
    ----------
    frame : a depth image or a cloud. The sensor is at the origin of its frame.
    up : (3,) direction away from gravity, sensor frame, of any length but zero. With it only
        planes within 15 degrees of level count; without, it is estimated from the dominant plane.
    settings : see `DetectionSettings`.
    rng : source of the random triples of RANSAC; the same state gives the same scene.

    Returns
    -------
    The planes, lowest first, and the objects from left to right in reading order of their first
    point; both empty if no supporting plane is seen.

    Raises
    ------
    ValueError : ``up`` is not a direction.

    Notes
    -----
    Depth images are worked on in image space. An unorganized cloud is looked at through a virtual
    camera at the origin and goes the same way, so both give the same answer on the same scene.
    """
    hint = None if up is None else _unit(up)
    empty = Scene(DEFAULT_UP if hint is None else hint, (), ())
    if frame.depth is not None and frame.camera is not None:
        cells = cells_of(frame.depth, frame.camera, range_m=settings.max_range_m)
        found = _segmented(cells, hint, settings, rng, upright=True)
        if cells is None or found is None:
            return empty
        planes, owners = table_of(found.supports, cells.lens), _owners(found)
        indices = pixels_of(
            frame.depth, cells, found.labels, planes, owners, found.filled,
            range_m=settings.max_range_m,
        )
        border = _cut(frame.depth, indices)
        return _scene(cells, found, indices, border, IDENTITY, settings)
    cloud = frame.xyz()
    view = view_of(cloud, range_m=settings.max_range_m)
    if view is None:
        return empty
    turned = None if hint is None else view.view_from_sensor.rotation @ hint
    found = _segmented(view.cells, turned, settings, rng, upright=False)
    if found is None:
        return empty
    planes, owners = table_of(found.supports, view.cells.lens), _owners(found)
    indices = points_of(
        view.points, view.cell, view.cells, found.labels, planes, owners, found.filled
    )
    border = [False] * len(indices)
    return _scene(view.cells, found, indices, border, inverse(view.view_from_sensor), settings)


def _unit(up: ArrayLike) -> F8:
    vector = np.asarray(up, np.float64)
    norm = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not (np.isfinite(norm) and norm > 1e-9):
        msg = f"up must be a direction (3,), got {vector.tolist()}"
        raise ValueError(msg)
    return vector / norm


def _segmented(
    cells: Cells | None,
    hint: F8 | None,
    settings: DetectionSettings,
    rng: np.random.Generator,
    *,
    upright: bool,
) -> Segmentation | None:
    if cells is None:
        return None
    return segment(
        cells,
        hint,
        upright=upright,
        highest_m=settings.max_height_m,
        largest_m=settings.max_size_m,
        rules=settings.rules.split(),
        rng=rng,
    )


def _owners(found: Segmentation) -> F8:
    """Return the plane that each label, 0 included, stands above."""
    return np.maximum(found.pieces.owner[found.leaders].astype(np.int64) - 1, 0)


def _cut(depth: F4, indices: Sequence[U4]) -> list[bool]:
    """Return whether each object reaches the border of the image, or of its readings near it."""
    rows, columns = depth.shape
    valid_rows = np.flatnonzero((depth > 0).any(axis=1))
    valid_columns = np.flatnonzero((depth > 0).any(axis=0))
    near_y, near_x = 0.05 * rows, 0.05 * columns
    y0, y1 = int(valid_rows[0]), int(valid_rows[-1])
    x0, x1 = int(valid_columns[0]), int(valid_columns[-1])
    y0, x0 = (y0 if y0 < near_y else 0), (x0 if x0 < near_x else 0)
    y1 = y1 if y1 >= rows - near_y else rows - 1
    x1 = x1 if x1 >= columns - near_x else columns - 1
    result = []
    for index in indices:
        if index.size == 0:
            result.append(False)
            continue
        x = index % columns
        top, bottom = int(index[0]) // columns, int(index[-1]) // columns
        result.append(
            top < y0 + 2 or bottom > y1 - 2 or int(x.min()) < x0 + 2 or int(x.max()) > x1 - 2
        )
    return result


def _scene(
    cells: Cells,
    found: Segmentation,
    indices: Sequence[U4],
    border: Sequence[bool],
    sensor_from_view: Pose,
    settings: DetectionSettings,
) -> Scene:
    centers, sizes, turns = boxes_of(cells, found)
    stands, hidden, owners = stands_of(found), occluded(found), _owners(found)
    sizes_px = np.array([index.size for index in indices], np.int64)
    least = max(settings.min_points, 75 * cells.factor**2)
    kept = [k for k in np.argsort([i[0] if i.size else 0 for i in indices], kind="stable")
            if sizes_px[k] >= least]
    position = {k + 1: n for n, k in enumerate(kept)}
    candidates = []
    for k in kept:
        stand = stands[k]
        on = position.get(stand.label)
        candidates.append(
            Candidate(
                indices[k],
                Box(transform(sensor_from_view, centers[k]), sizes[k], _turned(sensor_from_view, turns[k])),
                int(owners[k + 1]),
                on,
                stand.height_m if on is not None else 0.0,
                border[k],
                hidden[k],
            )
        )
    lowest = found.supports[0].offset
    planes = tuple(_plane(s, lowest, sensor_from_view) for s in found.supports)
    return Scene(sensor_from_view.rotation @ found.up, planes, tuple(candidates))


def _turned(sensor_from_view: Pose, quaternion: F8) -> F8:
    if sensor_from_view is IDENTITY:
        return quaternion
    from shapecat.geometry import rotation_from_quaternion

    return quaternion_from_rotation(sensor_from_view.rotation @ rotation_from_quaternion(quaternion))


def _plane(support: Support, lowest: float, sensor_from_view: Pose) -> Plane:
    normal = sensor_from_view.rotation @ support.up
    offset = support.offset + float(normal @ sensor_from_view.translation)
    return Plane(
        normal,
        offset,
        transform(sensor_from_view, corners_of(support)),
        support.area_m2,
        support.offset - lowest,
    )
