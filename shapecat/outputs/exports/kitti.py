"""KITTI 3D object detection: label_2, calib and velodyne of each frame.

KITTI boxes rotate only about the vertical, so the rectified camera frame is level: its z axis is
the horizontal direction in which the sensor looks. ``P2`` includes the rotation back to the real
camera. It maps rectified points to pixels of the undistorted colour image in image_2, or of the
depth image if a frame has no colour image. Source: the readme of the KITTI object development kit
(Geiger 2012).
"""

import csv
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from shapecat.arrays import F8
from shapecat.cameras.colour import LensCamera
from shapecat.colour.projection import project, rectified
from shapecat.errors import OutputError
from shapecat.geometry import IDENTITY, rotation_from_quaternion
from shapecat.outputs.colouring import Coloured, PairedFrame
from shapecat.recordings import MessageError
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.runs.finished import FinishedRun
from shapecat.types import Camera, Frame, LabelledObject, Pose

__all__ = ["kitti_type", "rectified_from_sensor", "write_kitti"]

_log = logging.getLogger(__name__)

_VELO_FROM_RECTIFIED = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def write_kitti(out: Path, frames: Iterable[PairedFrame], finished: FinishedRun) -> int:
    """Write label_2/, calib/ and velodyne/, with six-digit names; return the number of objects.

    Colour images are written to image_2/ as undistorted PNG. ``frames.csv`` maps each
    number to its frame. Points are in the level frame of the sensor (x forward, y left, z up), with
    intensity 0. The type is the category, with spaces replaced by ``_``.

    Raises
    ------
    OutputError : the categories of two tracks have the same type, apart from upper and lower case.
    """
    _require_distinct_types(sorted({label.category for label in finished.labels.values()}))
    for name in ("label_2", "calib", "velodyne"):
        (out / name).mkdir()
    count = 0
    with (out / "frames.csv").open("w", newline="", encoding="utf-8") as file:
        index = csv.writer(file, lineterminator="\n")
        index.writerow(("number", "topic", "frame", "stamp_ns"))
        for number, (labelled, frame, coloured) in enumerate(frames):
            view = _write_image(out, number, frame, coloured)
            index.writerow((f"{number:06d}", labelled.topic, labelled.index, labelled.stamp_ns))
            optical = frame.organized or bool(labelled.up[1] < -0.7)
            turn = rectified_from_sensor(labelled.up, optical=optical)
            lines = [_label(item, frame, turn, view) for item in labelled.objects]
            (out / "label_2" / f"{number:06d}.txt").write_text("".join(lines), "utf-8")
            (out / "calib" / f"{number:06d}.txt").write_text(_calibration(view, turn), "utf-8")
            points = frame.finite_xyz() @ (_VELO_FROM_RECTIFIED @ turn).T
            rows = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
            rows.astype("<f4").tofile(out / "velodyne" / f"{number:06d}.bin")
            count += len(lines)
    return count


def _require_distinct_types(categories: Iterable[str]) -> None:
    """Check that even readers that ignore case can tell the types of the categories apart.

    Raises
    ------
    OutputError : the types of two categories differ at most in case.
    """
    types: dict[str, str] = {}
    for name in categories:
        if (other := types.setdefault(kitti_type(name).lower(), name)) != name:
            msg = f"the categories {other!r} and {name!r} have the same KITTI type; relabel one"
            raise OutputError(msg)


