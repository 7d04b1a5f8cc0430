"""Read ROS 1 bags (format 2.0): by time if they are indexed, otherwise in file order.

Libraries reject the bags that a robot leaves when its power is cut: without an index
(``.bag.active``) or truncated. This reader reads them as far as possible.
"""

import struct
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from typing import ClassVar

from shapecat.errors import RecordingError
from shapecat.recordings.containers.chunked import Chunk, ChunkedRecording, RawMessage
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
from shapecat.recordings.messages import Channel, Selection, ros_type

__all__ = ["BagRecording"]


class BagRecording(ChunkedRecording):
    """A ROS 1 bag. The log time of a message is the time at which it was recorded.

    Raises `RecordingError` if it is not version 2.0, is encrypted, or has neither index nor topics.
    """

    kind: ClassVar[str] = "ros1"

    def _read_chunk(
        self, chunk: Chunk, _channel_ids: set[int], _selection: Selection
    ) -> Iterator[RawMessage]:
        return self._expand(self._record_at(chunk.position), sum(chunk.entry.values()))

    def _read_header(self) -> dict[str, bytes]:
        """Return the fields of the bag header, empty if it is damaged; note where records begin.

        Raises
        ------
        RecordingError : the file is not version 2.0, or is encrypted.
        """
        self._first = len(MAGIC)
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            msg = "not a readable ROS 1 bag: not version 2.0"
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

    def _read_index(self) -> bool:
        header = self._read_header()
        chunks: list[Chunk] = []
        self._places: list[int] = []  # offsets of the indexed chunks
        try:
            connections, number = u4(header, "conn_count"), u4(header, "chunk_count")
            position = u8(header, "index_pos")
            if position == 0:
                return False
            for record in walk(self._file, position, self._size):
                if record.op == CONNECTION:
                    self._connect(record.fields, self._data(record))
                elif record.op == CHUNK_INFO:
                    chunks.append(self._chunk_info(record))
        except (BagError, struct.error):
            return False
        records = [self._record_at(chunk.position) for chunk in chunks]
        self._places = sorted(r.start for r in records if r is not None and r.op == CHUNK)
        if len(self._places) < len(chunks):
            return False
        if (len(self._channels), len(chunks)) != (connections, number):
            return False
        filled = [chunk for chunk in chunks if chunk.entry]
        if not all(chunk.entry.keys() <= self._channels.keys() for chunk in filled):
            return False
        self._chunks = filled
        for chunk in filled:
            self._counts.update(chunk.entry)
        return self._agrees()

    def _record_at(self, position: int) -> Record | None:
        with suppress(BagError):
            return next(walk(self._file, position, self._size), None)
        return None

    def _chunk_info(self, record: Record) -> Chunk:
        """Return the chunk that a chunk info record describes.

        Its ``entry`` holds the number of messages by connection id.
        """
        counts = dict(struct.iter_unpack("<II", self._data(record)))
        start, end = (time_of(record.fields, name) for name in ("start_time", "end_time"))
        return Chunk(start, end, u8(record.fields, "chunk_pos"), counts.keys(), counts)

    def _scan(self) -> Record | None:
        last: Record | None = super()._scan()
        self.warn(f"no index, or a damaged one; messages recovered: {self._counts.total()}")
        if not self._channels:
            msg = "not a readable ROS 1 bag: no index and no messages in it"
            raise RecordingError(msg)
        return last

    def _records(self) -> Iterator[Record]:
        """Yield the records in file order; a truncated one is cut to its readable part.

        After a damaged record, reading continues at the next chunk in the index, with a warning.
        """
        for start, end in pairwise([self._first, *self._places, self._size]):
            try:
                yield from walk(self._file, start, end)
            except BagError as error:
                lost = "everything after it" if end == self._size else f"the rest up to byte {end}"
                self.warn(f"{error}: {lost} is lost")
                if error.record is not None:
                    yield error.record

    def _expand(self, record: Record | None, listed: int | None = None) -> Iterator[RawMessage]:
        """Yield the messages of a chunk; store its connections if the file has no index.

        A truncated chunk is read as far as possible. ``listed`` is its number of messages according
        to the index, None if unknown; any other number causes a warning. Other records, and None,
        have no messages.
        """
        if record is None or record.op not in {CHUNK, CONNECTION}:
            return
        problem, data = "", self._data(record)
        try:
            if record.op == CONNECTION:
                yield from self._take(record.fields, memoryview(data))
                return
            plain, problem = expand(record, data)
            count = 0
            for fields, content in split(plain):
                for message in self._take(fields, content):
                    count += 1
                    yield message
            if listed not in {None, count}:
                problem = problem or f"the index does not list its {count} messages"
        except BagError as error:
            problem = problem or str(error)
        if problem:
            self.warn(f"skipped the rest of the record at byte {record.start}: {problem}")

    def _take(self, fields: dict[str, bytes], data: memoryview) -> Iterator[RawMessage]:
        kind = fields.get("op", b"")
        if kind == bytes([MESSAGE]):
            number, time = u4(fields, "conn"), time_of(fields)
            if number in self._channels:
                yield RawMessage(number, 0, time, time, data)
            else:
                self.warn(
                    f"skipped messages of connection {number}, which has no connection record"
                )
        elif kind == bytes([CONNECTION]) and not self.indexed:
            self._connect(fields, data)

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
