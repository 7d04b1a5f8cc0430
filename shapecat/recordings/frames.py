"""The readings of a depth sensor, frame by frame."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from shapecat.arrays import F4
from shapecat.recordings.compressed_depth import depth_of_compressed
from shapecat.recordings.depth_image import depth_of_image
from shapecat.recordings.messages import Message, MessageError
from shapecat.recordings.pinhole import PinholeFit, camera_of_info, fit_pinhole, still_fits
from shapecat.recordings.pointcloud2 import cloud_points
from shapecat.recordings.recording import Recording
from shapecat.recordings.stamps import Clock, stamp_ns
from shapecat.recordings.streams import COMPRESSED, Stream
from shapecat.recordings.undistortion import points_along, undistorted_rays
from shapecat.types import Camera, Frame

__all__ = ["frames"]


def frames(
    recording: Recording,
    streams: Sequence[Stream],
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    every: int = 1,
    skipped: Counter[str],
) -> Iterator[Frame]:
    """Read the frames of some streams in flat memory.

    An organized cloud that a pinhole camera explains becomes the depth image it was made from, so
    that both forms of one reading give the same frame.

    Parameters
    ----------
    start_s, end_s : seconds of log time from the start of the recording.
    every : keep each so-many-th frame of a stream.
    skipped : frames that cannot be read are counted here by reason; they never raise.

    Yields
    ------
    Frames by log time. ``index`` counts the messages of the stream from ``start_s`` on.

    Raises
    ------
    ValueError : ``every`` is not positive.
    """
    if every < 1:
        msg = f"every must be at least 1, got {every}"
        raise ValueError(msg)
    sources: dict[str, _Source] = {
        stream.topic: _SOURCES[stream.kind](recording, stream) for stream in streams
    }
    infos: dict[str, list[_Depth]] = {}
    for source in sources.values():
        if isinstance(source, _Depth):
            infos.setdefault(source.info_topic, []).append(source)
    limits = [None if s is None else recording.start_ns + round(s * 1e9) for s in (start_s, end_s)]
    for message in recording.messages({*sources, *infos}, *limits):
        for depth in infos.get(message.topic, ()):
            yield from depth.calibrate(message, skipped)
        chosen = sources.get(message.topic)
        if chosen is not None and message.type == chosen.stream.type:
            chosen.index += 1
            if (chosen.index - 1) % every == 0:
                yield from chosen.read(message, skipped)
    for source in sources.values():
        yield from source.finish(skipped)
        source.clock.report(recording)


class _Source:
    """One stream being read."""

    def __init__(self, recording: Recording, stream: Stream) -> None:
        self.recording = recording
        self.stream = stream
        self.index = 0
        self.clock = Clock(stream.topic)

    def read(self, message: Message, skipped: Counter[str]) -> Iterator[Frame]:
        """Yield the frame of a message, or a frame held back before it, or none."""
        raise NotImplementedError

    def finish(self, _skipped: Counter[str]) -> Iterator[Frame]:
        """Yield what was held back."""
        yield from ()

    def frame(self, message: Message, index: int, header: Any, **content: Any) -> Frame:
        """Make a frame."""
        return Frame(
            topic=self.stream.topic,
            index=index,
            stamp_ns=self.clock.check(stamp_ns(header), message.log_time_ns),
            log_time_ns=message.log_time_ns,
            frame_id=str(header.frame_id),
            **content,
        )


class _Points(_Source):
    """A stream of clouds; organized ones become depth images where a camera explains them."""

    def __init__(self, recording: Recording, stream: Stream) -> None:
        super().__init__(recording, stream)
        self.fit: PinholeFit | None = None

    def read(self, message: Message, skipped: Counter[str]) -> Iterator[Frame]:
        try:
            cloud = self.recording.decode(message)
            points = cloud_points(cloud)
        except MessageError as error:
            skipped[_reason(error)] += 1
            return
        if points.size == 0:
            skipped["empty cloud"] += 1
            return
        camera = self._camera(points) if min(points.shape[:2]) > 1 else None
        content = unorganized(points) if camera is None else organized(points, camera)
        yield self.frame(message, self.index - 1, cloud.header, **content)

    def _camera(self, points: F4) -> Camera | None:
        """Keep the camera of earlier frames while it explains the points as well as then."""
        if self.fit is None or not still_fits(self.fit, points):
            self.fit = fit_pinhole(points) or self.fit
            if self.fit is not None and not still_fits(self.fit, points):
                return None
        return self.fit.camera if self.fit is not None else None


class _Depth(_Source):
    """A stream of depth images, each waiting for the calibration of its own time."""

    def __init__(self, recording: Recording, stream: Stream) -> None:
        super().__init__(recording, stream)
        self.info_topic = stream.info_topic or ""
        self.rectified = "rect" in stream.topic.rsplit("/", 1)[-1]
        self.waiting: tuple[Message, int, Any] | None = None
        self.info: Any = None
        self.lens = _Lens()

    def calibrate(self, message: Message, skipped: Counter[str]) -> Iterator[Frame]:
        """Take a calibration; yield the image that waited for it."""
        try:
            info = self.recording.decode(message)
        except MessageError as error:
            skipped[_reason(error)] += 1
            return
        if self.waiting is None:
            self.info = info
            return
        wanted = stamp_ns(self.waiting[2].header)
        # A later calibration means that the image's own is missing: the last one has to do.
        if stamp_ns(info.header) <= wanted or self.info is None:
            self.info = info
        if stamp_ns(info.header) >= wanted:
            yield from self.finish(skipped)
            self.info = info

    def read(self, message: Message, skipped: Counter[str]) -> Iterator[Frame]:
        yield from self.finish(skipped)
        try:
            image = self.recording.decode(message)
        except MessageError as error:
            skipped[_reason(error)] += 1
            return
        self.waiting = (message, self.index - 1, image)
        if self.info is not None and stamp_ns(self.info.header) == stamp_ns(image.header):
            yield from self.finish(skipped)

    def finish(self, skipped: Counter[str]) -> Iterator[Frame]:
        if self.waiting is None:
            return
        (message, index, image), self.waiting = self.waiting, None
        if self.info is None:
            self.info = _first_info(self.recording, self.info_topic)
        if self.info is None:
            skipped["depth image without camera info"] += 1
            return
        try:
            read = depth_of_compressed if self.stream.type == COMPRESSED else depth_of_image
            content = self._content(read(image))
        except MessageError as error:
            skipped[_reason(error)] += 1
            return
        yield self.frame(message, index, image.header, **content)

    def _content(self, depth: F4) -> dict[str, Any]:
        camera, distorted = camera_of_info(self.info, rectified=self.rectified)
        if depth.shape != (camera.height, camera.width):
            shape = f"{depth.shape[1]} x {depth.shape[0]}"
            msg = f"depth image of {shape} with camera info for {camera.width} x {camera.height}"
            raise MessageError(msg)
        if not distorted:
            return {"depth": depth, "camera": camera}
        return self.lens.content(self.recording, self.stream.topic, self.info, camera, depth)


def _first_info(recording: Recording, topic: str) -> Any:
    """Return the first calibration of the recording, which may lie before the chosen window."""
    for message in recording.messages([topic]):
        with suppress(MessageError):
            return recording.decode(message)
    return None


class _Lens:
    """Images that were not rectified: their pixels see bent rays."""

    def __init__(self) -> None:
        self.key: Any = None
        self.rays: Any = None
        self.fit: PinholeFit | None = None

    def content(
        self, recording: Recording, topic: str, info: Any, camera: Camera, depth: F4
    ) -> dict[str, Any]:
        """Give the depth image with the pinhole nearest to the lens, or points where none is."""
        model = str(info.distortion_model)
        coefficients = tuple(float(c) for c in getattr(info, "d", getattr(info, "D", ())))
        if (key := (camera, model, coefficients)) != self.key:
            self.key, self.fit = key, None
            self.rays = undistorted_rays(camera, model, coefficients)
            if self.rays is None:
                recording.warn(f"{topic}: lens distortion {model!r} is not known and left as it is")
            else:
                self.fit = fit_pinhole(points_along(self.rays, np.ones(depth.shape, np.float32)))
        if self.rays is None:
            return {"depth": depth, "camera": camera}
        if self.fit is not None:
            return {"depth": depth, "camera": self.fit.camera}
        recording.warn(f"{topic}: not rectified: read as points along the undistorted rays")
        return unorganized(points_along(self.rays, depth))


_SOURCES = {"points": _Points, "depth": _Depth}


def organized(points: F4, camera: Camera) -> dict[str, Any]:
    """Return depth and camera of an organized cloud (h, w, 3)."""
    x, y, z = (points[..., k] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        valid = np.isfinite(x + y + z) & (z > 0)
    return {"depth": np.where(valid, z, np.float32(0)), "camera": camera}


def unorganized(points: F4) -> dict[str, Any]:
    """Return the points of a cloud (h, w, 3) row by row, NaN where there is no reading.

    Drivers mark missing readings by NaN, by infinity, or by the sensor's own position.
    """
    flat = np.array(points.reshape(-1, 3), np.float32)
    valid = np.isfinite(flat).all(1) & flat.any(1)
    flat[~valid] = np.nan
    return {"points": flat}


def _reason(error: MessageError) -> str:
    """Return a reason without numbers that differ from frame to frame."""
    return str(error).split(": ", 1)[-1][:160]
