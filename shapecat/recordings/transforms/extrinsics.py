"""Look up the pose of the depth sensor in the frame of the colour camera."""

from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np

from shapecat.errors import RecordingError
from shapecat.geometry import IDENTITY, compose, inverse, rotation_from_quaternion
from shapecat.recordings.colour_streams import ColourStream
from shapecat.recordings.messages import MALFORMED
from shapecat.recordings.recording import Recording
from shapecat.recordings.sensors import is_of_realsense_recorder, same_frame
from shapecat.recordings.streams import Stream, first_message
from shapecat.recordings.transforms.buffer import (
    ExtrapolationError,
    GapError,
    TransformBuffer,
    TransformError,
)
from shapecat.recordings.transforms.reading import read_transforms
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.types import Pose

__all__ = ["Extrinsics"]

_DRIVER = "/extrinsics/depth_to_color"
"""End of the topic on which the ROS driver of RealSense cameras publishes ``colour_from_depth``."""


class Extrinsics:
    """Looks up the transform from a depth sensor to a colour camera.

    Sources are, in this order: static transforms, all transforms, and librealsense's own messages
    (``extrinsics/depth_to_color`` of its ROS driver, ``tf/N`` of its recorder). Cameras with equal
    frame ids coincide, except in recordings of that recorder, where only its messages count.
    """

    def __init__(self, recording: Recording, depth: Stream, colour: ColourStream) -> None:
        """Store the streams; transforms are read on first use."""
        self._recording = recording
        self._depth, self._colour = depth, colour

    @cached_property
    def _still(self) -> TransformBuffer:
        return read_transforms(self._recording, static_only=True, sensor_topics=[self._depth.topic])

    @cached_property
    def _moving(self) -> TransformWindow:
        return TransformWindow.of(self._recording, [self._depth.topic])

    def colour_from_depth(
        self, depth_frame: str, colour_frame: str, log_time_ns: int, stamp_ns: int
    ) -> Pose | None:
        """Return the pose ``colour_from_depth`` at the time of a depth image; None if unknown.

        Depth images must come in the order of the recording, as only a little of the past is kept.

        Parameters
        ----------
        depth_frame, colour_frame : frame ids of the messages.
        log_time_ns, stamp_ns : of the depth image, nanoseconds.
        """
        if is_of_realsense_recorder(self._depth.topic):
            return self._realsense
        if same_frame(depth_frame, colour_frame):
            return IDENTITY if depth_frame else self._realsense  # both frame ids may be empty
        pose = self._lookup(self._still, depth_frame, colour_frame, stamp_ns)
        if pose is None:
            moving = self._moving.around(log_time_ns, stamp_ns)
            pose = self._lookup(moving, depth_frame, colour_frame, stamp_ns)
        return self._realsense if pose is None else pose

    def _lookup(
        self, buffer: TransformBuffer, depth_frame: str, colour_frame: str, stamp_ns: int
    ) -> Pose | None:
        """Return ``colour_from_depth`` from ``buffer``; None if it is missing.

        If it is known only at other times, there is a warning.
        """
        with suppress(TransformError):
            try:
                return buffer.lookup(colour_frame, depth_frame, stamp_ns)
            except (ExtrapolationError, GapError):
                self._recording.warn(
                    f"{self._colour.topic}: no transform from {depth_frame} to {colour_frame} "
                    "at the time of some frames"
                )
        return None

    @cached_property
    def _realsense(self) -> Pose | None:
        """The pose ``colour_from_depth`` in librealsense's own messages; None if there is none.

        The messages hold rotation and translation: ``p_colour = rotation @ p_depth + translation``.
        """
        for topic in self._driver_topics():
            with suppress(RecordingError, *MALFORMED):
                pose = _driver_pose(first_message(self._recording, topic))
                if pose is not None:
                    return pose
        depth, colour = (self._recorder_pose(s.topic) for s in (self._depth, self._colour))
        if depth is None or colour is None:
            return None
        return compose(colour, inverse(depth))

    def _driver_topics(self) -> list[str]:
        """Return the driver's extrinsics topics in the namespace of the depth topic, longest first.

        If there are none, return the only extrinsics topic of the recording, if there is just one.
        """
        names = {t.name for t in self._recording.topics if f"/{t.name}".endswith(_DRIVER)}
        around = [n for n in names if self._depth.topic.startswith(n.removesuffix(_DRIVER[1:]))]
        return sorted(around, key=len, reverse=True) or (list(names) if len(names) == 1 else [])

    def _recorder_pose(self, image: str) -> Pose | None:
        """Return ``stream_from_reference`` of an image topic from librealsense; None if absent."""
        prefix = f"{image.rpartition('/image')[0]}/tf/"
        for topic in self._recording.topics:
            if topic.name.startswith(prefix) and len(prefix) > 4:
                with suppress(RecordingError, *MALFORMED):
                    message = first_message(self._recording, topic.name)
                    move, turn = message.translation, message.rotation
                    rotation = rotation_from_quaternion((turn.x, turn.y, turn.z, turn.w))
                    return Pose(rotation, np.array([move.x, move.y, move.z]))
        return None


def _driver_pose(message: Any) -> Pose | None:
    rotation = np.asarray(message.rotation, np.float64).reshape(3, 3).T  # stored by columns
    translation = np.asarray(message.translation, np.float64)
    good = (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.isfinite(translation).all()
    )
    return Pose(rotation, translation) if good else None
