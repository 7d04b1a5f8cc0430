"""Find the colour streams of a recording, and the one that belongs to a depth stream."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from heapq import nlargest
from pathlib import PurePosixPath
from typing import Any, Literal, NamedTuple

from shapecat.errors import NoStreamError, listed
from shapecat.recordings.decoding.colour_image import COLOUR_ENCODINGS, compressed_kind
from shapecat.recordings.decoding.compressed_depth import is_grey_png16
from shapecat.recordings.decoding.depth_image import DEPTH_ENCODINGS
from shapecat.recordings.decoding.foxglove import ros_counterpart
from shapecat.recordings.messages import MALFORMED, Topic
from shapecat.recordings.pinhole import is_rectified
from shapecat.recordings.recording import Recording
from shapecat.recordings.sensors import by_sensor, same_frame
from shapecat.recordings.streams import (
    CLOUD,
    COMPRESSED,
    IMAGE,
    Stream,
    depth_streams,
    first_messages,
    info_topic_of,
)

__all__ = ["ColourStream", "colour_streams", "pair_colours"]

_COLOUR_WORDS = ("color", "colour", "rgb")
_VIDEO = ("CompressedVideo", "Packet")
"""Endings of the message types of videos, as of FFmpeg and Theora, which cannot be read."""
_OTHER_WORDS = ("infra", "/ir/", "depth/image", "confidence", "thermal", "mask")
"""Grey images on topics with these words are not from a colour camera."""


@dataclass(frozen=True)
class ColourStream:
    """A topic of colour images, or of clouds with a packed ``rgb`` field.

    Attributes
    ----------
    info_topic : topic of the calibration; None if there is none.
    count : number of messages.
    frame_id, encoding : from the first image with colours.
    """

    topic: str
    type: str
    kind: Literal["raw", "compressed", "cloud"]
    info_topic: str | None
    count: int
    frame_id: str
    encoding: str

    @property
    def grey(self) -> bool:
        """Whether the images are grey; grey images are used only on request."""
        return self.encoding == "mono8"


def colour_streams(recording: Recording) -> tuple[ColourStream, ...]:
    """Find the colour images and coloured clouds of a recording, sorted by topic."""
    streams = (
        _probe(topic, recording)
        for topic in recording.topics
        if topic.count != 0 and ros_counterpart(topic.type) in _PROBES
    )
    return tuple(stream for stream in streams if stream is not None)


def pair_colours(
    recording: Recording, streams: Sequence[Stream], requested: str | None = None
) -> dict[str, ColourStream]:
    """Choose the colour streams of depth streams.

    A cloud with colours is its own colour stream. Colour images belong to a depth stream if they
    have the same frame. They also do if the topic names begin with the same namespace
    (``/camera/color/image_raw`` and ``/camera/depth/image_raw``), unless their topic shares more of
    its namespace with another depth sensor. If a recording has one depth sensor and one stream of
    colour images, raw or compressed or both, they belong together whatever their names, unless
    images that cannot be read belong to the sensor.

    Among several streams, the preference is, in this order: the same frame, the longest common
    namespace, a topic named after colour, rectified images, more messages, compressed images, the
    alphabetical order of topics.

    Parameters
    ----------
    requested : the colour topic to use for all depth streams; it may hold grey images or clouds.
        None to choose a topic for each depth stream, empty to use no colour.

    Returns
    -------
    The colour stream of each depth topic that has one. Its ``info_topic`` is None if it would be
    that of the depth stream. If a depth stream has no colour stream, there is a warning for each
    unreadable colour topic that belongs to it, or, if the recording has no colour stream at all,
    for every unreadable colour topic.

    Raises
    ------
    NoStreamError : the requested topic does not exist or holds no colour images.
    """
    if requested == "":
        return {}
    found = colour_streams(recording)
    if requested is not None:
        chosen = dict.fromkeys((one.topic for one in streams), _select(recording, found, requested))
    else:
        chosen = _choose(recording, streams, found)
    infos = {stream.topic: stream.info_topic for stream in streams}
    return {
        topic: replace(one, info_topic=None) if one.info_topic == infos[topic] else one
        for topic, one in chosen.items()
    }


def _choose(
    recording: Recording, streams: Sequence[Stream], found: Sequence[ColourStream]
) -> dict[str, ColourStream]:
    """Return the best colour stream in ``found`` for each depth topic that has one.

    If one has none, warn about its images and videos that cannot be read.
    """
    images = [one for one in found if one.kind != "cloud" and not one.grey]
    unread = _unread(recording, found)
    sensors = by_sensor(depth_streams(recording)) if images or unread else []
    nearest = {one.topic: _nearest_sensors(one, sensors) for one in (*images, *unread)}
    single = len({one.topic.removesuffix("/compressed") for one in images}) == 1
    chosen = {}
    for stream in streams:
        own = [one for one in found if one.kind == "cloud" and one.topic == stream.topic]
        fitting = own or [one for one in images if _belongs(one, stream, nearest[one.topic])]
        missed = [one for one in unread if _belongs(one, stream, nearest[one.topic])]
        if not fitting and single and len(sensors) == 1 and not missed:
            fitting = images
        if fitting:
            chosen[stream.topic] = min(fitting, key=partial(_rank, stream=stream))
            continue
        for one in missed if found else unread:
            recording.warn(f"{one.topic}: there is no colour, since {one.encoding} cannot be read")
    return chosen


def _unread(recording: Recording, found: Sequence[ColourStream]) -> list[ColourStream]:
    """Return the topics named after colour whose images or videos cannot be read.

    Their ``encoding`` is that of the images, or the type of the messages of a video. ``found`` are
    the streams that can be read.
    """
    unread = []
    known = {one.topic for one in found}
    for topic in recording.topics:
        named = any(word in topic.name.lower() for word in _COLOUR_WORDS)
        is_image = ros_counterpart(topic.type) in {IMAGE, COMPRESSED}
        is_video = topic.type.endswith(_VIDEO)
        if not named or not topic.count or topic.name in known or not (is_image or is_video):
            continue
        first = next(first_messages(recording, topic.name, topic.type), None)
        name = topic.type
        if is_image:
            name = str(getattr(first, "encoding", getattr(first, "format", ""))).strip()
        if name and not name.startswith(tuple(DEPTH_ENCODINGS)):
            frame_id = str(getattr(getattr(first, "header", None), "frame_id", ""))
            unread.append(
                ColourStream(topic.name, topic.type, "raw", None, topic.count, frame_id, name)
            )
    return unread


class _NearSensor(NamedTuple):
    """The depth streams of a sensor near a colour topic.

    ``shared`` is the largest number of namespace components that a stream of one kind shares with
    the topic.
    """

    shared: int
    streams: Sequence[Stream]


def _nearest_sensors(
    one: ColourStream, sensors: Sequence[Sequence[Stream]]
) -> dict[str, list[_NearSensor]]:
    """Return the two sensors whose topics share most of the namespace of a colour topic.

    They are listed for each kind of depth stream, ``depth`` and ``points``, the best first; the
    second is needed when the best is compared with the others. ``sensors`` holds the streams of
    each sensor.
    """
    nearest: dict[str, list[_NearSensor]] = {}
    for kind in ("depth", "points"):
        most = (
            max((_shared(one, s) for s in sensor if s.kind == kind), default=0)
            for sensor in sensors
        )
        near = map(_NearSensor, most, sensors)
        nearest[kind] = nlargest(2, near, key=lambda sensor: sensor.shared)
    return nearest


def _belongs(
    one: ColourStream, stream: Stream, nearest: Mapping[str, Sequence[_NearSensor]]
) -> bool:
    """Return whether colour images belong to the sensor of a depth stream, see `pair_colours`.

    ``nearest`` are the sensors nearest to the colour topic, from `_nearest_sensors`.
    """
    if _is_in_frame_of(one, stream):
        return True
    shared = _shared(one, stream)
    others = (near.shared for near in nearest[stream.kind] if stream not in near.streams)
    return shared > 0 and next(others, 0) <= shared


def _select(
    recording: Recording, streams: tuple[ColourStream, ...], requested: str
) -> ColourStream:
    """Return the colour stream on the requested topic.

    Raises
    ------
    NoStreamError : there is none.
    """
    for one in streams:
        if one.topic.strip("/") == requested.strip("/"):
            return one
    available = listed([one.topic for one in streams]) or "none"
    exists = any(topic.name.strip("/") == requested.strip("/") for topic in recording.topics)
    state = "holds no colour images" if exists else "does not exist"
    msg = f"{recording.path}: topic {requested} {state}; colour images: {available}"
    raise NoStreamError(msg)


def _rank(one: ColourStream, stream: Stream) -> tuple[bool, int, bool, bool, int, bool, str]:
    """Return the key by which the colour streams of a depth stream are sorted, the best first."""
    return (
        not _is_in_frame_of(one, stream),
        -_shared(one, stream),
        not any(word in one.topic.lower() for word in _COLOUR_WORDS),
        not is_rectified(one.topic),
        -one.count,
        one.kind != "compressed",
        one.topic,
    )


def _is_in_frame_of(one: ColourStream, stream: Stream) -> bool:
    """Return whether images are in the sensor frame of a depth stream; False without a frame id."""
    return one.frame_id != "" and same_frame(one.frame_id, stream.frame_id)


def _shared(one: ColourStream, stream: Stream) -> int:
    """Return the number of leading namespace components that two topics share."""
    a, b = _namespace(one.topic), _namespace(stream.topic)
    equal = [x == y for x, y in zip(a, b, strict=False)]
    return equal.index(False) if False in equal else len(equal)


@lru_cache(maxsize=4096)
def _namespace(topic: str) -> tuple[str, ...]:
    """Return the components of a topic, without the last one."""
    return PurePosixPath(topic.strip("/")).parts[:-1]


def _probe(topic: Topic, recording: Recording) -> ColourStream | None:
    kind, encoding_of = _PROBES[ros_counterpart(topic.type)]
    with suppress(*MALFORMED):
        for first in first_messages(recording, topic.name, topic.type):  # some may be blank
            encoding = encoding_of(first)
            if not encoding:
                continue
            if encoding == "mono8" and any(w in f"/{topic.name.lower()}" for w in _OTHER_WORDS):
                return None
            frame_id = str(first.header.frame_id)
            info = info_topic_of(topic.name, recording, frame_id) if kind != "cloud" else None
            return ColourStream(topic.name, topic.type, kind, info, topic.count, frame_id, encoding)
    return None


def _raw_encoding(first: Any) -> str:
    encoding = str(first.encoding)
    return encoding if encoding in COLOUR_ENCODINGS else ""


def _compressed_encoding(first: Any) -> str:
    if "compressedDepth" in str(first.format):
        return ""
    begin = bytes(first.data[:26])
    kind = compressed_kind(begin)
    pixels = str(first.format).split(";")[0].strip()
    # Depth may be compressed like colour: "16UC1; png compressed", or just "png" in Foxglove.
    if pixels in DEPTH_ENCODINGS or is_grey_png16(begin):
        return ""
    return "mono8" if kind and pixels == "mono8" else kind


def _cloud_encoding(first: Any) -> str:
    return "rgb8" if any(field.name in {"rgb", "rgba"} for field in first.fields) else ""


_PROBES: dict[str, tuple[Literal["raw", "compressed", "cloud"], Callable[[Any], str]]] = {
    IMAGE: ("raw", _raw_encoding),
    COMPRESSED: ("compressed", _compressed_encoding),
    CLOUD: ("cloud", _cloud_encoding),
}
"""By message type, the kind of the stream, and a function that returns the encoding of a message,
empty if it has no colours."""
