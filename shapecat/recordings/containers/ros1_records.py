"""Records of a ROS 1 bag; every length field is checked before use.

The layout follows bag format 2.0: every record is a header of named fields, then data, both
preceded by their 32-bit length. https://wiki.ros.org/Bags/Format/2.0
"""

import bz2
import struct
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]  # ships no types

from shapecat.errors import RecordingError

__all__ = [
    "BAG_HEADER",
    "CHUNK",
    "CHUNK_INFO",
    "CONNECTION",
    "MAGIC",
    "MESSAGE",
    "BagError",
    "Record",
    "expand",
    "fields_of",
    "split",
    "time_of",
    "u4",
    "u8",
    "walk",
]

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 5, 6, 7
"""Opcodes of records."""

_LENGTH = struct.Struct("<I")
_LONG = struct.Struct("<Q")
_TIME = struct.Struct("<II")
_LONGEST_HEADER = 1 << 20
"""Longest header that is read, bytes; a longer one counts as damaged."""
_FREELY = 256 << 20
"""A chunk may have a decompressed size of up to this many bytes, whatever its compressed size."""
_RATIO = 1000
"""A chunk may also have a decompressed size of up to this multiple of its compressed size."""


class BagError(RecordingError):
    """A record is damaged, or extends beyond the end of the file or chunk.

    ``record`` is the readable part of a truncated record of the file, if its header is readable;
    otherwise None.
    """

    def __init__(self, message: str, record: "Record | None" = None) -> None:
        """Store the truncated record."""
        super().__init__(message)
        self.record = record


class Record(NamedTuple):
    """The header fields of a record, and byte offsets in the file.

    The record begins at ``start``; its data extends from ``begin`` to ``end``.
    """

    fields: dict[str, bytes]
    start: int
    begin: int
    end: int

    @property
    def op(self) -> int:
        """The opcode of the record; 0 if it has none."""
        return (self.fields.get("op") or b"\0")[0]


def fields_of(header: bytes | memoryview) -> dict[str, bytes]:
    """Read the named fields of a header.

    Raises
    ------
    BagError : the header is damaged.
    """
    fields, at, data = {}, 0, bytes(header)
    while at < len(data):
        size = _LENGTH.unpack_from(data, at)[0] if at + 4 <= len(data) else len(data)
        name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not equals or at > len(data):
            msg = "damaged record header"
            raise BagError(msg)
        fields[name.decode("latin-1")] = value
    return fields


def u4(fields: dict[str, bytes], name: str) -> int:
    """Return an unsigned 32-bit field.

    Raises
    ------
    BagError : the field is missing or has the wrong size.
    """
    return int(_unpack(_LENGTH, fields, name)[0])


def u8(fields: dict[str, bytes], name: str) -> int:
    """Return an unsigned 64-bit field.

    Raises
    ------
    BagError : the field is missing or has the wrong size.
    """
    return int(_unpack(_LONG, fields, name)[0])


def time_of(fields: dict[str, bytes], name: str = "time") -> int:
    """Return a time field in nanoseconds.

    Raises
    ------
    BagError : the field is missing or has the wrong size.
    """
    seconds, nanoseconds = _unpack(_TIME, fields, name)
    return int(seconds) * 10**9 + int(nanoseconds)


def _unpack(layout: struct.Struct, fields: dict[str, bytes], name: str) -> tuple[Any, ...]:
    value = fields.get(name, b"")
    if len(value) != layout.size:
        msg = f"record without a field {name}"
        raise BagError(msg)
    return layout.unpack(value)


def walk(file: BinaryIO, start: int, end: int) -> Iterator[Record]:
    """Yield the records of a file between two offsets, without their data.

    Raises
    ------
    BagError : a record is damaged or extends beyond ``end``.
    """
    while start < end:
        file.seek(start)
        size = _length(file.read(4))
        header = file.read(size) if size is not None and size <= _LONGEST_HEADER else b""
        length = _length(file.read(4))
        if size is None or len(header) != size or length is None:
            msg = f"truncated or damaged at byte {start}"
            raise BagError(msg)
        begin = start + 8 + size
        try:
            fields = fields_of(header)
        except BagError as error:
            msg = f"{error} at byte {start}"
            raise BagError(msg) from error
        record = Record(fields, start, begin, begin + length)
        if record.end > end:
            msg = f"truncated in the record at byte {start}"
            raise BagError(msg, record._replace(end=end))
        yield record
        start = record.end


def _length(data: bytes) -> int | None:
    return int(_LENGTH.unpack(data)[0]) if len(data) == 4 else None


def split(chunk: memoryview) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    """Yield the header fields and the data of each record in a decompressed chunk.

    Raises
    ------
    BagError : a record is damaged or extends beyond the chunk.
    """
    at, end = 0, len(chunk)
    while at < end:
        size = _length(bytes(chunk[at : at + 4]))
        length = None if size is None else _length(bytes(chunk[at + 4 + size : at + 8 + size]))
        if size is None or length is None or at + 8 + size + length > end:
            msg = "truncated or damaged record in a chunk"
            raise BagError(msg)
        begin = at + 8 + size
        yield fields_of(chunk[at + 4 : at + 4 + size]), chunk[begin : begin + length]
        at = begin + length


def expand(record: Record, data: bytes) -> tuple[memoryview, str]:
    """Decompress a chunk: a truncated one as far as possible, a damaged one not at all.

    Returns
    -------
    The decompressed data, and the reason why some is missing; empty if the chunk is complete.
    """
    method = record.fields.get("compression", b"").decode("latin-1")
    if method == "none":
        return memoryview(data), ""
    if method not in _DECOMPRESSORS:
        return memoryview(b""), f"compression {method!r} is not supported"
    worker, limit = _DECOMPRESSORS[method](), max(_FREELY, _RATIO * len(data))
    try:
        plain = memoryview(worker.decompress(data, max_length=limit))
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        return memoryview(b""), f"damaged: {error}"
    if len(plain) >= limit:
        return memoryview(b""), f"{len(data)} bytes hold more than {limit}"
    return plain, "" if worker.eof else "truncated"


_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
}
