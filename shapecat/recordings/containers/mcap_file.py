"""Read MCAP files: by time if they are indexed, otherwise in file order.

Damage does not stop reading: a truncated file is read as far as possible, a damaged chunk is
skipped, and a warning reports either.
"""

import sys
from collections.abc import Iterator
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import ClassVar

from mcap import records

from shapecat.errors import RecordingError
from shapecat.recordings.containers.chunked import Chunk, ChunkedRecording, RawMessage
from shapecat.recordings.containers.mcap_index import (
    IndexedMessage,
    read_message_index,
)
from shapecat.recordings.containers.mcap_records import (
    MAGIC,
    ChunkError,
    Opcode,
    Record,
    TruncatedError,
    parse,
    read_chunk,
    read_content,
    split_chunk,
    split_message,
    walk,
)
from shapecat.recordings.containers.mcap_summary import DAMAGED_INDEX, Summary, read_summary
from shapecat.recordings.messages import Channel, Selection, ros_type

__all__ = ["McapRecording"]

_PART = 0.9
"""If more than this fraction of a chunk is needed, the whole chunk is decompressed and verified."""


class McapRecording(ChunkedRecording):
    """An MCAP file.

    Attributes
    ----------
    indexed : whether the file is finished, and its index is complete.
    summary : schemas, channels and indexes; use it only if the file is ``indexed``.
    profile : profile in the header, such as ``ros2`` or ``ros1``; may be empty.
    """

    kind: ClassVar[str] = "mcap"

    def __init__(self, path: Path) -> None:
        """Open the file and read its summary; without a usable summary, scan the file.

        Raises
        ------
        RecordingError : the file is not MCAP.
        OSError : the file cannot be read.
        """
        self.summary = Summary()
        self._schemas: dict[int, records.Schema] = {}
        self._checked: set[int] = set()  # offsets of chunks with a verified checksum
        self._reported: set[int] = set()  # offsets of damaged chunks with a warning
        super().__init__(path)

    def top_level(self) -> Iterator[Record]:
        """Yield the complete records of the data section, without their content."""
        return (one for one in self._records() if one.whole and one.opcode not in _END)

    def content(self, record: Record) -> bytes:
        """Read the content of a record from `top_level`."""
        return read_content(self._file, record)

    def _read_index(self) -> bool:
        self.profile = self._read_profile()
        summary = read_summary(self._file, self._size, self.warn)
        if summary is None or summary.statistics is None:
            return False
        self.summary, self._schemas = summary, summary.schemas
        self._counts.update(summary.statistics.channel_message_counts)
        self._channels = {
            number: self._channel(channel) for number, channel in summary.channels.items()
        }
        self._chunks = [
            Chunk(
                c.message_start_time,
                c.message_end_time,
                c.chunk_start_offset,
                c.message_index_offsets,
                c,
            )
            for c in summary.chunks
            if c.message_end_time or c.message_index_offsets  # others have no messages
        ]
        usable = summary.checked or self._agrees()
        if not usable:
            self.warn(DAMAGED_INDEX)
        self._reported.clear()  # damage is reported when the chunk is read
        self.damaged = False
        return usable

    def _forget_channels(self) -> None:
        super()._forget_channels()
        self._schemas = {}

    def _record_at(self, position: int) -> Record | None:
        with suppress(TruncatedError):
            return next(walk(self._file, position, self._size), None)
        return None

    def _read_profile(self) -> str:
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            msg = "does not begin like an MCAP file"
            raise RecordingError(msg)
        try:
            first = next(walk(self._file, len(MAGIC), self._size))
            return str(parse(records.Header.read, self.content(first)).profile)
        except (StopIteration, RecordingError):
            self.warn("the header is damaged")
            return ""

    def _scan(self) -> Record | None:
        last: Record | None = super()._scan()
        if last is not None and last.opcode in _END:
            if DAMAGED_INDEX not in self.warnings:
                self.warn("no index: messages are read in file order")
            return last
        end = len(MAGIC)  # of the last whole record
        if last is not None:
            end = last.offset + last.length if last.whole else last.offset - 9
        self._file.seek(max(end, self._size - len(MAGIC)))
        finished = self._file.read() == MAGIC
        text = "the recording is damaged" if finished else "the recording was not finished"
        text += f"; messages recovered: {self._counts.total()}"
        if end < self._size:
            state = "damaged" if finished else "truncated"
            text += f"; the last {self._size - end} bytes are {state}, and read where possible"
        self.warn(text)
        return last

    def _records(self) -> Iterator[Record]:
        """Yield the records up to the end of the data, including a truncated chunk."""
        try:
            for record in walk(self._file, len(MAGIC), self._size):
                yield record
                if record.opcode in _END:
                    return
        except TruncatedError as error:
            if error.record is not None and error.record.opcode == Opcode.CHUNK:
                yield error.record

    def _expand(self, record: Record | None) -> Iterator[RawMessage]:
        """Yield the messages of a top-level record; store its channels if there is no index."""
        if record is None:
            return
        if record.opcode == Opcode.CHUNK:
            yield from self._split(record)
        elif record.opcode in _READ_OUTSIDE_CHUNKS or record.opcode not in _KNOWN:
            try:
                yield from self._take(record.opcode, memoryview(self.content(record)))
            except ChunkError as error:
                self.warn(f"skipped a record at byte {record.offset}: {error}")

    def _split(self, record: Record, end: int | None = None) -> Iterator[RawMessage]:
        """Yield the messages in the first ``end`` decompressed bytes of a chunk; None for all.

        They end at damage or truncation, with one warning per chunk.
        """
        try:
            for opcode, content in split_chunk(self._plain(record, end)):
                yield from self._take(opcode, content)
        except ChunkError as error:
            self.damaged = True
            if record.offset not in self._reported:  # warn once per chunk
                part = "" if record.whole else "the rest of "
                self.warn(f"skipped {part}the chunk at byte {record.offset - 9}: {error}")
            self._reported.add(record.offset)

    def _plain(self, record: Record, end: int | None) -> memoryview:
        """Return the decompressed records of a chunk, at most ``end`` bytes; None for all.

        A complete chunk that is read as a whole is verified the first time.
        """
        if end is not None or not record.whole:
            return read_chunk(self.content(record), end=sys.maxsize if end is None else end)
        plain = read_chunk(self.content(record), checked=record.offset in self._checked)
        self._checked.add(record.offset)
        return plain

    def _take(self, opcode: int, content: memoryview) -> Iterator[RawMessage]:
        if opcode == Opcode.MESSAGE:
            message = split_message(content)
            if message.channel_id in self._channels:
                yield message
            else:
                self.warn(
                    f"skipped messages of channel {message.channel_id}, which has no Channel record"
                )
        elif opcode not in _KNOWN:
            self.warn(f"skipped records of unknown kind {opcode}")
        elif self.indexed:
            return
        elif opcode == Opcode.SCHEMA:
            schema = parse(records.Schema.read, content)
            self._schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = parse(records.Channel.read, content)
            self._channels.setdefault(channel.id, self._channel(channel))

    def _read_chunk(
        self, chunk: Chunk, channel_ids: set[int], selection: Selection
    ) -> Iterator[RawMessage]:
        """Yield the messages of a chunk, at least up to the last needed one.

        The rest is not decompressed unless it is short: often only transforms or a few images are
        needed. If the selection has ``needed``, all messages that were not read or are damaged
        follow without data, so that frames have the same numbers whatever is needed.
        """

        def is_needed(message: IndexedMessage) -> bool:
            if selection.needed is None or message.channel_id not in channel_ids:
                return message.channel_id in channel_ids
            return selection.needed(self._channels[message.channel_id].topic, message.log_time)

        indexed, size = read_message_index(self._file, chunk.entry), chunk.entry.uncompressed_size
        self.damaged |= bool(chunk.channel_ids and not indexed)
        last = max((m.place for m in indexed if is_needed(m)), default=-1)
        end = min((m.place for m in indexed if m.place > last), default=size)
        if end > _PART * size:
            end = size
        count = 0
        if last >= 0 or not indexed:
            record = self._record_at(chunk.position)
            if record is None or record.opcode != Opcode.CHUNK:
                self.damaged = True
                self.warn(f"no chunk at byte {chunk.position}, where the index has one")
            else:
                for message in self._split(record, end if end < size else None):
                    count += 1
                    yield message
        if selection.needed is not None:
            described = [m for m in indexed if m.channel_id in self._channels]
            for number, time, _ in sorted(described, key=attrgetter("place"))[count:]:
                yield RawMessage(number, 0, time, time, memoryview(b""))

    def _channel(self, channel: records.Channel) -> Channel:
        schema = self._schemas.get(channel.schema_id)
        name, encoding, text = (schema.name, schema.encoding, schema.data) if schema else _NONE
        ros = channel.message_encoding in {"cdr", "ros1"}
        return Channel(
            channel.topic,
            ros_type(name) if ros else name,
            channel.message_encoding,
            name,
            encoding,
            text,
            tuple(channel.metadata.items()),
        )


_NONE = ("", "", b"")
_KNOWN = {int(opcode) for opcode in Opcode} | set(range(128, 256))
"""Opcodes that cause no warning. The MCAP specification leaves 128 to 255 to applications."""
_END = (Opcode.DATA_END, Opcode.FOOTER)
"""Opcodes of the records that end the data."""
_READ_OUTSIDE_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Opcodes of the records whose content is also read outside chunks."""
