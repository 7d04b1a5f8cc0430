"""Read and check the summary section of an MCAP file."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap import records

from shapecat.errors import RecordingError
from shapecat.recordings.containers.mcap_records import (
    MAGIC,
    Opcode,
    TruncatedError,
    parse,
    read_content,
    walk,
)

__all__ = ["DAMAGED_INDEX", "Summary", "read_summary"]

DAMAGED_INDEX = "the index is damaged: reading the file from beginning to end instead"
"""A warning for the user."""

_FOOTER = 9 + 20
"""Size of the footer record, bytes: its head and its content."""


@dataclass
class Summary:
    """The summary of a file.

    ``data_end`` is the byte offset at which the data ends; ``checked`` says whether the checksum of
    the summary was verified, and is False if it has none.
    """

    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    chunks: list[records.ChunkIndex] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    statistics: records.Statistics | None = None
    data_end: int = 0
    checked: bool = False


def read_summary(file: BinaryIO, size: int, warn: Callable[[str], None]) -> Summary | None:
    """Read the summary section; return None if it is missing, damaged or incomplete.

    Parameters
    ----------
    size : size of the file, bytes.
    warn : receives warnings for the user.
    """
    footer_at = size - _FOOTER - len(MAGIC)
    if footer_at < len(MAGIC):
        return None
    file.seek(footer_at)
    tail = file.read()
    if tail[-len(MAGIC) :] != MAGIC or tail[0] != Opcode.FOOTER:
        return None
    try:
        footer = parse(records.Footer.read, tail[9:_FOOTER])
        start = footer.summary_start
        if not len(MAGIC) < start <= footer_at:
            return None
        if footer.summary_crc and footer.summary_crc != _checksum(file, size, start):
            warn(DAMAGED_INDEX)
            return None
        summary = _collect(file, start, footer_at)
        summary.data_end = _find_data_end(file, summary, start)
        summary.checked = footer.summary_crc != 0
    except RecordingError:
        warn(DAMAGED_INDEX)
        return None
    return summary if _is_complete(summary) else None


def _checksum(file: BinaryIO, size: int, start: int) -> int:
    """Return the checksum of the summary and of the footer up to its checksum field.

    ``start`` is the offset of the summary, ``size`` the size of the file.
    """
    crc, left = 0, size - len(MAGIC) - 4 - start
    file.seek(start)
    while left > 0:
        block = file.read(min(left, 1 << 20))
        crc, left = zlib.crc32(block, crc), left - max(1, len(block))
    return crc


def _collect(file: BinaryIO, start: int, end: int) -> Summary:
    """Read the records of the summary section, which extends from ``start`` to ``end`` (bytes)."""
    summary = Summary()
    for record in walk(file, start, end):
        content = read_content(file, record)
        match record.opcode:
            case Opcode.SCHEMA:
                schema = parse(records.Schema.read, content)
                summary.schemas[schema.id] = schema
            case Opcode.CHANNEL:
                channel = parse(records.Channel.read, content)
                summary.channels[channel.id] = channel
            case Opcode.CHUNK_INDEX:
                summary.chunks.append(parse(records.ChunkIndex.read, content))
            case Opcode.ATTACHMENT_INDEX:
                summary.attachments.append(parse(records.AttachmentIndex.read, content))
            case Opcode.METADATA_INDEX:
                summary.metadata.append(parse(records.MetadataIndex.read, content))
            case Opcode.STATISTICS:
                summary.statistics = parse(records.Statistics.read, content)
    return summary


def _find_data_end(file: BinaryIO, summary: Summary, summary_start: int) -> int:
    """Return the offset of the first data end record after the last indexed record.

    Raises
    ------
    TruncatedError : there is none, or a record extends beyond ``summary_start``.
    """
    ends = [c.chunk_start_offset + c.chunk_length for c in summary.chunks]
    ends += [item.offset + item.length for item in (*summary.attachments, *summary.metadata)]
    for record in walk(file, max(ends, default=len(MAGIC)), summary_start):
        if record.opcode == Opcode.DATA_END:
            return record.offset - 9
    msg = "no data end record"
    raise TruncatedError(msg)


def _is_complete(summary: Summary) -> bool:
    """Return whether the summary alone locates and counts every message."""
    statistics = summary.statistics
    if statistics is None:
        return False
    numbers = {number for c in summary.chunks for number in c.message_index_offsets}
    numbers |= {n for n, count in statistics.channel_message_counts.items() if count}
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    named = numbers <= summary.channels.keys() and schemas <= summary.schemas.keys()
    empty = statistics.message_count == 0
    listed = len(summary.chunks) >= max(statistics.chunk_count, not empty)
    return named and bool(summary.channels or empty) and listed
