"""Find the depth streams of a recording, and choose which to process."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any

from shapecat.errors import NoStreamError, listed
from shapecat.recordings.decoding.compressed_depth import is_grey_png16
from shapecat.recordings.decoding.depth_image import DEPTH_ENCODINGS
from shapecat.recordings.decoding.foxglove import ros_counterpart
from shapecat.recordings.messages import MALFORMED, MessageError, Topic, reason_of
from shapecat.recordings.recording import Recording
from shapecat.recordings.sensors import Stream, by_sensor

__all__ = [
    "CLOUD",
    "COMPRESSED",
    "IMAGE",
    "INFO",
    "Stream",
    "choose_streams",
    "depth_streams",
    "first_message",
    "first_messages",
    "info_topic_of",
]

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"

_PEEK = 5
"""Number of messages tried to classify a topic, since the first may be damaged or blank."""
_WARNINGS = 3
"""Maximum number of warnings about the recording in an error message."""
_UNREADABLE = "no readable messages"
_NO_INFO_REMEDY = "record the camera_info topic, or use a PointCloud2"
_OTHER_WORDS = (
    *("amplitude", "confidence", "disparity", "intensity", "mask", "snr", "statemap", "texture"),
    "thermal",
)
"""Images on topics with these words are not depth images, even if the encoding is one of depth."""
_AXES = {"x", "y", "z"}


def depth_streams(recording: Recording, requested: Sequence[str] = ()) -> tuple[Stream, ...]:
    """Find the clouds and depth images of a recording, sorted by topic.

    The encoding of the first few images (some may be blank) distinguishes depth from colour.
    Topics named after other images, such as confidence or disparity, are left out unless they are
    ``requested``, with or without a leading slash. `info_topic_of` finds the calibration of a depth
    image, usually in its own namespace (``depth/image_raw`` with ``depth/camera_info``).
    """
    streams = []
    named = {name.strip("/") for name in requested}
    for topic in recording.topics:
        if _is_other(topic) and topic.name.strip("/") not in named:
            continue
        probe = _PROBES.get(ros_counterpart(topic.type))
        if probe is not None and topic.count != 0:
            with suppress(*MALFORMED):
                first = first_messages(recording, topic.name, topic.type)
                probed = (probe(topic, message, recording) for message in first)
                streams.append(next((stream for stream in probed if stream is not None), None))
    return tuple(stream for stream in streams if stream is not None)


def choose_streams(recording: Recording, requested: Sequence[str] = ()) -> tuple[Stream, ...]:
    """Choose the streams to process: those requested, else the best one if there is one sensor.

    `by_sensor` says which streams belong to the same sensor. Within a sensor the preference is, in
    this order: no doubt about content or calibration; depth images, since a cloud holds the same
    data in eight times the bytes; images on a topic named after depth; at least half the messages
    of any other stream of that kind; images not aligned to another camera; more messages; the
    alphabetical order. A doubt about a chosen stream causes a warning.

    Parameters
    ----------
    requested : topics, with or without a leading slash.

    Raises
    ------
    NoStreamError : no stream can be processed, a requested one is missing or lacks a calibration,
        or none is requested and there are several sensors.
    """
    streams = depth_streams(recording, requested)
    chosen = _select(recording, streams, requested) if requested else (_best(recording, streams),)
    for stream in chosen:
        if stream.doubt:
            recording.warn(stream.doubt)
    return chosen


def _best(recording: Recording, streams: tuple[Stream, ...]) -> Stream:
    usable = [stream for stream in streams if stream.usable]
    if not usable:
        raise NoStreamError(_why_none(recording, streams))
    sensors = by_sensor(usable)
    if len(sensors) > 1:
        names = listed([f"{s.topic} ({s.kind})" for s in usable])
        msg = f"{recording.path}: several sensors: {names}; choose with --topic"
        raise NoStreamError(msg)
    return min(sensors[0], key=lambda stream: _rank(stream, sensors[0]))


def _select(
    recording: Recording, streams: tuple[Stream, ...], requested: Sequence[str]
) -> tuple[Stream, ...]:
    by_topic = {stream.topic.strip("/"): stream for stream in streams}
    chosen = []
    for name in dict.fromkeys(requested):
        stream = by_topic.get(name.strip("/"))
        if stream is None:
            raise NoStreamError(_why_unusable(recording, streams, name))
        if not stream.usable:
            problem = f"no sensor_msgs/CameraInfo for the depth images on {name}"
            msg = f"{recording.path}: {problem}; {_NO_INFO_REMEDY}"
            raise NoStreamError(msg)
        chosen.append(stream)
    return tuple(chosen)


def _why_unusable(recording: Recording, streams: tuple[Stream, ...], name: str) -> str:
    """Return the error message for a requested topic that is missing or holds no depth."""
    usable = listed([stream.topic for stream in streams]) or "none"
    topics = [t for t in recording.topics if t.name.strip("/") == name.strip("/")]
    details = [detail for topic in topics if (detail := _encoding_or_error(recording, topic))]
    state = "holds no clouds or depth images" if topics else "does not exist"
    unreadable = [detail for detail in details if detail.startswith(_UNREADABLE)]
    if unreadable:
        state = f"has {unreadable[0]}"
    elif details:
        state = f"{state} ({', '.join(details)})"
    return f"{recording.path}: topic {name} {state}; usable topics: {usable}{_warnings(recording)}"


def _why_none(recording: Recording, streams: tuple[Stream, ...]) -> str:
    """Return the error message for a recording without usable streams."""
    if streams:
        names = listed([stream.topic for stream in streams])
        problem = f"depth images without a sensor_msgs/CameraInfo: {names}; {_NO_INFO_REMEDY}"
        return f"{recording.path}: {problem}{_warnings(recording)}"
    details = ((topic, _encoding_or_error(recording, topic)) for topic in recording.topics)
    lines = [f"{t.name} ({', '.join(filter(None, (t.type or t.encoding, d)))})" for t, d in details]
    images = any(t.type.endswith("Image") for t in recording.topics)
    kinds = f" ({', '.join(DEPTH_ENCODINGS)})" if images else ""
    return (
        f"{recording.path}: no point clouds or depth images{kinds}; "
        f"topics found: {listed(lines) or 'none, the recording is empty'}{_warnings(recording)}"
    )


def _encoding_or_error(recording: Recording, topic: Topic) -> str:
    """Return the encoding of a topic's images, or why no message can be decoded; else empty."""
    if ros_counterpart(topic.type) not in _PROBES:
        return ""
    reason = ""
    of_type = (m for m in recording.messages([topic.name]) if m.type == topic.type)
    for message in islice(of_type, _PEEK):
        try:
            first = recording.decode(message)
        except MessageError as error:
            reason = reason or f": {reason_of(error, topic.name)}"
        else:
            return str(getattr(first, "encoding", getattr(first, "format", ""))).strip()
    return _UNREADABLE + reason


