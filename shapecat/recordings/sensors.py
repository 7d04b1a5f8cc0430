"""Depth streams, and which of them come from the same sensor."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Literal, NamedTuple

__all__ = ["Stream", "by_sensor", "is_of_realsense_recorder", "same_frame"]

_KINDS = ("depth", "points", "cloud", "image", "aligned")
"""The first part of a topic with one of these words ends the namespace of the sensor."""
_PLAIN = {
    *("aligned", "color", "colour", "depth", "hw", "image", "raw", "rect", "rectified"),
    *("registered", "rgb", "sw", "cloud", "point", "pointcloud", "points"),
}
"""Words between that namespace and the name of the topic that do not name a camera."""


@dataclass(frozen=True)
class Stream:
    """A topic of depth images or clouds.

    ``info_topic`` is the topic of a depth image's calibration, None if there is none; ``count`` is
    the number of messages; ``frame_id`` is from the first message; ``doubt`` says why its frames
    may be wrong, for example with the calibration of another camera; it is empty if there is no
    doubt.
    """

    topic: str
    type: str
    kind: Literal["depth", "points"]
    info_topic: str | None
    count: int
    frame_id: str
    doubt: str = ""

    @property
    def usable(self) -> bool:
        """Whether the stream gives frames: depth images need a calibration."""
        return self.kind == "points" or self.info_topic is not None


class _Place(NamedTuple):
    """The parts of a topic: the sensor's namespace, the rest, and words that name a camera."""

    space: tuple[str, ...]
    rest: tuple[str, ...]
    camera: frozenset[str]


def same_frame(a: str, b: str) -> bool:
    """Return whether two frame ids name the same frame; ROS 1 may put a slash before either."""
    return a.lstrip("/") == b.lstrip("/")


def is_of_realsense_recorder(topic: str) -> bool:
    """Return whether librealsense recorded a topic itself: its frame ids are numbers, not names."""
    return topic.startswith("/device_")


def by_sensor(streams: Sequence[Stream]) -> list[list[Stream]]:
    """Group streams by sensor.

    Streams belong to the same sensor if they share the sensor's namespace (``/camera/depth/points``
    and ``/camera/aligned_depth_to_color/image_raw``), unless the rest of their names tells
    different cameras apart (``/spot/depth/left/image`` and ``/spot/depth/right/image``), or if they
    share a frame, unless the same driver seems to run in both namespaces, as on two robots of one
    kind.
    """
    places = {stream.topic: _place(stream.topic) for stream in streams}
    twins = {
        (places[a.topic].space, places[b.topic].space)
        for a, b in permutations(streams, 2)
        if _are_twins(a, b, places[a.topic], places[b.topic])
    }

    def are_same(a: Stream, b: Stream) -> bool:
        first, second = places[a.topic], places[b.topic]
        one_frame = a.frame_id != "" and same_frame(a.frame_id, b.frame_id)
        return _share_namespace(first, second) or (
            one_frame and (first.space, second.space) not in twins
        )

    groups: list[list[Stream]] = []
    for stream in streams:
        joined = [group for group in groups if any(are_same(stream, second) for second in group)]
        groups = [group for group in groups if group not in joined]
        groups.append([*(second for group in joined for second in group), stream])
    return groups


def _place(topic: str) -> _Place:
    parts = tuple(topic.strip("/").split("/"))
    spaces = parts[:-1]
    ends = (k for k, part in enumerate(spaces) if any(word in part for word in _KINDS))
    end = next(ends, len(spaces))
    words = (word for part in parts[end:-1] for word in re.sub("_to_.*", "", part).split("_"))
    return _Place(parts[:end], parts[end:], frozenset(words) - _PLAIN)


def _share_namespace(a: _Place, b: _Place) -> bool:
    if a.space != b.space or a.camera != b.camera:
        return False
    # Without a namespace, a topic may belong to any sensor.
    return a.space != () or all("depth" in "/".join(one.rest[:-1]) for one in (a, b))


def _are_twins(a: Stream, b: Stream, first: _Place, second: _Place) -> bool:
    """Return whether the same topic of a driver is in two namespaces, each with its calibration.

    Namespaces with the same first part (``/kinect2/hd``, ``/kinect2/qhd``) belong to one driver,
    and a namespace put before another, as for throttled topics, holds a copy. Clouds have no
    calibration, so the last two parts of their topics are compared.
    """
    short, long = sorted((first.space, second.space), key=len)
    copied = first.space[:1] == second.space[:1] or long[len(long) - len(short) :] == short
    if first.rest != second.rest or copied:
        return False
    if a.kind == "depth":
        return a.info_topic != b.info_topic
    return a.topic.split("/")[-2:] == b.topic.split("/")[-2:]
