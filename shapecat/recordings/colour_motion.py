"""Correct the pose of a colour camera that moved between a depth image and its colour image."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from shapecat.cameras.colour import ColourView, LensCamera
from shapecat.geometry import IDENTITY, compose, inverse
from shapecat.recordings.sensors import same_frame
from shapecat.recordings.transforms.buffer import TransformBuffer, TransformError
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.types import Frame, Pose

__all__ = ["view_at_its_time"]

_LEAST_PX = 0.5
"""Smaller motions are ignored, since the measured pose of a camera varies even at rest."""
_NEAR_M = 1.0
"""Distance from the camera, metres, at which a motion is expressed in pixels."""


def view_at_its_time(
    view: ColourView | None,
    frame: Frame,
    fixed_from_sensor: Pose | None,
    fixed_frame: str | None,
    transforms: Callable[[], TransformWindow],
) -> ColourView | None:
    """Return a colour view with the pose that its camera had when it took the image.

    The pose of the depth sensor in the frame of the colour camera becomes
    ``inverse(fixed_from_colour(colour stamp)) * fixed_from_depth(depth stamp)``. A registered
    image becomes that of a camera with the intrinsics of the depth camera. The view is returned
    unchanged if the stamps are equal, the camera hardly moved, or its motion is unknown.
    Transforms are read as the recording goes on, so views must come in the order of their frames.

    Parameters
    ----------
    view : the colour view with the pose of the colour camera at the time of the depth image, or
        None.
    fixed_from_sensor : pose of the sensor in the fixed frame; None if unknown.
    fixed_frame : name of that frame; None if there is none.
    transforms : returns the transforms; called only if they are needed.
    """
    if view is None or fixed_from_sensor is None or fixed_frame is None:
        return view
    start_ns, end_ns = frame.stamp_ns, view.image.stamp_ns
    lens = view.lens
    if view.registered:
        lens = None if frame.camera is None else LensCamera(frame.camera)
    if start_ns == end_ns or lens is None:
        return view
    buffer = transforms().around(frame.log_time_ns, start_ns)
    pose = view.colour_from_depth or IDENTITY
    with suppress(TransformError):
        if not view.registered and _is_placed(buffer, view.image.frame_id, frame.frame_id):
            motion = _motion(buffer, fixed_frame, view.image.frame_id, start_ns, end_ns)
            moved = compose(motion, pose)
        else:
            # The two cameras are assumed rigid.
            motion = _sensor_motion(buffer, fixed_frame, frame, fixed_from_sensor, end_ns)
            moved = compose(pose, motion)
        if _pixels(motion, lens.pinhole.fx) >= _LEAST_PX:
            return replace(view, lens=lens, colour_from_depth=moved)
    return view


def _motion(
    buffer: TransformBuffer, fixed_frame: str, frame_id: str, start_ns: int, end_ns: int
) -> Pose:
    """Return the pose of the frame ``frame_id`` at ``start_ns`` relative to itself at ``end_ns``.

    Raises
    ------
    TransformError : the pose of the frame in the fixed frame is unknown at one of these stamps.
    """
    start, end = (buffer.lookup(fixed_frame, frame_id, ns) for ns in (start_ns, end_ns))
    return compose(inverse(end), start)


def _sensor_motion(
    buffer: TransformBuffer, fixed_frame: str, frame: Frame, fixed_from_sensor: Pose, end_ns: int
) -> Pose:
    """Return the motion of the depth sensor from the stamp of its frame to ``end_ns``.

    The result is as in `_motion`, but in the axes of the data, which may differ from those of the
    frame that the message names.
    """
    named_from_sensor = compose(
        inverse(buffer.lookup(fixed_frame, frame.frame_id, frame.stamp_ns)), fixed_from_sensor
    )
    motion = _motion(buffer, fixed_frame, frame.frame_id, frame.stamp_ns, end_ns)
    return compose(inverse(named_from_sensor), compose(motion, named_from_sensor))


def _is_placed(buffer: TransformBuffer, colour_frame: str, depth_frame: str) -> bool:
    """Return whether the colour camera has a frame of its own in the transforms."""
    known = colour_frame.lstrip("/") in buffer.frames
    return known and not same_frame(colour_frame, depth_frame)


def _pixels(motion: Pose, focal_px: float) -> float:
    """Return how far, approximately, a motion of the camera moves its image, pixels."""
    angle = np.linalg.norm(motion.rotation - np.eye(3)) / np.sqrt(2)  # for small angles
    return float(focal_px * (angle + np.linalg.norm(motion.translation) / _NEAR_M))
