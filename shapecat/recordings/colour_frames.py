"""Read frames, each with the colour image nearest to it in time."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from statistics import median
from typing import Any, NamedTuple, TypeAlias

from shapecat.cameras.colour import ColourView, LensCamera
from shapecat.errors import RecordingError
from shapecat.geometry import IDENTITY, compose
from shapecat.recordings.calibrations import first_calibration
from shapecat.recordings.colour_streams import ColourStream
from shapecat.recordings.decoding.colour_image import colour_image
from shapecat.recordings.frames import ALL_FRAMES, FrameRange, frames
from shapecat.recordings.lens import distortion_problem
from shapecat.recordings.messages import MALFORMED, Message, MessageError, Needed, reason_of
from shapecat.recordings.pinhole import (
    camera_of_info,
    distortion_of,
    has_intrinsics,
    is_rectified,
)
from shapecat.recordings.recording import Recording
from shapecat.recordings.registration import are_equal, are_similar, is_nearly_aligned
from shapecat.recordings.sensors import is_of_realsense_recorder, same_frame
from shapecat.recordings.stamps import Clock, stamp_ns
from shapecat.recordings.streams import Stream
from shapecat.recordings.transforms.extrinsics import Extrinsics
from shapecat.types import Camera, Frame

__all__ = ["KnownImages", "frames_with_colour"]

_HELD_FRAMES = 32
"""Maximum number of frames that wait for a later colour image: half a second of two cameras."""
_KEPT_IMAGES = 64
"""Maximum number of colour images kept for later frames. A frame may be logged a second after its
image, and cameras give up to 60 images per second."""
_BUFFERED_BYTES = 96 << 20
"""Maximum total size of the kept images, bytes; two images are kept in any case."""
_STAMP_BYTES = 12
"""Bytes of a ROS message up to the end of its stamp. Calibrations are compared without these."""
_PATIENCE_NS = 500_000_000
"""Maximum log time that a frame waits for a colour image, nanoseconds."""
_REACH = 0.6
"""Maximum time between a frame and its image, in periods of the images: more than half, since
frames may fall midway between images that are not exactly a period apart."""
_USUAL_PERIOD_NS = 100_000_000
"""Period assumed for a colour stream if it has too few messages to measure one, nanoseconds."""
KnownImages: TypeAlias = Callable[[str, int], int | None] | None
"""A function that returns the log time (ns) of a frame's colour image, or None if it has no image,
given the frame's topic and number; None if the images are not known."""


def frames_with_colour(
    recording: Recording,
    streams: Sequence[Stream],
    colours: Mapping[str, ColourStream],
    frame_range: FrameRange = ALL_FRAMES,
    *,
    skipped: Counter[str] | None = None,
    needed: Needed = None,
    same_images: KnownImages = None,
) -> Iterator[tuple[Frame, ColourView | None]]:
    """Read frames as `shapecat.recordings.frames` does, each with its colour image.

    Parameters
    ----------
    colours : the colour stream of each depth topic that has one.
    frame_range, skipped : as for `frames`.
    needed : as for `frames`; also called for colour images.
    same_images : returns the log time of the image to use for a frame, see `KnownImages`; None to
        use the images nearest in time.

    Yields
    ------
    Each frame with its colour image: the one that ``same_images`` names or, without it, the one
    with the nearest stamp, at most 0.6 periods of the colour stream away. None replaces an image
    that is missing, unreadable, or without a calibration or a transform. Unless ``needed`` is
    given, a warning counts the frames without an image.
    """
    partners = {
        stream.topic: _Partner(recording, stream, colours[stream.topic], same_images)
        for stream in streams
        if stream.topic in colours
    }
    waiting: deque[Frame] = deque()
    found = frames(
        recording,
        streams,
        frame_range,
        skipped=skipped,
        callbacks=_callbacks(partners),
        needed=needed,
    )
    for frame in found:
        waiting.append(frame)
        if frame.topic in partners:
            partners[frame.topic].notice(frame)
        while waiting and _decided(waiting, partners):
            yield _paired(waiting.popleft(), partners)
    while waiting:
        yield _paired(waiting.popleft(), partners)
    for partner in partners.values() if needed is None else ():
        partner.report()


def _callbacks(partners: Mapping[str, "_Partner"]) -> dict[str, Any]:
    """Return a callback for each colour topic and its calibration topic."""
    listeners: dict[str, list[Any]] = {}
    for partner in partners.values():
        listeners.setdefault(partner.stream.topic, []).append(partner.take)
        if partner.stream.info_topic:
            listeners.setdefault(partner.stream.info_topic, []).append(partner.calibrate)

    def tell(message: Message) -> None:
        for listener in listeners[message.topic]:
            listener(message)

    return dict.fromkeys(listeners, tell)


