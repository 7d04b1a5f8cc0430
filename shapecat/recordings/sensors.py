"""Depth streams, and how to group them by sensor."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Literal, NamedTuple

__all__ = ["Stream", "by_sensor", "is_of_realsense_recorder", "same_frame"]

_KINDS = ("depth", "points", "cloud", "image", "aligned")
"""A sensor's namespace ends before the first topic component that contains one of these words."""
_PLAIN = {
    *("aligned", "color", "colour", "depth", "hw", "image", "raw", "rect", "rectified"),
    *("registered", "rgb", "sw", "cloud", "point", "pointcloud", "points"),
}
"""Words between that namespace and the topic's own name that do not tell cameras apart."""


@dataclass(frozen=True)
class Stream:
    """A topic of depth images or clouds.

    Attributes
    ----------
    info_topic : topic of the calibration of depth images; None if there is none.
    count : number of messages.
    frame_id : coordinate frame (``frame_id``) of the first message.
    doubt : why the frames may be wrong, for example because the calibration seems to be that of
        another camera; empty if there is no doubt.
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
        """Whether the stream can be processed: depth images need a calibration."""
        return self.kind == "points" or self.info_topic is not None


class _TopicParts(NamedTuple):
    """The components of a topic.

    Attributes
    ----------
    namespace : that of the sensor.
    rest : the components after it.
    camera : words in ``rest``, except in its last component, that tell cameras apart.
    """

    namespace: tuple[str, ...]
    rest: tuple[str, ...]
    camera: frozenset[str]


def same_frame(a: str, b: str) -> bool:
    """Return whether two frame ids name the same frame; ROS 1 may put a slash before either."""
    return a.lstrip("/") == b.lstrip("/")


def is_of_realsense_recorder(topic: str) -> bool:
    """Return whether librealsense recorded a topic itself; its frame ids are then only numbers."""
    return topic.startswith("/device_")


def by_sensor(streams: Sequence[Stream]) -> list[list[Stream]]:
    """Group streams by sensor.

    Streams with the same namespace (``/camera/depth/points`` and
    ``/camera/aligned_depth_to_color/image_raw``) belong to the same sensor, unless the rest of
    their names tells cameras apart (``/spot/depth/left/image`` and ``/spot/depth/right/image``).
    Streams with the same frame belong to the same sensor, unless the same driver seems to run in
    both namespaces, as on two robots of the same kind.
    """
    places = {stream.topic: _split_topic(stream.topic) for stream in streams}
    instances = {
        (places[a.topic].namespace, places[b.topic].namespace)
        for a, b in permutations(streams, 2)
        if _are_from_two_instances(a, b, places[a.topic], places[b.topic])
    }

    def are_same(a: Stream, b: Stream) -> bool:
        first, second = places[a.topic], places[b.topic]
        one_frame = a.frame_id != "" and same_frame(a.frame_id, b.frame_id)
        return _share_namespace(first, second) or (
            one_frame and (first.namespace, second.namespace) not in instances
        )

    groups: list[list[Stream]] = []
    for stream in streams:
        joined = [group for group in groups if any(are_same(stream, second) for second in group)]
        groups = [group for group in groups if group not in joined]
        groups.append([*(second for group in joined for second in group), stream])
    return groups


def _split_topic(topic: str) -> _TopicParts:
    parts = tuple(topic.strip("/").split("/"))
    spaces = parts[:-1]
    ends = (k for k, part in enumerate(spaces) if any(word in part for word in _KINDS))
    end = next(ends, len(spaces))
    words = (word for part in parts[end:-1] for word in re.sub("_to_.*", "", part).split("_"))
    return _TopicParts(parts[:end], parts[end:], frozenset(words) - _PLAIN)


def _share_namespace(a: _TopicParts, b: _TopicParts) -> bool:
    if a.namespace != b.namespace or a.camera != b.camera:
        return False
    # Without a namespace, a topic may belong to any sensor.
    return a.namespace != () or all("depth" in "/".join(one.rest[:-1]) for one in (a, b))


def _are_from_two_instances(a: Stream, b: Stream, first: _TopicParts, second: _TopicParts) -> bool:
    """Return whether two streams seem to be from two instances of a driver, in two namespaces.

    Their topics are then the same after the namespace, but have different calibrations. Clouds have
    no calibration; instead, the last two components of their topics must agree. Two namespaces
    with the same first component (``/kinect2/hd``, ``/kinect2/qhd``) belong to one driver. If one
    namespace ends with the other, it holds a copy, such as throttled topics.
    """
    short, long = sorted((first.namespace, second.namespace), key=len)
    copied = first.namespace[:1] == second.namespace[:1] or long[len(long) - len(short) :] == short
    if first.rest != second.rest or copied:
        return False
    if a.kind == "depth":
        return a.info_topic != b.info_topic
    return a.topic.split("/")[-2:] == b.topic.split("/")[-2:]
