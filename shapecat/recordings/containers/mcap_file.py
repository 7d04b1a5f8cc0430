"""Read MCAP files: by time if they are indexed, otherwise in file order.

Damage does not stop reading: a truncated file is read as far as possible, a damaged chunk is
skipped, and a warning reports either.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

from mcap import records

from shapecat.errors import RecordingError
from shapecat.recordings.containers.mcap_index import (
    IndexedMessage,
    overlaps,
    read_message_index,
    unread,
)
from shapecat.recordings.containers.mcap_records import (
    MAGIC,
    ChunkError,
    Opcode,
    RawMessage,
    Record,
    TruncatedError,
    parse,
    read_chunk,
    read_content,
    read_cut_chunk,
    split_chunk,
    split_message,
    walk,
)
from shapecat.recordings.containers.mcap_summary import Summary, read_summary
from shapecat.recordings.containers.message_compression import decompressed
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

__all__ = ["McapRecording"]

_PART = 0.9
"""If more than this share of a chunk is needed, the whole chunk is decompressed and verified."""


class McapRecording(Recording):
    """An MCAP file.

    Attributes
    ----------
    indexed : the file is finished, and its index is complete.
    summary : schemas, channels and indexes.
    profile : ``ros2``, ``ros1`` or empty.
    """

    kind: ClassVar[str] = "mcap"

    def __init__(self, path: Path) -> None:
        """Open the file and read its summary, or scan it without one.

        Raises
        ------
        RecordingError : the file is not MCAP.
        OSError : the file cannot be read.
        """
        super().__init__(path)
        self._file = path.open("rb")
        try:
            self._size = self._file.seek(0, 2)
            self.profile = self._read_profile()
            summary = read_summary(self._file, self._size, self.warn)
            self.indexed = summary is not None
            self.summary = summary or Summary()
            self._counts: Counter[int] | None = None
            self._checked: set[int] = set()  # offsets of chunks with a verified checksum
            self._times: list[int] = []
            if summary is None:
                self._scan()
            else:
                self._describe()
        except BaseException:
            self._file.close()
            raise
        self._channels = {
            number: self._channel(channel) for number, channel in self.summary.channels.items()
        }
        self.topics = self._list_topics()
        if self._times:
            self.start_ns, self.end_ns = min(self._times), max(self._times)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, selection: Selection) -> Iterator[Message]:
        channel_ids = {n for n, c in self._channels.items() if selection.has_topic(c.topic)}
        raw = self._by_time(channel_ids, selection) if self.indexed else self._in_file(channel_ids)
        for message in raw:
            if not selection.has_time(message.log_time):
                continue
            channel = self._channels[message.channel_id]
            data: bytes | memoryview | None
            if selection.needed and not selection.needed(channel.topic, message.log_time):
                data = b""
            else:
                data = decompressed(self, channel, message.data)
                if data is None:
                    continue
                data = detached(data)
            yield Message(channel, message.log_time, message.publish_time, message.sequence, data)

    def top_level(self) -> Iterator[Record]:
        """Yield the complete records of the data section, without their content."""
        try:
            for record in walk(self._file, len(MAGIC), self._size):
                if record.opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                    return
                yield record
        except TruncatedError:
            return

    def content(self, record: Record) -> bytes:
        """Read the content of a record from `top_level`."""
        return read_content(self._file, record)

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

    def _describe(self) -> None:
        """Take counts and times from the index."""
        statistics = self.summary.statistics
        if statistics is not None:
            self._counts = Counter(statistics.channel_message_counts)
        for chunk in self.summary.chunks:
            if chunk.message_end_time or chunk.message_index_offsets:  # else it has no messages
                self._times += [chunk.message_start_time, chunk.message_end_time]

    def _scan(self) -> None:
        """Read the whole file to find its channels, counts and times."""
        self._counts = Counter()
        end, finished = len(MAGIC), False
        low = high = None
        for record in self._records():
            finished = record.opcode in {Opcode.DATA_END, Opcode.FOOTER}
            if finished:
                break
            for message in self._expand(record):
                self._counts[message.channel_id] += 1
                time = message.log_time
                low = time if low is None else min(low, time)
                high = time if high is None else max(high, time)
            end = record.offset + record.length if record.whole else end
        if low is not None and high is not None:
            self._times = [low, high]
        if finished:
            self.warn("no index: messages are read in file order")
        else:
            lost = self._size - end
            self.warn(
                f"the recording was not finished; messages recovered: {self._counts.total()}"
                + (
                    f"; the last {lost} bytes are truncated, and read where possible"
                    if lost
                    else ""
                )
            )

    def _in_file(self, channel_ids: set[int]) -> Iterator[RawMessage]:
        for record in self._records():
            if record.opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                return
            yield from (m for m in self._expand(record) if m.channel_id in channel_ids)

    def _records(self) -> Iterator[Record]:
        """Yield the records of the file; a truncated last chunk is cut to its readable part."""
        try:
            yield from walk(self._file, len(MAGIC), self._size)
        except TruncatedError as error:
            if error.record is not None and error.record.opcode == Opcode.CHUNK:
                yield error.record

    def _expand(self, record: Record) -> Iterator[RawMessage]:
        """Yield the messages of a top-level record; store its schemas and channels."""
        if record.opcode == Opcode.CHUNK:
            yield from self._chunk(record)
        elif record.opcode in _DEFINING or record.opcode not in _KNOWN:
            try:
                yield from self._take(record.opcode, memoryview(self.content(record)))
            except ChunkError as error:
                self.warn(f"skipped a record at byte {record.offset}: {error}")

    def _chunk(self, record: Record, end: int | None = None) -> Iterator[RawMessage]:
        """Yield the messages of a chunk up to its end, its truncation, or the byte ``end``."""
        try:
            for opcode, content in split_chunk(self._plain(record, end)):
                yield from self._take(opcode, content)
        except ChunkError as error:
            part = "" if record.whole else "the rest of "
            self.warn(f"skipped {part}the chunk at byte {record.offset - 9}: {error}")

    def _plain(self, record: Record, end: int | None) -> memoryview:
        """Return the decompressed records of a chunk; verify its checksum the first time."""
        if not record.whole:
            return read_cut_chunk(self.content(record))
        if end is not None:
            return read_chunk(self.content(record), end=end)
        plain = read_chunk(self.content(record), checked=record.offset in self._checked)
        self._checked.add(record.offset)
        return plain

    def _take(self, opcode: int, content: memoryview) -> Iterator[RawMessage]:
        if opcode == Opcode.MESSAGE:
            message = split_message(content)
            if message.channel_id in self.summary.channels:
                yield message
            else:
                self.warn(
                    f"skipped messages of channel {message.channel_id}, which is not described"
                )
        elif opcode not in _DEFINING and opcode not in _KNOWN:
            self.warn(f"skipped records of unknown kind {opcode}")
        elif self.indexed:
            return
        elif opcode == Opcode.SCHEMA:
            schema = parse(records.Schema.read, content)
            self.summary.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = parse(records.Channel.read, content)
            self.summary.channels.setdefault(channel.id, channel)

    def _by_time(self, channel_ids: set[int], selection: Selection) -> Iterator[RawMessage]:
        """Yield the messages of all chunks by log time, in file order if times are equal."""
        chunks = [
            (c.message_start_time, c.chunk_start_offset, c)
            for c in self.summary.chunks
            if overlaps(c, channel_ids, selection.start_ns, selection.stop_ns)
        ]

        def is_needed(message: IndexedMessage) -> bool:
            if selection.needed is None or message.channel_id not in channel_ids:
                return message.channel_id in channel_ids
            return selection.needed(self._channels[message.channel_id].topic, message.log_time)

        def read(chunk: records.ChunkIndex) -> Iterator[tuple[Timed, RawMessage]]:
            for message in self._indexed_chunk(chunk, is_needed):
                if message.channel_id in channel_ids:
                    yield Timed(message.log_time, len(message.data)), message

        yield from in_time_order(chunks, read)

    def _indexed_chunk(
        self, chunk: records.ChunkIndex, needed: Callable[[IndexedMessage], bool]
    ) -> Iterator[RawMessage]:
        """Yield the messages of a chunk; those after the last needed one have no data.

        Reading only transforms, or few images of many, then decompresses little.
        """
        indexed = read_message_index(self._file, chunk)
        last = max((m.place for m in indexed if needed(m)), default=-1)
        end = min((m.place for m in indexed if m.place > last), default=chunk.uncompressed_size)
        if end > _PART * chunk.uncompressed_size:
            end = chunk.uncompressed_size
        if last >= 0 or not indexed:
            yield from self._chunk_at(chunk, end)
        yield from (unread(message) for message in indexed if message.place >= end)

    def _chunk_at(self, chunk: records.ChunkIndex, end: int) -> Iterator[RawMessage]:
        try:
            record = next(walk(self._file, chunk.chunk_start_offset, self._size))
        except (TruncatedError, StopIteration):
            record = None
        if record is None or record.opcode != Opcode.CHUNK:
            self.warn(f"no chunk at byte {chunk.chunk_start_offset}, where the index has one")
            return
        yield from self._chunk(record, end if end < chunk.uncompressed_size else None)

    def _channel(self, channel: records.Channel) -> Channel:
        schema = self.summary.schemas.get(channel.schema_id)
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

    def _list_topics(self) -> tuple[Topic, ...]:
        counts = self._counts
        return sum_topics(
            Topic(c.topic, c.type, c.encoding, None if counts is None else counts[number])
            for number, c in self._channels.items()
        )


_NONE = ("", "", b"")
_KNOWN = {int(opcode) for opcode in Opcode} | set(range(128, 256))
"""Opcodes that cause no warning; 128 to 255 are for private use."""
_DEFINING = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