def _warnings(recording: Recording) -> str:
    """Return the first warnings about a recording, as the end of a message."""
    texts = recording.warnings[:_WARNINGS]
    if len(recording.warnings) > _WARNINGS:
        texts.append("`shapecat info` lists all warnings")
    return f"; warnings: {'; '.join(texts)}" if texts else ""


def _rank(stream: Stream, streams: Sequence[Stream]) -> tuple[bool | int | str, ...]:
    rare = any(one.kind == stream.kind and one.count > 2 * stream.count for one in streams)
    aligned = any(word in stream.topic for word in ("aligned", "registered", "depth_to_"))
    unnamed = stream.kind == "depth" and "depth" not in _image_name(stream.topic)
    kind = stream.kind != "depth"
    return (stream.doubt != "", kind, unnamed, rare, aligned, -stream.count, stream.topic)


def _image_name(topic: str) -> str:
    """Return a topic in lower case, without the suffix ``/compressedDepth``."""
    return topic.lower().removesuffix("/compresseddepth")


def _is_other(topic: Topic) -> bool:
    """Return whether the name of an image topic says that it holds something other than depth."""
    name = _own_name(topic.name)
    return ros_counterpart(topic.type) != CLOUD and any(word in name for word in _OTHER_WORDS)


def _is_infrared(topic: str) -> bool:
    name = re.sub("depth_to_[^/]*", "depth", f"/{topic.lower()}")  # aligned depth_to_infra1
    return "infra" in name or "/ir/" in name or "ir" in re.split("[/_]", _own_name(name))


def _is_radial(topic: str) -> bool:
    """Return whether a topic's name suggests distances along the rays instead of depths."""
    name = _own_name(topic)
    return "distance" in name and "plane" not in name


def _own_name(topic: str) -> str:
    """Return the last two components of an image topic, or the part of these after ``depth``."""
    return "/".join(_image_name(topic).split("/")[-2:]).rpartition("depth")[2]


def first_message(recording: Recording, topic: str) -> Any:
    """Return the first decodable message among a topic's first few; None if there is none."""
    return next(first_messages(recording, topic), None)


def first_messages(
    recording: Recording, topic: str, kind: str | None = None, *, most: int = _PEEK
) -> Iterator[Any]:
    """Yield a topic's first ``most`` messages, decoded; leave out any that cannot be decoded.

    Only messages of the type ``kind`` count, unless it is None.
    """
    of_type = (m for m in recording.messages([topic]) if kind is None or m.type == kind)
    for message in islice(of_type, most):
        with suppress(MessageError):
            yield recording.decode(message)


