"""Read ROS 1 bags (format 2.0): by time if they are indexed, otherwise in file order.

Libraries reject the bags that a robot leaves when its power is cut: without an index
(``.bag.active``) or truncated. This reader reads them as far as possible.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, NamedTuple

from shapecat.errors import RecordingError
from shapecat.recordings.containers.ros1_records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    MAGIC,
    MESSAGE,
    BagError,
    Record,
    expand,
    fields_of,
    split,
    time_of,
    u4,
    u8,
    walk,
)
from shapecat.recordings.containers.time_order import Timed, in_time_order
from shapecat.recordings.messages import (
    Channel,
    Message,
    Selection,
    Topic,
    detached,
    ros_type,
    sum_topics,
)
from shapecat.recordings.recording import Recording

__all__ = ["BagRecording"]


class _ChunkInfo(NamedTuple):
    position: int
    start: int
    end: int
    counts: dict[int, int]


class BagRecording(Recording):
    """A ROS 1 bag; the log time of a message is when it was recorded."""

    kind: ClassVar[str] = "ros1"

    def __init__(self, path: Path) -> None:
        """Open the bag and read its index, or scan it without one.

        Raises
        ------
        RecordingError : the file is not a bag of version 2.0, is encrypted, or holds no topics.
        OSError : the file cannot be read.
        """
        super().__init__(path)
        self._chunks: list[_ChunkInfo] | None = None
        self._promised: dict[int, int] = {}
        self._file = path.open("rb")
        try:
            self._size = self._file.seek(0, 2)
            self._first = len(MAGIC)
            counts = self._read_index(self._read_header())
            self.indexed = counts is not None
            if counts is None:
                counts = self._scan()
        except BaseException:
            self._file.close()
            raise
        self.topics = sum_topics(
            Topic(channel.topic, channel.type, channel.encoding, counts[number])
            for number, channel in self._channels.items()
        )

    def close(self) -> None:
        """Close the bag."""
        self._file.close()

    def _read(self, selection: Selection) -> Iterator[Message]:
        connections = {n for n, c in self._channels.items() if selection.has_topic(c.topic)}
        for number, time, data in self._raw(connections, selection.start_ns, selection.stop_ns):
            if selection.has_time(time):
                yield Message(self._channels[number], time, time, 0, detached(data))

    def _raw(
        self, connections: set[int], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[int, int, memoryview]]:
        if self._chunks is None:
            for record in self._records():
                yield from (m for m in self._expand(record) if m[0] in connections)
            return
        due = [
            (chunk.start, chunk.position, chunk.position)
            for chunk in self._chunks
            if not connections.isdisjoint(chunk.counts)
            and (start_ns is None or chunk.end >= start_ns)
            and (stop_ns is None or chunk.start < stop_ns)
        ]

        def read(position: int) -> Iterator[tuple[Timed, tuple[int, int, memoryview]]]:
            chunk = next(walk(self._file, position, self._size))
            for message in self._expand(chunk):
                if message[0] in connections:
                    yield Timed(message[1], len(message[2])), message

        yield from in_time_order(due, read)

    def _read_header(self) -> dict[str, bytes]:
        """Return the fields of the bag header; empty if it is damaged."""
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            msg = "not a readable ROS 1 bag: not of version 2.0"
            raise RecordingError(msg)
        try:
            record = next(walk(self._file, len(MAGIC), self._size))
        except (StopIteration, BagError):
            return {}
        if record.op == BAG_HEADER:
            self._first = record.end
        if record.fields.get("encryptor"):
            msg = f"encrypted with {record.fields['encryptor'].decode('latin-1')!r}"
            raise RecordingError(msg)
        return record.fields

    def _read_index(self, header: dict[str, bytes]) -> Counter[int] | None:
        """Read the index; return the message count per connection, None if it is unusable."""
        counts: Counter[int] = Counter()
        chunks = []
        try:
            connections, number = u4(header, "conn_count"), u4(header, "chunk_count")
            position = u8(header, "index_pos")
            if position == 0:
                return None
            for record in walk(self._file, position, self._size):
                if record.op == CONNECTION:
                    self._connect(record.fields, self._data(record))
                elif record.op == CHUNK_INFO:
                    chunks.append(self._chunk_info(record))
                    counts.update(chunks[-1].counts)
            for chunk in chunks:
                if next(walk(self._file, chunk.position, self._size)).op != CHUNK:
                    return None
        except (BagError, StopIteration, struct.error):
            return None
        if (len(self._channels), len(chunks)) != (connections, number):
            return None
        if not counts.keys() <= self._channels.keys():
            return None
        if not self._agrees(chunks):
            return None
        self._chunks = chunks
        self._promised = {chunk.position: sum(chunk.counts.values()) for chunk in chunks}
        filled = [chunk for chunk in chunks if chunk.counts]
        if filled:
            self.start_ns = min(chunk.start for chunk in filled)
            self.end_ns = max(chunk.end for chunk in filled)
        return counts

    def _agrees(self, chunks: list[_ChunkInfo]) -> bool:
        """Return whether the index agrees with the connections in the chunks."""
        unseen = set(self._channels)
        for chunk in sorted(chunks):
            if unseen.isdisjoint(chunk.counts):
                continue
            unseen -= chunk.counts.keys()
            record = next(walk(self._file, chunk.position, self._size))
            with suppress(BagError):  # damage is reported when the chunk is read
                for fields, data in split(expand(record, self._data(record))[0]):
                    if fields.get("op") == bytes([CONNECTION]):
                        number = u4(fields, "conn")
                        if self._channels.get(number) != _channel(fields, data):
                            return False
        return True

    def _chunk_info(self, record: Record) -> _ChunkInfo:
        pairs = struct.iter_unpack("<II", self._data(record))
        start, end = (time_of(record.fields, name) for name in ("start_time", "end_time"))
        return _ChunkInfo(u8(record.fields, "chunk_pos"), start, end, dict(pairs))

    def _scan(self) -> Counter[int]:
        """Read the whole bag to find its connections, counts and times."""
        self._channels.clear()
        counts: Counter[int] = Counter()
        low = high = None
        for record in self._records():
            for number, time, _ in self._expand(record):
                counts[number] += 1
                low = time if low is None else min(low, time)
                high = time if high is None else max(high, time)
        self.start_ns, self.end_ns = low or 0, high or 0
        self.warn(f"no index, or a damaged one; messages recovered: {counts.total()}")
        if not self._channels:
            msg = "not a readable ROS 1 bag: no index and no messages in it"
            raise RecordingError(msg)
        return counts

    def _records(self) -> Iterator[Record]:
        """Yield the records in file order; a truncated last one is cut to its readable part."""
        try:
            yield from walk(self._file, self._first, self._size)
        except BagError as error:
            self.warn(f"{error}: everything after it is lost")
            if error.record is not None:
                yield error.record

    def _expand(self, record: Record) -> Iterator[tuple[int, int, memoryview]]:
        """Yield connection, time (ns) and data of the messages of a record; store new connections.

        A damaged chunk is read up to the damage.
        """
        if record.op not in {CHUNK, CONNECTION}:
            return
        problem, data = "", self._data(record)
        try:
            if record.op == CONNECTION:
                self._take(record.fields, memoryview(data))
                return
            plain, problem = expand(record, data)
            count = 0
            for fields, content in split(plain):
                message = self._take(fields, content)
                if message is not None:
                    count += 1
                    yield message
            if self._chunks is not None and count != self._promised[record.start]:
                problem = problem or f"the index does not list its {count} messages"
        except BagError as error:
            problem = problem or str(error)
        if problem:
            self.warn(f"skipped the rest of the record at byte {record.start}: {problem}")

    def _take(
        self, fields: dict[str, bytes], data: memoryview
    ) -> tuple[int, int, memoryview] | None:
        kind = fields.get("op", b"")
        if kind == bytes([MESSAGE]):
            number, time = u4(fields, "conn"), time_of(fields)
            if number in self._channels:
                return number, time, data
            self.warn(f"skipped messages of connection {number}, which is not described")
        elif kind == bytes([CONNECTION]) and self._chunks is None:
            self._connect(fields, data)
        return None

    def _connect(self, fields: dict[str, bytes], data: bytes | memoryview) -> None:
        """Store the channel of a connection record."""
        self._channels.setdefault(u4(fields, "conn"), _channel(fields, data))

    def _data(self, record: Record) -> bytes:
        self._file.seek(record.begin)
        return self._file.read(record.end - record.begin)


def _channel(fields: dict[str, bytes], data: bytes | memoryview) -> Channel:
    """Return the channel that a connection record describes."""
    described = {name: _text(value) for name, value in fields_of(data).items()}
    topic = _text(fields.get("topic", b""))
    parts = [part for part in topic.split("/") if part]
    recorded = described.get("type", "")
    latched = (("latching", "1"),) if described.get("latching") == "1" else ()
    return Channel(
        "/" * topic.startswith("/") + "/".join(parts),
        ros_type(recorded),
        "ros1",
        ros_type(recorded),
        "ros1msg",
        described.get("message_definition", "").encode(),
        latched,
    )


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace")
