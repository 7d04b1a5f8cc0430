"""The container formats of simulated recordings."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TypeAlias

from mcap.writer import CompressionType
from mcap.writer import Writer as McapFile
from rosbags import interfaces as ros
from rosbags.rosbag1 import Writer as Ros1File
from rosbags.rosbag2 import Writer as Ros2Folder

from shapecat.simulation.messages import MessageFactory

__all__ = ["CONTAINERS", "Container", "Format", "FormatName"]

_STATIC = "/tf_static"
_QOS = """- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 2147483647, nsec: 4294967295}}
  lifespan: {{sec: 2147483647, nsec: 4294967295}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 2147483647, nsec: 4294967295}}
  avoid_ros_namespace_conventions: false
"""


class _Mcap:
    """An MCAP file of ROS 2 messages, compressed with zstd; use it in a ``with`` block."""

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
        qos = _QOS.format(depth=1 if latched else 10, durability=1 if latched else 2)
        return int(self._file.register_channel(topic, "cdr", schema, {"offered_qos_profiles": qos}))


class _Bag:
    """A ROS 1 bag, or a ROS 2 bag: a folder with an SQLite database; use it in a ``with`` block."""

    def __init__(self, ros_version: int, path: Path) -> None:
        self.messages = MessageFactory(ros_version)
        self._file: Any = Ros1File(path) if ros_version == 1 else Ros2Folder(path, version=8)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        self._file.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, topic: str, message: Any, log_time_ns: int) -> None:
        if topic not in self._connections:
            kind, store = message.__msgtype__, self.messages.typestore
            latched = topic == _STATIC
            options: dict[str, Any] = {"latching": int(latched)}
            if self.messages.ros_version == 2:
                options = {"offered_qos_profiles": [_qos(latched=latched)]}
            added = self._file.add_connection(topic, kind, typestore=store, **options)
            self._connections[topic] = added
        self._file.write(self._connections[topic], log_time_ns, self.messages.serialize(message))


def _qos(*, latched: bool) -> ros.Qos:
    durability, unlimited = ros.QosDurability, ros.QosTime(2147483647, 4294967295)
    return ros.Qos(
        ros.QosHistory.KEEP_LAST,
        1 if latched else 10,
        ros.QosReliability.RELIABLE,
        durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        *(unlimited, unlimited),
        ros.QosLiveliness.AUTOMATIC,
        unlimited,
        avoid_ros_namespace_conventions=False,
    )


Container: TypeAlias = _Mcap | _Bag
"""A new recording: ``messages`` makes ROS messages, and ``write`` appends one to a topic."""

FormatName = Literal["mcap", "ros1", "ros2"]


class Format(NamedTuple):
    """A format: suffix of the file, empty for a folder, and function that opens a new recording."""

    suffix: str
    open: Callable[[Path], Container]


CONTAINERS: dict[str, Format] = {
    "mcap": Format(".mcap", _Mcap),
    "ros1": Format(".bag", partial(_Bag, 1)),
    "ros2": Format("", partial(_Bag, 2)),
}
"""The recording formats by name."""
