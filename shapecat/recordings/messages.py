"""Channels, messages and topics of a recording, and which messages to read."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from shapecat.errors import RecordingError

__all__ = [
    "MALFORMED",
    "Channel",
    "Message",
    "MessageError",
    "Needed",
    "Selection",
    "TimeLimit",
    "Topic",
    "Topics",
    "detached",
    "reason_of",
    "ros_type",
    "sum_topics",
]

Topics: TypeAlias = Collection[str] | None
"""The names of topics; None means all."""
TimeLimit: TypeAlias = int | None
"""A log time in nanoseconds; None means no limit."""
Needed: TypeAlias = Callable[[str, int], bool] | None
"""A function that returns whether a message's data is needed, given its topic and log time (ns);
None if all data is needed."""


_SMALL = 1 << 16  # bytes

MALFORMED = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""Errors raised by the use of a message that lacks fields or has values of wrong types."""


class MessageError(RecordingError):
    """A message cannot be decoded; the rest of the recording is unaffected."""


def reason_of(error: Exception, topic: str) -> str:
    """Return why a message of a topic is unusable, given a RecordingError or one of `MALFORMED`."""
    if isinstance(error, RecordingError):
        return str(error).removeprefix(f"{topic}: ")[:160]
    return "message does not match its type"


class Selection(NamedTuple):
    """The messages of a recording to read; see `Recording.messages`."""

    topics: Topics
    start_ns: TimeLimit
    stop_ns: TimeLimit
    needed: Needed

    def has_topic(self, topic: str) -> bool:
        """Return whether the messages of a topic are selected."""
        return self.topics is None or topic in self.topics

    def has_time(self, log_time_ns: int) -> bool:
        """Return whether a message with this log time is selected."""
        begun = self.start_ns is None or log_time_ns >= self.start_ns
        return begun and (self.stop_ns is None or log_time_ns < self.stop_ns)


class Channel(NamedTuple):
    """A topic, with the type of its messages and the definition of that type.

    ``type`` is normalized to ``package/msg/Name`` for ROS types; ``schema_name`` is as recorded.
    ``encoding`` is that of the messages, such as cdr, ros1, json or protobuf. ``metadata`` holds
    entries that recorders add, such as ``offered_qos_profiles``.
    """

    topic: str
    type: str
    encoding: str
    schema_name: str = ""
    schema_encoding: str = ""
    schema: bytes = b""
    metadata: tuple[tuple[str, str], ...] = ()


class Message(NamedTuple):
    """A recorded message, not decoded. Times are nanoseconds."""

    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes | memoryview

    @property
    def topic(self) -> str:
        """The topic of the message."""
        return self.channel.topic

    @property
    def type(self) -> str:
        """The type of the message, normalized as in `Channel`."""
        return self.channel.type


@dataclass(frozen=True)
class Topic:
    """A topic with one type; ``count`` is the number of messages."""

    name: str
    type: str
    encoding: str
    count: int


def detached(data: bytes | memoryview) -> bytes | memoryview:
    """Copy the data of a message if it is small, so that it does not keep its chunk in memory."""
    return bytes(data) if len(data) <= _SMALL else data


def sum_topics(topics: Iterable[Topic]) -> tuple[Topic, ...]:
    """Merge topics with the same name, type and encoding, and add up their counts; sort them."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for topic in topics:
        counts[topic.name, topic.type, topic.encoding] += topic.count
    return tuple(Topic(*key, counts[key]) for key in sorted(counts))


def ros_type(name: str) -> str:
    """Return a ROS type as ``package/msg/Name``, any other name unchanged.

    Examples
    --------
    >>> ros_type("sensor_msgs/Image")
    'sensor_msgs/msg/Image'
    >>> ros_type("foxglove.PointCloud")
    'foxglove.PointCloud'
    """
    package, slash, name_in_package = name.partition("/")
    return f"{package}/msg/{name_in_package}" if slash and "/" not in name_in_package else name
