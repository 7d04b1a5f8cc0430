"""Append annotations to a copy of an MCAP file, without changing its data section."""

import errno
import os
import struct
import zlib
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, Self

import lz4.frame  # type: ignore[import-untyped]  # ships no types
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from shapecat.outputs.annotation.content import AnnotationChannel
from shapecat.recordings.containers.mcap_records import MAGIC
from shapecat.recordings.containers.mcap_summary import Summary

__all__ = ["Appender", "copy_bytes"]

_CHUNK_BYTES = 256 << 10
"""Size of the chunks; small, since a reader that sorts messages by time keeps one in memory."""
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode and length of a record; then channel, sequence, log time and publish time of a message."""
_INDEX = struct.Struct("<BQHI")
"""The head of a message index record: opcode, length, channel, and size of the entries in bytes."""
_COMPRESS = {"zstd": partial(zstandard.compress, level=1), "lz4": lz4.frame.compress}
_WAITING = 8
"""Largest number of filled chunks in memory."""


def _reserve(file: BinaryIO, length: int) -> None:
    """Reserve disk space for ``length`` bytes, and some for annotations.

    A full disk then raises an OSError early. Without reserved space, ext4 would write out the whole
    file when the file is renamed over an older one, which takes as long as the copy. Where the
    system cannot reserve space, nothing is done.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(file.fileno(), 0, length)
        with suppress(OSError):
            os.posix_fallocate(file.fileno(), length, length // 8)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.EOPNOTSUPP}:  # some file systems cannot reserve
            raise


def copy_bytes(source: Path, target: Path, length: int) -> None:
    """Copy the first ``length`` bytes of a file to the start of an existing file.

    The kernel copies them if it can. Disk space is reserved behind these bytes, too: truncate the
    target when everything is written.

    Raises
    ------
    OSError : reading or writing failed, or the file has become shorter than ``length``.
    """
    with source.open("rb") as file, target.open("r+b") as copy:
        _reserve(copy, length)
        total = 0
        try:
            while total < length:
                copied = os.copy_file_range(file.fileno(), copy.fileno(), length - total)
                if copied == 0:
                    break
                total += copied
        except OSError:
            if total:
                raise
        if total == 0:
            while block := file.read(min(1 << 20, length - total)):
                total += copy.write(block)
        if total < length:  # the rest would be zeros
            raise OSError(errno.EIO, "the recording became shorter while it was copied")


@dataclass
class _Chunk:
    """A chunk being filled."""

    data: bytearray = field(default_factory=bytearray)
    entries: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    """For each channel, the log times and offsets of its messages, alternating."""


class Appender:
    """Adds channels, messages and metadata to a data section, then writes the new summary.

    A thread compresses and writes filled chunks. Use the appender as a context manager, which ends
    this thread.

    Parameters
    ----------
    file : open for writing, positioned at the end of the original data section.
    summary : the summary of the original file.
    compression : compression of the new chunks: ``zstd`` or ``lz4``; anything else means none.
    """

    def __init__(self, file: BinaryIO, summary: Summary, compression: str) -> None:
        """Copy the summary; nothing is written yet."""
        self._file = file
        self._schemas = dict(summary.schemas)
        self._channels = dict(summary.channels)
        self._chunks = list(summary.chunks)
        self._attachments = list(summary.attachments)
        self._metadata = list(summary.metadata)
        self._original = summary.statistics
        self._compression = compression if compression in _COMPRESS else ""
        self._counts: Counter[int] = Counter()
        self._times: list[int] = []
        self._chunk = _Chunk()
        self._writer = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()

    def __enter__(self) -> Self:
        """Return this appender."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread."""
        self._writer.shutdown(cancel_futures=True)

    def add_channel(self, channel: AnnotationChannel) -> int:
        """Add a channel with its schema; return the channel number.

        Raises
        ------
        OSError : the highest possible number of a channel or schema is taken.
        """
        schema_id = max(self._schemas, default=0) + 1
        schema = records.Schema(
            id=schema_id,
            data=channel.schema,
            encoding=channel.schema_encoding,
            name=channel.schema_name,
        )
        number = max(self._channels, default=0) + 1
        added = records.Channel(
            id=number,
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=schema_id,
        )
        if max(schema_id, number) > 0xFFFF:
            msg = "the recording has no free channel number"
            raise OSError(msg)
        self._schemas[schema_id], self._channels[number] = schema, added
        self._chunk.data += _encoded([schema, added])
        return number

    def add_message(self, channel: int, log_time: int, sequence: int, data: bytes) -> None:
        """Add a message; ``log_time``, in nanoseconds, is also its publish time."""
        chunk = self._chunk
        chunk.entries[channel] += (log_time, len(chunk.data))
        length = _MESSAGE.size - _RECORD.size + len(data)
        chunk.data += _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_time, log_time)
        chunk.data += data
        if len(chunk.data) >= _CHUNK_BYTES:
            self._flush(_WAITING)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._flush(0)
        offset = self._file.tell()
        length = self._write([records.Metadata(name=name, metadata=dict(values))])
        self._metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def finish(self) -> None:
        """Complete the file: write a summary of its whole content, and the footer."""
        self._flush(0)
        self._write([records.DataEnd(0)])
        start = self._file.tell()
        body, groups = bytearray(), []
        for opcode, encoded in self._groups():
            if encoded:
                groups.append(records.SummaryOffset(opcode, start + len(body), len(encoded)))
                body += encoded
        offsets = start + len(body)
        body += _encoded(groups)
        footer = RecordBuilder()
        records.Footer(start, offsets, 0).write(footer)
        # The checksum covers the summary and the footer up to the checksum itself.
        crc = zlib.crc32(footer.end()[:-4], zlib.crc32(body))
        self._file.write(body)
        self._write([records.Footer(start, offsets, crc)])
        self._file.write(MAGIC)

    def _groups(self) -> list[tuple[Opcode, bytes]]:
        original = [] if self._original is None else [self._original]
        return [
            (Opcode.SCHEMA, _encoded(self._schemas.values())),
            (Opcode.CHANNEL, _encoded(self._channels.values())),
            (Opcode.STATISTICS, _encoded(map(self._statistics, original))),
            (Opcode.CHUNK_INDEX, _encoded(self._chunks)),
            (Opcode.ATTACHMENT_INDEX, _encoded(self._attachments)),
            (Opcode.METADATA_INDEX, _encoded(self._metadata)),
        ]

    def _statistics(self, old: records.Statistics) -> records.Statistics:
        times = [*self._times]
        if old.message_count:
            times += [old.message_start_time, old.message_end_time]
        return replace(
            old,
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            metadata_count=old.metadata_count + 1,
            chunk_count=len(self._chunks),
            message_count=old.message_count + self._counts.total(),
            message_start_time=min(times, default=0),
            message_end_time=max(times, default=0),
            channel_message_counts={**old.channel_message_counts, **self._counts},
        )

    def _flush(self, waiting: int) -> None:
        """Submit the chunk if it has messages; wait until at most ``waiting`` are unwritten."""
        if self._chunk.entries:
            self._waiting.append(self._writer.submit(self._write_chunk, self._chunk))
            self._chunk = _Chunk()
        while len(self._waiting) > waiting:
            self._waiting.popleft().result()

    def _write_chunk(self, chunk: _Chunk) -> None:
        """Write a chunk and its index."""
        plain = bytes(chunk.data)
        data = _COMPRESS[self._compression](plain) if self._compression else plain
        times = [time for entries in chunk.entries.values() for time in entries[::2]]
        start, end = min(times), max(times)
        self._times += [start, end]
        offset = self._file.tell()
        length = self._write(
            [records.Chunk(self._compression, data, end, start, zlib.crc32(plain), len(plain))]
        )
        offsets, at = {}, self._file.tell()
        for channel, entries in chunk.entries.items():
            offsets[channel] = self._file.tell()
            self._file.write(_message_index(channel, entries))
            self._counts[channel] += len(entries) // 2
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=length,
                chunk_start_offset=offset,
                compression=self._compression,
                compressed_size=len(data),
                message_end_time=end,
                message_index_length=self._file.tell() - at,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(plain),
            )
        )

    def _write(self, items: Iterable[records.McapRecord]) -> int:
        return self._file.write(_encoded(items))


def _message_index(channel: int, entries: Sequence[int]) -> bytes:
    """Encode a message index record; the library would take a microsecond per number.

    ``entries`` are log times and offsets, alternating.
    """
    size = 8 * len(entries)
    numbers = struct.pack(f"<{len(entries)}Q", *entries)
    return _INDEX.pack(Opcode.MESSAGE_INDEX, 2 + 4 + size, channel, size) + numbers


def _encoded(items: Iterable[records.McapRecord]) -> bytes:
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return bytes(builder.end())