def _decided(waiting: Sequence[Frame], partners: Mapping[str, "_Partner"]) -> bool:
    """Return whether the first waiting frame need not wait longer for its colour image."""
    first, last = waiting[0], waiting[-1]
    partner = partners.get(first.topic)
    return (
        partner is None
        or partner.has_read_image_of(first)
        or len(waiting) > _HELD_FRAMES
        or last.log_time_ns - first.log_time_ns > _PATIENCE_NS
    )


def _paired(frame: Frame, partners: Mapping[str, "_Partner"]) -> tuple[Frame, ColourView | None]:
    partner = partners.get(frame.topic)
    return frame, None if partner is None else partner.view(frame)


class _BufferedImage(NamedTuple):
    """A decoded image message, its size, and how often the clock had been set back before it."""

    stamp_ns: int
    log_time_ns: int
    decoded: Any
    bytes: int
    setbacks: int


class _Partner:
    """Keeps the latest colour images for one depth stream, and chooses one for each frame."""

    def __init__(
        self, recording: Recording, depth: Stream, colour: ColourStream, known: KnownImages
    ) -> None:
        self.stream = colour
        self._same_images = known
        self._recording = recording
        self._clock = Clock(recording, colour.topic)
        self._images: deque[_BufferedImage] = deque()
        self._setbacks, self._latest = 0, 0
        self._calibration = b""
        self._lens: LensCamera | None = None
        self._steps: deque[int] = deque(maxlen=9)
        self._newest: int | None = None
        self._extrinsics = Extrinsics(recording, depth, colour)
        self._without: Counter[str] = Counter()
        self._unreadable: Counter[str] = Counter()

    def take(self, message: Message) -> None:
        """Decode a colour image and keep it for later frames; count it if it is unreadable."""
        if message.type != self.stream.type:
            return
        try:
            image = self._recording.decode(message)
            size = len(image.data)
            stamp = self._clock.check(stamp_ns(image.header), message.log_time_ns)
        except (RecordingError, *MALFORMED) as error:
            self._unreadable[reason_of(error, self.stream.topic)] += 1
            return
        if self._newest is not None and stamp > self._newest:
            self._steps.append(stamp - self._newest)
        self._setbacks += stamp < (self._newest or 0)
        self._newest = stamp
        self._images.append(_BufferedImage(stamp, message.log_time_ns, image, size, self._setbacks))
        while len(self._images) > _KEPT_IMAGES or self._too_much():
            self._images.popleft()

    def calibrate(self, message: Message) -> None:
        """Update the lens if the calibration has changed and is usable; count it if unreadable."""
        content = bytes(message.data[_STAMP_BYTES:])
        if content == self._calibration:
            return
        try:
            info = self._recording.decode(message)
            if has_intrinsics(info) or self._first_lens is None:  # else there is a better one
                self._lens = _lens_of(info, self.stream.topic)
                self._calibration = content
        except (RecordingError, *MALFORMED) as error:
            self._unreadable[f"CameraInfo: {reason_of(error, self.stream.topic)}"] += 1

    def notice(self, frame: Frame) -> None:
        """Take note of a new frame, to detect that the clock was set back before it."""
        if frame.stamp_ns < self._latest:
            self._setbacks, self._newest = self._setbacks + 1, None
        self._latest = frame.stamp_ns

    def has_read_image_of(self, frame: Frame) -> bool:
        """Return whether the image of a frame, if it has one, has been read.

        Once an image with the same or a later stamp has been read, no later image can be nearer.
        """
        if self._same_images is not None:
            return self._same_images(frame.topic, frame.index) is None or bool(
                self._candidates(frame)
            )
        return self._newest is not None and self._newest >= frame.stamp_ns

    def _candidates(self, frame: Frame) -> list[_BufferedImage]:
        """Return the images that may belong to a frame."""
        if self._same_images is not None:
            logged = self._same_images(frame.topic, frame.index)
            return [one for one in self._images if one.log_time_ns == logged]
        reach = _REACH * self._period()
        close = [one for one in self._images if abs(one.stamp_ns - frame.stamp_ns) <= reach]
        # After the clock was set back, stamps repeat: leave out images from before.
        closest = min(close, key=lambda one: abs(one.log_time_ns - frame.log_time_ns), default=None)
        return [one for one in close if closest is None or one.setbacks == closest.setbacks]

    def view(self, frame: Frame) -> ColourView | None:
        """Return a frame's colour image; if none is usable, count the reason and return None."""
        candidates = self._candidates(frame)
        nearest = min(candidates, key=lambda one: abs(one.stamp_ns - frame.stamp_ns), default=None)
        if nearest is None:
            self._without["no colour image near the time of the frame"] += 1
            self._clock.compare(frame.topic, frame.stamp_ns, frame.log_time_ns)
            return None
        try:
            return self._view(frame, nearest)
        except (RecordingError, *MALFORMED) as error:
            self._without[reason_of(error, self.stream.topic)] += 1
            return None

    def report(self) -> None:
        """Add warnings: unusable stamps, and each reason why messages or frames were left out."""
        self._clock.report(colour=True)
        counts = {"unreadable messages": self._unreadable, "frames without colour": self._without}
        for what, reasons in counts.items():
            for reason, count in reasons.items():
                self._recording.warn(f"{self.stream.topic}: {what} ({count}×): {reason}")

    def _too_much(self) -> bool:
        """Return whether the kept images take too much memory."""
        stored_bytes = sum(image.bytes for image in self._images)
        return stored_bytes > _BUFFERED_BYTES and len(self._images) > 2

    def _period(self) -> int:
        """Return the time between two images, nanoseconds."""
        if self._steps:
            return int(median(self._steps))
        count, span = self.stream.count, self._recording.end_ns - self._recording.start_ns
        return span // (count - 1) if count > 1 and span > 0 else _USUAL_PERIOD_NS

    def _view(self, frame: Frame, stored: _BufferedImage) -> ColourView:
        image = colour_image(self.stream.kind, self.stream.topic, *stored[:3])
        shape = (image.height, image.width)
        if self.stream.kind == "cloud":
            return ColourView(image, _lens(frame.camera))
        if frame.depth is None:
            self._recording.warn(
                f"{frame.topic}: no masks on colour images, since its points are not an image"
            )
        same_shape = frame.depth is not None and frame.depth.shape == shape
        lens = self._first_lens if self._lens is None else self._lens
        if lens is not None and (lens.pinhole.height, lens.pinhole.width) != shape:
            size = f"{lens.pinhole.width} x {lens.pinhole.height}"
            msg = f"image of {shape[1]} x {shape[0]} pixels with CameraInfo for {size}"
            raise MessageError(msg)
        named = not is_of_realsense_recorder(self.stream.topic)
        one_frame = named and same_frame(image.frame_id, frame.frame_id)
        aligned = lens is None or is_nearly_aligned(lens, frame.camera)
        alike = lens is None or (aligned and are_similar(lens, frame.camera))
        if same_shape and one_frame and alike:
            return ColourView(image, lens or _lens(frame.camera))
        if lens is None:
            msg = "colour images without a sensor_msgs/CameraInfo"
            raise MessageError(msg)
        pose = self._extrinsics.colour_from_depth(
            frame.frame_id, image.frame_id, frame.log_time_ns, frame.stamp_ns
        )
        if pose is not None:
            offset = frame.frame_from_sensor
            return ColourView(image, lens, pose if offset is None else compose(pose, offset))
        names = (name or "a frame without a name" for name in (frame.frame_id, image.frame_id))
        problem = f"no transform between {' and '.join(names)}"
        # Registered images have the intrinsics of the depth camera; so may simulated cameras.
        if same_shape and are_equal(lens, frame.camera):
            if not same_frame(frame.frame_id, image.frame_id):
                guess = "its images count as registered, for their intrinsics"
                self._recording.warn(f"{image.topic}: {problem}; {guess}")
            return ColourView(image, lens, None if aligned else IDENTITY)
        raise MessageError(problem)

    @cached_property
    def _first_lens(self) -> LensCamera | None:
        """The lens of the first calibration with intrinsics; None if there is no usable one.

        It serves images that precede all calibrations.
        """
        topic = self.stream.info_topic
        info = None if topic is None else first_calibration(self._recording, topic)
        with suppress(RecordingError, *MALFORMED):
            return None if info is None else _lens_of(info, self.stream.topic)
        return None


def _lens(camera: Camera | None) -> LensCamera | None:
    return None if camera is None else LensCamera(camera)


def _lens_of(info: Any, topic: str) -> LensCamera:
    camera, distorted = camera_of_info(info, rectified=is_rectified(topic))
    if not distorted:
        return LensCamera(camera)
    model, coefficients = str(info.distortion_model), distortion_of(info)
    if problem := distortion_problem(model, coefficients):
        raise MessageError(problem)
    return LensCamera(camera, model, coefficients)
