"""Read the index of the messages in a chunk of an MCAP file."""

import struct
from itertools import chain
from typing import BinaryIO, NamedTuple

from mcap import records

from shapecat.recordings.containers.mcap_records import TruncatedError, read_content, walk

__all__ = ["IndexedMessage", "read_message_index"]

_HEAD = struct.Struct("<HI")
"""Head of a message index: channel id, and size of all entries in bytes."""
_ENTRY = struct.Struct("<QQ")
"""Entry of a message index: log time, and offset of the message in the decompressed chunk."""


class IndexedMessage(NamedTuple):
    """The index entry of a message.

    ``log_time`` is in nanoseconds; ``place`` is the byte offset in the decompressed chunk.
    """

    channel_id: int
    log_time: int
    place: int


def read_message_index(file: BinaryIO, chunk: records.ChunkIndex) -> list[IndexedMessage]:
    """Return the index entries of a chunk; empty if one is damaged or a channel is missing.

    Entries have no checksum. One counts as damaged if its time or offset lies outside the chunk.
    """
    begin = chunk.chunk_start_offset + chunk.chunk_length
    entries_of: dict[int, list[IndexedMessage]] = {}
    try:
        for record in walk(file, begin, begin + chunk.message_index_length):
            content = read_content(file, record)
            channel, length = _HEAD.unpack_from(content)
            pairs = _ENTRY.iter_unpack(content[_HEAD.size :][:length])
            entries_of[channel] = [IndexedMessage(channel, time, place) for time, place in pairs]
    except (TruncatedError, struct.error):
        return []
    entries = list(chain(*entries_of.values()))
    start, end = chunk.message_start_time, chunk.message_end_time
    size = chunk.uncompressed_size
    plausible = all(start <= time <= end and place < size for _, time, place in entries)
    complete = entries_of.keys() == chunk.message_index_offsets.keys()
    return entries if complete and plausible else []
