"""The small records of a log: channels, messages, topics."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from shapecat.errors import RecordingError

__all__ = [
    "Channel",
    "Message",
    "MessageError",
    "Needed",
    "Selection",
    "Stamp",
    "Topic",
    "Topics",
    "ros_type",
]

Topics: TypeAlias = Collection[str] | None
"""The names of topics; None means all."""
Stamp: TypeAlias = int | None
"""A log time in nanoseconds; None means no limit."""
Needed: TypeAlias = Callable[[str, int], bool] | None
"""Tells by topic and log time whether the data of a message is needed; None means always."""


class MessageError(RecordingError):
    """A single message that cannot be decoded; the rest of the recording is unaffected."""


class Selection(NamedTuple):
    """Which messages of a recording are read; see `Recording.messages`."""

    topics: Topics
    start_ns: Stamp
    stop_ns: Stamp
    needed: Needed

    def has_topic(self, topic: str) -> bool:
        """Return whether messages of a topic are read."""
        return self.topics is None or topic in self.topics

    def has_time(self, log_time_ns: int) -> bool:
        """Return whether a message of this log time is read."""
        begun = self.start_ns is None or log_time_ns >= self.start_ns
        return begun and (self.stop_ns is None or log_time_ns < self.stop_ns)


class Channel(NamedTuple):
    """Where messages of one kind come from.

    ``type`` is normalized to ``package/msg/Name`` for ROS types; ``schema_name`` is as recorded.
    ``encoding`` is that of the messages: cdr, ros1, json, protobuf. ``metadata`` is what recorders
    keep with a channel, such as ``offered_qos_profiles``.
    """

    topic: str
    type: str
    encoding: str
    schema_name: str = ""
    schema_encoding: str = ""
    schema: bytes = b""
    metadata: tuple[tuple[str, str], ...] = ()


class Message(NamedTuple):
    """One recorded message, undecoded. Times are nanoseconds."""

    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes | memoryview

    @property
    def topic(self) -> str:
        """The topic it was recorded on."""
        return self.channel.topic

    @property
    def type(self) -> str:
        """Its normalized type."""
        return self.channel.type

    @property
    def encoding(self) -> str:
        """How ``data`` is encoded."""
        return self.channel.encoding


@dataclass(frozen=True)
class Topic:
    """A topic of a recording with one type; ``count`` is None where it is not known."""

    name: str
    type: str
    encoding: str
    count: int | None


def ros_type(name: str) -> str:
    """Return a ROS type as ``package/msg/Name``, any other name unchanged.

    Examples
    --------
    >>> ros_type("sensor_msgs/Image")
    'sensor_msgs/msg/Image'
    >>> ros_type("foxglove.PointCloud")
    'foxglove.PointCloud'
    """
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name
