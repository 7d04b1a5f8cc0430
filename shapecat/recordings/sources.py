"""Convert the messages of a depth stream to frames."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from shapecat.arrays import F4
from shapecat.errors import RecordingError
from shapecat.geometry import transform
from shapecat.recordings.calibrations import first_calibration
from shapecat.recordings.decoding.compressed_depth import depth_of_compressed
from shapecat.recordings.decoding.depth_image import depth_of_image
from shapecat.recordings.decoding.foxglove import ros_counterpart
from shapecat.recordings.decoding.pointcloud2 import cloud_points, organized, unorganized
from shapecat.recordings.lens import lens_content
from shapecat.recordings.messages import MALFORMED, Message, MessageError, reason_of
from shapecat.recordings.pinhole import (
    PinholeFit,
    camera_of_info,
    fit_pinhole,
    has_intrinsics,
    is_rectified,
    off_center,
    still_fits,
)
from shapecat.recordings.recording import Recording
from shapecat.recordings.stamps import Clock, stamp_ns
from shapecat.recordings.streams import COMPRESSED, Stream, first_message
from shapecat.recordings.viewpoint import find_viewpoint, seen_from
from shapecat.types import Frame, Pose

__all__ = ["SOURCES", "DepthSource", "FrameSource", "PointsSource"]


class FrameSource:
    """Converts the messages of a depth stream to frames, one after the other."""

    def __init__(self, recording: Recording, stream: Stream, skipped: Counter[str]) -> None:
        """Start without messages; ``skipped`` will count unreadable messages by reason."""
        self.recording = recording
        self.stream = stream
        self.skipped = skipped
        self.clock = Clock(recording, stream.topic)

    def read(self, message: Message, index: int) -> Iterator[Frame]:
        """Yield the frames that message ``index`` completes: its own, the previous one, or both."""
        raise NotImplementedError

    def finish(self) -> Iterator[Frame]:
        """Yield the frame that is still held back, if any."""
        yield from ()

    @contextmanager
    def counting(self) -> Iterator[None]:
        """If the message read in the block is unreadable, count it by reason instead of raising."""
        try:
            yield
        except (MessageError, *MALFORMED) as error:
            self.skipped[reason_of(error, self.stream.topic)] += 1

    def frame(self, message: Message, index: int, header: Any, content: dict[str, Any]) -> Frame:
        """Return a frame with the given ``content``: depth and camera, or points.

        Raises
        ------
        MessageError : the stamp or the log time is not within 0 to 2**63 - 1 ns.
        """
        if not 0 <= message.log_time_ns < 2**63:
            msg = "log time out of range"
            raise MessageError(msg)
        return Frame(
            topic=self.stream.topic,
            index=index,
            stamp_ns=self.clock.check(stamp_ns(header), message.log_time_ns),
            log_time_ns=message.log_time_ns,
            frame_id=str(header.frame_id),
            **content,
        )


class PointsSource(FrameSource):
    """A stream of clouds; organized ones become depth images if a pinhole camera fits."""

    def __init__(self, recording: Recording, stream: Stream, skipped: Counter[str]) -> None:
        """Start without a camera."""
        super().__init__(recording, stream, skipped)
        self.fit: PinholeFit | None = None
        self.pose: Pose | None = None

    def read(self, message: Message, index: int) -> Iterator[Frame]:
        """Yield the frame of a cloud, unless it is unreadable."""
        with self.counting():
            cloud = self.recording.decode(message)
            points = _placed(cloud_points(cloud), getattr(cloud, "pose", None))
            yield self.frame(message, index, cloud.header, self._content(points))

    def _content(self, points: F4) -> dict[str, Any]:
        if points.size == 0:
            msg = "empty cloud"
            raise MessageError(msg)
        content = self._depth_image(points) if min(points.shape[:2]) > 1 else None
        return unorganized(points) if content is None else content

    def _depth_image(self, points: F4) -> dict[str, Any] | None:
        """Return `Frame` fields of an organized cloud: depth, camera, pose; None if no camera fits.

        The camera of earlier frames is kept if it still fits.
        """
        image = points if self.pose is None else seen_from(self.pose, points)
        if self.fit is None or not still_fits(self.fit, image):
            fit = fit_pinhole(points)
            viewpoint = find_viewpoint(points, self.fit) if fit is None else (fit, None, points)
            if viewpoint is None:
                return None
            self.fit, self.pose, image = viewpoint
        return {**organized(image, self.fit.camera), "frame_from_sensor": self.pose}


def _placed(points: F4, pose: Pose | None) -> F4:
    """Transform a cloud (h, w, 3) by its own pose, if any, to the frame of its ``frame_id``."""
    return points if pose is None else transform(pose, points).astype(np.float32)


class DepthSource(FrameSource):
    """A stream of depth images. Each image waits for the calibration with the same stamp."""

    def __init__(self, recording: Recording, stream: Stream, skipped: Counter[str]) -> None:
        """Start without a calibration."""
        super().__init__(recording, stream, skipped)
        self.info_topic = stream.info_topic or ""
        self.rectified = is_rectified(stream.topic)
        self.units = _depth_units(recording, stream.topic)
        self._waiting: tuple[Message, int, Any, int] | None = None  # the last is the stamp, ns
        self._info: Any = None
        self._info_stamp: int | None = None

    def calibrate(self, message: Message) -> Iterator[Frame]:
        """Store a calibration; yield the frame of the image that waited for it, if any.

        One without intrinsics does not replace an earlier one; an unreadable one causes a warning.
        """
        try:
            info = self.recording.decode(message)
            stamp = stamp_ns(info.header)
            if not has_intrinsics(info):
                info = self._info
        except (RecordingError, *MALFORMED) as error:
            reason = reason_of(error, message.topic)
            self.recording.warn(f"skipped a CameraInfo: {message.topic}: {reason}")
            return
        if self._waiting is None:
            self._info, self._info_stamp = info, stamp
            return
        *_, image_ns = self._waiting
        # A later calibration means that the image's own is missing: use the last one before it.
        if stamp <= image_ns or self._info is None:
            self._info, self._info_stamp = info, stamp
        if stamp >= image_ns:
            yield from self.finish()
            self._info, self._info_stamp = info, stamp

    def read(self, message: Message, index: int) -> Iterator[Frame]:
        """Yield the frame of the image held back, if any; then that of this image.

        If the calibration with its stamp has not been read yet, this image is held back instead.
        """
        yield from self.finish()
        with self.counting():
            image = self.recording.decode(message)
            image_ns = stamp_ns(image.header)
            self._waiting = (message, index, image, image_ns)
            if image_ns == self._info_stamp:
                yield from self.finish()

    def finish(self) -> Iterator[Frame]:
        """Yield the frame of the image that is held back, with the best calibration so far."""
        if self._waiting is None:
            return
        (message, index, image, _), self._waiting = self._waiting, None
        with self.counting():
            yield self.frame(message, index, image.header, self._content(image))

    def _warn(self, text: str) -> None:
        self.recording.warn(f"{self.stream.topic}: {text}")

    @cached_property
    def _first_info(self) -> Any:
        """The first calibration in the recording, for images before it; None if there is none."""
        return first_calibration(self.recording, self.info_topic)

    def _content(self, image: Any) -> dict[str, Any]:
        if self._info is None:
            self._info = self._first_info
        if self._info is None:
            msg = "depth image without CameraInfo"
            raise MessageError(msg)
        camera, distorted = camera_of_info(self._info, rectified=self.rectified)
        compressed = ros_counterpart(self.stream.type) == COMPRESSED
        depth = depth_of_compressed(image) if compressed else depth_of_image(image, self.units)
        if camera.width == camera.height == 0:  # some drivers leave out the size
            camera = replace(camera, height=depth.shape[0], width=depth.shape[1])
        if depth.shape != (camera.height, camera.width):
            shape = f"{depth.shape[1]} x {depth.shape[0]}"
            size = f"{camera.width} x {camera.height}"
            # The report puts a count before this: "3 with depth of ...".
            msg = f"with depth of {shape} but CameraInfo for {size} on {self.info_topic}"
            raise MessageError(msg)
        if off_center(camera) and not self._info.roi.width:
            self.recording.warn(
                f"{self.info_topic}: the principal point ({camera.cx:.0f}, {camera.cy:.0f}) is far "
                f"from the center of images of {camera.width} x {camera.height}: are these the "
                "intrinsics for a different resolution?"
            )
        if distorted:
            return lens_content(self._info, camera, depth, self._warn)
        return {"depth": depth, "camera": camera}


def _depth_units(recording: Recording, topic: str) -> float | None:
    """Return the depth units per metre in a recording of the RealSense viewer; None otherwise."""
    sensor = "/".join(topic.split("/")[:3])
    for candidate in recording.topics:
        name = candidate.name.replace(" ", "_")
        if name.startswith(f"{sensor}/") and name.endswith("/option/Depth_Units/value"):
            with suppress(*MALFORMED):
                metres = float(first_message(recording, candidate.name).data)
                return 1 / metres if 1e-6 < metres < 1 else None
    return None


SOURCES: dict[str, type[FrameSource]] = {
    "points": PointsSource,
    "depth": DepthSource,
}
"""The source for each kind of stream."""
