"""The container formats of simulated recordings."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, Self

from mcap.writer import CompressionType
from mcap.writer import Writer as McapFile
from rosbags import interfaces as ros
from rosbags.rosbag1 import Writer as Ros1File
from rosbags.rosbag2 import Writer as Ros2Folder

from shapecat.simulation.messages import MessageFactory

__all__ = ["CONTAINERS", "Container"]

_STATIC = "/tf_static"
_QOS = """- history: {history}
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 2147483647, nsec: 4294967295}}
  lifespan: {{sec: 2147483647, nsec: 4294967295}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 2147483647, nsec: 4294967295}}
  avoid_ros_namespace_conventions: false
"""


class Container(Protocol):
    """A recording being written; leaving the ``with`` block completes it."""

    messages: MessageFactory

    def __init__(self, path: Path) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def write(self, topic: str, message: Any, log_time_ns: int) -> None:
        """Append a message made by `messages`; times are in nanoseconds."""


class _Mcap:
    """An MCAP file with ROS 2 messages, compressed with zstd."""

    def __init__(self, path: Path) -> None:
        self.messages = MessageFactory(2)
        self._path = path
        self._channels: dict[str, tuple[int, int]] = {}

    def __enter__(self) -> Self:
        self._stream = self._path.open("wb")
        self._file = McapFile(self._stream, compression=CompressionType.ZSTD)
        self._file.start(profile="ros2", library="shapecat")
        return self

    def __exit__(self, *_: object) -> None:
        self._file.finish()
        self._stream.close()

    def write(self, topic: str, message: Any, log_time_ns: int) -> None:
        channel, sequence = self._channels.get(topic) or (self._channel(topic, message), 0)
        self._channels[topic] = channel, sequence + 1
        data = self.messages.serialize(message)
        self._file.add_message(channel, log_time_ns, data, log_time_ns, sequence)

    def _channel(self, topic: str, message: Any) -> int:
        name = message.__msgtype__
        text, _ = self.messages.typestore.generate_msgdef(name, ros_version=2)
        schema = self._file.register_schema(name, "ros2msg", text.encode())
        latched = topic == _STATIC
        qos = _QOS.format(history=1, depth=1 if latched else 10, durability=1 if latched else 2)
        return int(self._file.register_channel(topic, "cdr", schema, {"offered_qos_profiles": qos}))


class _Bag(ABC):
    """A recording written by rosbags."""

    ros_version: ClassVar[Literal[1, 2]]

    def __init__(self, path: Path) -> None:
        self.messages = MessageFactory(self.ros_version)
        self._file = self.open(path)
        self._connections: dict[str, Any] = {}

    @abstractmethod
    def open(self, path: Path) -> Any:
        """Return the writer of a new recording."""

    @abstractmethod
    def quality(self, *, latched: bool) -> dict[str, Any]:
        """Return the options of a topic; a latched one resends its last message to subscribers."""

    def __enter__(self) -> Self:
        self._file.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, topic: str, message: Any, log_time_ns: int) -> None:
        if topic not in self._connections:
            kind, store = message.__msgtype__, self.messages.typestore
            quality = self.quality(latched=topic == _STATIC)
            added = self._file.add_connection(topic, kind, typestore=store, **quality)
            self._connections[topic] = added
        self._file.write(self._connections[topic], log_time_ns, self.messages.serialize(message))


class _Ros1(_Bag):
    """A ROS 1 bag."""

    ros_version = 1

    def open(self, path: Path) -> Any:
        return Ros1File(path)

    def quality(self, *, latched: bool) -> dict[str, Any]:
        return {"latching": int(latched)}


class _Ros2(_Bag):
    """A ROS 2 bag: a folder with an SQLite database."""

    ros_version = 2

    def open(self, path: Path) -> Any:
        return Ros2Folder(path, version=8)

    def quality(self, *, latched: bool) -> dict[str, Any]:
        return {"offered_qos_profiles": [_qos(latched=latched)]}


def _qos(*, latched: bool) -> ros.Qos:
    kept, ever = ros.QosDurability, ros.QosTime(2147483647, 4294967295)
    return ros.Qos(
        ros.QosHistory.KEEP_LAST,
        1 if latched else 10,
        ros.QosReliability.RELIABLE,
        kept.TRANSIENT_LOCAL if latched else kept.VOLATILE,
        *(ever, ever),
        ros.QosLiveliness.AUTOMATIC,
        ever,
        avoid_ros_namespace_conventions=False,
    )


CONTAINERS: dict[str, tuple[str, type[Container]]] = {
    "mcap": (".mcap", _Mcap),
    "ros1": (".bag", _Ros1),
    "ros2": ("", _Ros2),
}
"""File suffix and writer of each recording format."""
