"""Records of an MCAP file; every length field is checked before use.

The layout follows the MCAP specification: every record is an opcode, a 64-bit length, and its
content. `mcap.records` parses the small records; messages are sliced without a copy.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeVar

import lz4.frame  # type: ignore[import-untyped]  # ships no types
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from shapecat.errors import RecordingError
from shapecat.recordings.containers.chunked import RawMessage

__all__ = [
    "MAGIC",
    "ChunkError",
    "Opcode",
    "Record",
    "TruncatedError",
    "parse",
    "read_chunk",
    "read_content",
    "split_chunk",
    "split_message",
    "walk",
]

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
"""Head of a record: opcode, and length of its content in bytes."""
_CHUNK = struct.Struct("<QQQII")
"""Head of a chunk: start and end time, decompressed size, CRC, length of the compression's name."""
_MESSAGE = struct.Struct("<HIQQ")
"""Head of a message: channel id, sequence number, log time and publish time in nanoseconds."""
_FREELY = 256 << 20
"""A chunk may claim a decompressed size of up to this many bytes, whatever its compressed size."""
_RATIO = 1000
"""A chunk may also claim a decompressed size of up to this multiple of its compressed size."""

_T = TypeVar("_T")


class TruncatedError(RecordingError):
    """The file ends inside a record, or a record claims to be longer than the file.

    ``record`` is the truncated record; None if not even its opcode and length are complete.
    """

    def __init__(self, message: str, record: "Record | None" = None) -> None:
        """Store the truncated record."""
        super().__init__(message)
        self.record = record


class ChunkError(RecordingError):
    """A chunk or record is damaged, or its sizes are not plausible."""


class Record(NamedTuple):
    """Opcode of a record; offset and length of its content, bytes.

    ``whole`` is False if the record is truncated.
    """

    opcode: int
    offset: int
    length: int
    whole: bool = True


def walk(file: BinaryIO, offset: int, end: int) -> Iterator[Record]:
    """Yield the records between two offsets, without their content.

    Raises
    ------
    TruncatedError : a record extends beyond ``end``.
    """
    while offset < end:
        file.seek(offset)
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, end)
        content = offset + _HEAD.size
        if length > end - content:
            msg = f"truncated in the record at byte {offset}"
            partial_record = Record(opcode, content, end - content, whole=False)
            raise TruncatedError(msg, partial_record if len(head) == _HEAD.size else None)
        yield Record(opcode, content, length)
        offset = content + length


def read_content(file: BinaryIO, record: Record) -> bytes:
    """Read the content of a record that `walk` has checked."""
    file.seek(record.offset)
    return file.read(record.length)


def parse(read: Callable[[ReadDataStream], _T], content: bytes | memoryview) -> _T:
    """Parse a small record with the ``read`` method of its class in `mcap.records`.

    Raises
    ------
    ChunkError : the record is damaged.
    """
    try:
        return read(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, ValueError) as error:
        msg = f"damaged record: {str(error) or type(error).__name__}"
        raise ChunkError(msg) from error


def read_chunk(content: bytes, *, end: int | None = None, checked: bool = False) -> memoryview:
    """Return the decompressed records of a chunk, given the content of its record.

    Parameters
    ----------
    end : decompress at most this many bytes, and do not verify the chunk; None to decompress and
        verify all of it.
    checked : whether the checksum was verified earlier, so that it need not be verified again.

    Raises
    ------
    ChunkError : the chunk is damaged, its sizes are not plausible, or its compression is unknown.
    """
    try:
        _, _, size, crc, name_length = _CHUNK.unpack_from(content)
        name_end = _CHUNK.size + name_length
        compression = bytes(content[_CHUNK.size : name_end]).decode("ascii")
        (length,) = struct.unpack_from("<Q", content, name_end)
    except (struct.error, UnicodeDecodeError) as error:
        msg = "damaged chunk header"
        raise ChunkError(msg) from error
    data = memoryview(content)[name_end + 8 :][:length]
    if size > max(_FREELY, _RATIO * len(data)):
        msg = f"chunk of {len(data)} bytes claims to hold {size}"
        raise ChunkError(msg)
    if compression not in _DECOMPRESS:
        msg = f"chunk compression {compression!r} is not supported"
        raise ChunkError(msg)
    if end is not None:
        return _decompress(_DECOMPRESS_PART[compression], data, min(end, size))[:end]
    if len(data) != length:
        msg = f"chunk claims {length} bytes and has {len(data)}"
        raise ChunkError(msg)
    plain = _decompress(_DECOMPRESS[compression], data, size)
    if len(plain) != size or (crc and not checked and zlib.crc32(plain) != crc):
        msg = "damaged chunk: its checksum does not match"
        raise ChunkError(msg)
    return plain


def _decompress(
    method: Callable[[memoryview, int], bytes | memoryview], data: memoryview, size: int
) -> memoryview:
    """Decompress ``data`` to ``size`` bytes with a method of `_DECOMPRESS` or `_DECOMPRESS_PART`.

    Raises
    ------
    ChunkError : the data is damaged.
    """
    try:
        return memoryview(method(data, size))
    except (RuntimeError, ValueError, EOFError, MemoryError, zstandard.ZstdError) as error:
        msg = f"damaged chunk: {error}"
        raise ChunkError(msg) from error


def _zstd(data: memoryview, size: int) -> bytes:
    # The library allocates what the frame claims, so compare that first.
    claimed = zstandard.frame_content_size(data)
    if claimed not in {-1, size}:
        msg = f"{claimed} bytes where the header says {size}"
        raise ValueError(msg)
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""


def _lz4(data: memoryview, size: int) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size or 1))


def _plain(data: memoryview, _size: int) -> memoryview:
    return data


_DECOMPRESS: dict[str, Callable[[memoryview, int], bytes | memoryview]] = {
    "": _plain,
    "none": _plain,
    "lz4": _lz4,
    "zstd": _zstd,
}


def _zstd_part(data: memoryview, size: int) -> bytes:
    return zstandard.ZstdDecompressor().stream_reader(data).read(size) if size else b""


_DECOMPRESS_PART = _DECOMPRESS | {"zstd": _zstd_part}
"""Decompressors that also accept truncated data, as those for LZ4 always do."""


def split_chunk(chunk: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield the opcode and the content of each record in a decompressed chunk.

    Raises
    ------
    ChunkError : a record extends beyond the chunk.
    """
    offset, end = 0, len(chunk)
    while offset < end:
        if end - offset < _HEAD.size:
            msg = "truncated record in a chunk"
            raise ChunkError(msg)
        opcode, length = _HEAD.unpack_from(chunk, offset)
        offset += _HEAD.size
        if length > end - offset:
            msg = f"record of {length} bytes in a chunk of {end}"
            raise ChunkError(msg)
        yield opcode, chunk[offset : offset + length]
        offset += length


def split_message(content: memoryview) -> RawMessage:
    """Split the content of a message record.

    Raises
    ------
    ChunkError : the content is too short.
    """
    if len(content) < _MESSAGE.size:
        msg = f"message record of {len(content)} bytes"
        raise ChunkError(msg)
    number, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
    return RawMessage(number, sequence, log_time, publish_time, content[_MESSAGE.size :])