def rectified_from_sensor(up: F8, *, optical: bool) -> F8:
    """Return the rotation (3, 3) from the sensor to a level camera: x right, y down, z forward.

    If the sensor looks almost straight down or up, the top of its image points forward.

    Parameters
    ----------
    up : (3,) up direction in the sensor frame.
    optical : whether the sensor looks along z with y down, else along x with z up.
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    axes = np.array([[0, 0, 1], [0, -1, 0]] if optical else [[1, 0, 0], [0, 0, 1]], np.float64)
    level = axes - np.outer(axes @ up, up)
    forward = level[0] if np.linalg.norm(level[0]) > 0.1 else level[1]
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(-up, forward), -up, forward])


class _View(NamedTuple):
    """The camera to which 2D boxes and ``P2`` refer, and ``pose``: ``camera_from_sensor``.

    ``camera`` is None for a cloud without a colour image.
    """

    camera: Camera | None
    pose: Pose


def _write_image(out: Path, number: int, frame: Frame, coloured: Coloured | None) -> _View:
    """Write the colour image of a frame, if any; return its camera, or else the depth camera.

    A damaged image is logged and counts as missing.
    """
    depth_view = _View(frame.camera, IDENTITY)
    if coloured is None or coloured.view.image.height <= 1:
        return depth_view
    view = coloured.view
    lens = view.lens
    if view.registered and frame.camera is not None:
        lens = LensCamera(frame.camera)
    if lens is None:
        return depth_view
    try:
        pixels = rectified(pixels_of(view.image), lens)
    except MessageError as error:
        _log.warning("image_2/%06d.png is missing: %s", number, error)
        return depth_view
    (out / "image_2").mkdir(exist_ok=True)
    Image.fromarray(pixels).save(out / "image_2" / f"{number:06d}.png", compress_level=4)
    return _View(lens.pinhole, view.colour_from_depth or IDENTITY)


def kitti_type(category: str) -> str:
    """Return the KITTI type of a category, in which ``_`` replaces spaces."""
    return category.replace(" ", "_")


def _label(item: LabelledObject, frame: Frame, turn: F8, view: _View) -> str:
    """Return a line of 15 values: type truncated occluded alpha bbox(4) h w l x y z rotation_y.

    They are in pixels, metres and radians. ``turn`` (3, 3) is from `rectified_from_sensor`.
    """
    length, width, height = map(float, item.box.size)
    x, y, z = turn @ item.box.center
    heading = turn @ rotation_from_quaternion(item.box.orientation)[:, 0]
    yaw = float(np.arctan2(-heading[2], heading[0]))
    alpha = (yaw - float(np.arctan2(x, z)) + np.pi) % (2 * np.pi) - np.pi
    numbers = (
        float(item.touches_border),
        int(item.occluded),
        *(f"{value:.5f}" for value in (alpha, *_pixels(item, frame, view))),
        *(f"{value:.5f}" for value in (height, width, length, x, y + height / 2, z, yaw)),
    )
    return " ".join([kitti_type(item.category), *map(str, numbers)]) + "\n"


def _pixels(item: LabelledObject, frame: Frame, view: _View) -> tuple[float, ...]:
    """Return left, top, right and bottom (inclusive) of an object, pixels; -1 if not visible."""
    camera, nowhere = view.camera, (-1.0, -1.0, -1.0, -1.0)
    if camera is None or not item.indices.size:
        return nowhere
    u, v, _ = project(frame.xyz(item.indices), LensCamera(camera), view.pose).astype(np.float64).T
    inside = (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
    if not inside.any():
        return nowhere
    u, v = np.rint(u[inside]), np.rint(v[inside])
    return (float(u.min()), float(v.min()), float(u.max()), float(v.max()))


def _calibration(view: _View, turn: F8) -> str:
    camera = view.camera
    intrinsic = np.eye(3)
    if camera is not None:
        intrinsic = np.array(
            [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float64
        )
    rotation, translation = view.pose.rotation @ turn.T, view.pose.translation[:, None]
    projection = intrinsic @ np.concatenate([rotation, translation], axis=1)
    still = np.zeros((3, 1))
    rows = {
        **{f"P{k}": projection for k in range(4)},
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": np.concatenate([_VELO_FROM_RECTIFIED.T, still], axis=1),
        "Tr_imu_to_velo": np.concatenate([np.eye(3), still], axis=1),
        "Tr_rect_to_sensor": np.concatenate([turn.T, still], axis=1),
    }
    return "".join(
        f"{name}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}\n"
        for name, matrix in rows.items()
    )
