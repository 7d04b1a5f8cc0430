"""Read ROS 2 bags in one SQLite file (.db3)."""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, ClassVar

import apsw
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import dump_qos_v8

from shapecat.errors import RecordingError
from shapecat.recordings.containers.message_compression import decompressed
from shapecat.recordings.decoding.decoders import LIBRARY_ERRORS
from shapecat.recordings.files import write_ahead_log
from shapecat.recordings.messages import (
    Channel,
    Message,
    Selection,
    Topic,
    ros_type,
    sum_topics,
)
from shapecat.recordings.recording import Recording
from shapecat.system.files import scratch_folder

__all__ = ["DatabaseRecording"]

_UNREADABLE = (ReaderError, apsw.Error, OSError, *LIBRARY_ERRORS)
_LAST_NS = 2**63 - 1
"""The largest time that SQLite can hold."""
_OF_URLS = frozenset("%?#")
"""Characters in a path that the reader would interpret as parts of a URL."""
_SCHEMAS = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}
"""MCAP's name of each format of message definitions."""


class DatabaseRecording(Recording):
    """A ROS 2 bag in SQLite. The log time of a message is the time at which it was recorded."""

    kind: ClassVar[str] = "ros2"

    def __init__(self, path: Path) -> None:
        """Open the database and read its topics.

        Raises
        ------
        RecordingError : the file is not a ROS 2 bag, or is damaged.
        """
        super().__init__(path)
        self._cleanup = ExitStack()
        self._file = self._with_log()
        self._reader = Reader(self._file)
        try:
            self._reader.open()
            self._channels = {c.id: _channel(c) for c in self._reader.connections}
        except (ReaderError, apsw.Error, *LIBRARY_ERRORS) as error:
            self._cleanup.close()
            # The library names the file, which may be a temporary copy, and its own cause.
            reason = str(error.__cause__ or error).replace(f" {self._file}", "")
            msg = f"not a readable ROS 2 bag: {reason or type(error).__name__}"
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

    def _release(self) -> None:
        self._reader.close()
        self._cleanup.close()

    def _with_log(self) -> Path:
        """Return the database, or a copy that includes the write-ahead log of a killed recorder.

        The copy and its log use at most half of the free space of the temporary folder. If that is
        not possible, the log is ignored. There is a warning in both cases.
        """
        log = write_ahead_log(self.path)
        if log is None:
            return self._renamed()
        try:
            folder = self._cleanup.enter_context(scratch_folder())
            copy = folder / "a.db3"
            room = shutil.disk_usage(folder).free // 2
            # The log is copied, then merged into the database.
            if self.path.stat().st_size + 2 * log.stat().st_size > room:
                msg = "not enough space in the temporary folder to copy it"
                raise OSError(msg)  # noqa: TRY301  handled like a full disk
            shutil.copyfile(self.path, copy)
            shutil.copyfile(log, f"{copy}-wal")
            with closing(apsw.Connection(str(copy))) as base:
                base.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        except (OSError, apsw.Error) as error:
            self.warn(f"not finished; the last messages, in {log.name}, are not read: {error}")
            return self._renamed()
        self.warn(f"not finished; messages recovered from {log.name}")
        return copy

    def _renamed(self) -> Path:
        """Return the database, or a link to it with a name that the reader accepts."""
        if self.path.suffix == ".db3" and _OF_URLS.isdisjoint(str(self.path)):
            return self.path
        link = self._cleanup.enter_context(scratch_folder()) / "a.db3"
        link.symlink_to(self.path.resolve())
        return link

    def _read(self, selection: Selection) -> Iterator[Message]:
        connections = [c for c in self._reader.connections if selection.has_topic(c.topic)]
        if not connections:
            return
        limits = selection.start_ns, selection.stop_ns
        times = [None if limit is None else min(limit, _LAST_NS) for limit in limits]
        for number, time, data in self._rows(connections, times):
            channel = self._channels[number]
            if not isinstance(time, int) or time < 0:
                self.warn(f"{channel.topic}: skipped a message without a time")
                continue
            if data is None:
                self.warn(f"{channel.topic}: skipped a damaged message")
            elif not isinstance(data, bytes | memoryview):
                self.warn(f"{channel.topic}: skipped a message without bytes")
                continue
            plain = None if data is None else decompressed(self, channel, bytes(data))
            if plain is None and selection.needed:
                plain = b""  # it keeps its place
            if plain is not None:
                yield Message(channel, time, time, 0, plain)

    def _rows(
        self, connections: list[Any], times: list[int | None]
    ) -> Iterator[tuple[int, Any, Any]]:
        """Yield channel id, time (ns) and data of each message; the data is None if damaged.

        ``times`` are start and stop, nanoseconds; None for no limit. If no more rows can be read,
        the rows end with a warning.
        """
        count = 0
        try:
            for connection, time, data in self._reader.messages(connections, *times):
                count += 1
                yield connection.id, time, data
        except _UNREADABLE:
            try:
                yield from self._single_rows([c.id for c in connections], times, count)
            except _UNREADABLE as error:
                self.warn(
                    f"damaged: nothing after this was read: {str(error) or type(error).__name__}"
                )

    def _single_rows(
        self, numbers: list[int], times: list[int | None], done: int
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield rows as `_rows` does, but read the data of each with a query of its own.

        The first ``done`` rows are left out. ``numbers`` are the ids of the channels.
        """
        start, stop = times
        given = ",".join("?" * len(numbers))
        rows = (
            "SELECT messages.id, topics.id, timestamp FROM messages JOIN topics "  # noqa: S608  no value is in it
            f"ON messages.topic_id = topics.id WHERE topics.id IN ({given}) "
            "AND timestamp BETWEEN ? AND ? ORDER BY timestamp LIMIT -1 OFFSET ?"
        )
        first = -_LAST_NS if start is None else start
        last = _LAST_NS if stop is None else stop - 1
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        with closing(apsw.Connection(f"file:{self._file}?immutable=1", flags=flags)) as base:
            for row, number, time in base.execute(rows, (*numbers, first, last, done)):
                data = None
                with suppress(apsw.Error):
                    found = base.execute("SELECT data FROM messages WHERE id = ?", (row,))
                    data = next(found)[0]
                yield number, time, data


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