def _probe_cloud(topic: Topic, first: Any, _recording: Recording) -> Stream:
    names, frame_id = {field.name for field in first.fields}, first.header.frame_id
    doubt = ""
    if names and not names >= _AXES:  # empty clouds may have no fields at all
        doubt = f"{topic.name}: its clouds have no fields x, y, z"
    return Stream(topic.name, topic.type, "points", None, topic.count, frame_id, doubt)


def _probe_image(topic: Topic, first: Any, recording: Recording) -> Stream | None:
    name, encoding = topic.name.lower(), str(first.encoding)
    # Cameras publish infrared, and grey images of 16 bits, with the same encodings.
    if (
        encoding not in DEPTH_ENCODINGS
        or _is_infrared(topic.name)
        or (encoding == "mono16" and "depth" not in name)
    ):
        return None
    return _depth_stream(topic, first, recording)


def _probe_compressed(topic: Topic, first: Any, recording: Recording) -> Stream | None:
    name, encoding = topic.name.lower(), str(first.format)
    is_depth = "compressedDepth" in encoding or (
        is_grey_png16(first.data)
        and not encoding.startswith("32FC1")
        and (encoding.startswith("16UC1") or "depth" in name)
    )
    if not is_depth or _is_infrared(topic.name):
        return None
    return _depth_stream(topic, first, recording)


def _depth_stream(topic: Topic, first: Any, recording: Recording) -> Stream:
    frame_id = first.header.frame_id
    info = info_topic_of(topic.name, recording, frame_id)
    doubt = ""
    if _is_radial(topic.name):
        doubt = (
            f"{topic.name}: is named after distances; if these are along the rays of the pixels, "
            "not along the optical axis, flat surfaces look curved: use the clouds of the camera"
        )
    elif info is not None and frame_id and _nearest(topic.name, [info]) is None:
        info_frame = _frame_of(recording, info)
        if info_frame and info_frame.strip("/") != frame_id.strip("/"):
            doubt = (
                f"{topic.name}: the frame of its images is {frame_id}, but the only CameraInfo, on "
                f"{info}, is for {info_frame}: are these the intrinsics of another camera?"
            )
    return Stream(topic.name, topic.type, "depth", info, topic.count, frame_id, doubt)


def info_topic_of(image: str, recording: Recording, frame_id: str) -> str | None:
    """Return the calibration topic that shares the longest namespace with an image topic.

    The image topic itself may be that namespace (``depth`` with ``depth/camera_info``), as in
    AirSim. Within a namespace, a calibration topic with a word of the image topic is preferred
    (``depth_image`` with ``depth_camera_info``). If none shares a namespace, the result is the only
    calibration in the recording, or the only one for ``frame_id``, the frame of the images; else
    None.
    """
    infos = [
        topic.name
        for topic in recording.topics
        if ros_counterpart(topic.type) == INFO and topic.count != 0
    ]
    nearest = _nearest(image, infos)
    if nearest is not None or len(infos) < 2:
        return nearest or next(iter(infos), None)
    frame = frame_id.strip("/")
    matches = [name for name in infos if frame and _frame_of(recording, name).strip("/") == frame]
    return matches[0] if len(matches) == 1 else None


def _nearest(image: str, infos: Sequence[str]) -> str | None:
    """Return the topic in ``infos`` that shares the longest namespace with ``image``, or None."""
    parts = image.split("/")
    outermost = 2 if image.startswith("/") else 1  # the first part of /depth/image is empty
    for length in range(len(parts), min(len(parts) - 1, outermost) - 1, -1):
        suffix = re.sub("[^/]*_to_", "", "/".join(parts[length:]))  # depth_to_color means color
        own_names = (f"{word}_camera_info" for word in re.split("[/_]", suffix))
        for name in (*own_names, *_INFO_NAMES):
            if (sibling := "/".join([*parts[:length], name])) in infos:
                return sibling
    return None


def _frame_of(recording: Recording, topic: str) -> str:
    """Return the frame id of a topic's first message, which is read once; empty if it has none."""
    if topic not in recording.frame_ids:
        recording.frame_ids[topic] = ""
        with suppress(*MALFORMED):  # or no message
            recording.frame_ids[topic] = str(first_message(recording, topic).header.frame_id)
    return recording.frame_ids[topic]


_INFO_NAMES = ("camera_info", "info/camera_info", "calibration")
"""Names of calibration topics in ROS, in the RealSense viewer and in Foxglove."""
_PROBES = {CLOUD: _probe_cloud, IMAGE: _probe_image, COMPRESSED: _probe_compressed}
