"""ROS 2 bags in one SQLite file (.db3)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import apsw
import zstandard
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import dump_qos_v8

from shapecat.errors import RecordingError
from shapecat.recordings.decoding import LIBRARY_ERRORS
from shapecat.recordings.messages import (
    Channel,
    Message,
    Selection,
    Topic,
    ros_type,
    sum_topics,
)
from shapecat.recordings.recording import Recording

__all__ = ["DatabaseRecording"]

_ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a compressed message; a CDR message begins with a zero byte."""
_LARGEST = 1 << 30
"""Compressed messages that claim a larger decompressed size, in bytes, are skipped."""
_SCHEMAS = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}


class DatabaseRecording(Recording):
    """A ROS 2 bag in SQLite; the log time of a message is when it was recorded."""

    kind: ClassVar[str] = "ros2"

    def __init__(self, path: Path) -> None:
        """Open the database and read its topics.

        Raises
        ------
        RecordingError : the file is not a ROS 2 bag, or is damaged.
        """
        super().__init__(path)
        self._reader = Reader(path)
        try:
            self._reader.open()
            self._channels = {c.id: _channel(c) for c in self._reader.connections}
        except (ReaderError, apsw.Error, *LIBRARY_ERRORS) as error:
            msg = f"not a readable ROS 2 bag: {str(error) or type(error).__name__}"
            raise RecordingError(msg) from error
        channels = ((self._channels[c.id], c.msgcount) for c in self._reader.connections)
        self.topics = sum_topics(
            Topic(channel.topic, channel.type, channel.encoding, count)
            for channel, count in channels
        )
        if self._reader.message_count:
            self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        if any(c.encoding == "cdr" and not c.schema for c in self._channels.values()):
            self.warn("no message definitions: those of ROS 2 Humble are assumed")

    def close(self) -> None:
        """Close the database."""
        self._reader.close()

    def _read(self, selection: Selection) -> Iterator[Message]:
        wanted = [c for c in self._reader.connections if selection.has_topic(c.topic)]
        if not wanted:
            return
        times = selection.start_ns, selection.stop_ns
        raw: Iterator[Any] = self._reader.messages(wanted, *times)  # data of any type
        while True:
            try:
                connection, time, data = next(raw)
            except StopIteration:
                return
            except (ReaderError, apsw.Error, OSError, *LIBRARY_ERRORS) as error:
                self.warn(
                    f"damaged: nothing after this was read: {str(error) or type(error).__name__}"
                )
                return
            channel = self._channels[connection.id]
            if not isinstance(data, bytes | memoryview):
                self.warn(f"{channel.topic}: skipped a message without bytes")
                continue
            plain = self._plain(channel, bytes(data))
            if plain is not None:
                yield Message(channel, time, time, 0, plain)

    def _plain(self, channel: Channel, data: bytes) -> bytes | None:
        """Return a message's data, decompressed if necessary; None if that fails."""
        if not data.startswith(_ZSTD):
            return data
        try:
            if zstandard.frame_content_size(data) > _LARGEST:
                self.warn(f"{channel.topic}: skipped a message that claims more than 1 GiB")
                return None
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=_LARGEST)
        except (zstandard.ZstdError, MemoryError):
            self.warn(f"{channel.topic}: skipped a damaged compressed message")
            return None


def _channel(connection: Any) -> Channel:
    return Channel(
        connection.topic,
        ros_type(connection.msgtype),
        connection.ext.serialization_format,
        connection.msgtype,
        _SCHEMAS.get(connection.msgdef.format, ""),
        connection.msgdef.data.encode(),
        (("offered_qos_profiles", dump_qos_v8(connection.ext.offered_qos_profiles)),),
    )
