"""PNG files."""

import struct
import zlib
from functools import lru_cache

import numpy as np

from shapecat.arrays import U1, U2

__all__ = ["png"]

_ADLER = 65521
"""Modulus of the sums of Adler-32, the checksum at the end of zlib data (RFC 1950)."""
_COLOUR_TYPES = {"grey": 0, "palette": 3}


def png(
    image: U1 | U2,
    palette: U1 | None = None,
    alpha: U1 | None = None,
    *,
    level: int = 9,
    width: int | None = None,
) -> bytes:
    """Encode an image as PNG.

    Parameters
    ----------
    image : (h, w) grey values, uint16 or uint8; with a palette, its uint8 indices.
    palette : (k, 3) red, green, blue.
    alpha : (a,) opacity of the first entries of the palette.
    level : compression from 1 (fast) to 9 (small).
    width : if given, ``image`` is already packed two 4-bit pixels per byte, left pixel in the high
        nibble, and this is the image width in pixels.
    """
    packed, height, width = width is not None, len(image), width or image.shape[1]
    wide = image.dtype == np.uint16
    rows = np.ascontiguousarray(image, ">u2" if wide else "u1").view(np.uint8).reshape(height, -1)
    unfiltered = np.zeros((height, 1), np.uint8)  # filter type of each row: none
    kind = _COLOUR_TYPES["grey" if palette is None else "palette"]
    depth = 16 if wide else 4 if packed else 8
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    parts = [(b"IHDR", header)]
    if palette is not None:
        parts.append((b"PLTE", np.ascontiguousarray(palette, np.uint8).tobytes()))
    if alpha is not None:
        parts.append((b"tRNS", np.ascontiguousarray(alpha, np.uint8).tobytes()))
    pixels = np.concatenate([unfiltered, rows], axis=1)
    parts += [(b"IDAT", _compressed(pixels, level)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in parts
    )


def _compressed(rows: U1, level: int) -> bytes:
    """Compress rows (h, n) as zlib data; level 1 encodes only runs of equal bytes.

    This suits masks. Compressed blank rows, at the top and bottom of most masks, are cached.
    """
    if level > 1:
        return zlib.compress(rows.tobytes(), level)
    drawn, size = np.flatnonzero(rows.max(axis=1)), rows.shape[1]
    first, last = (int(drawn[0]), int(drawn[-1]) + 1) if drawn.size else (0, 0)
    before, after = first * size, (len(rows) - last) * size
    middle = rows[first:last].tobytes()
    high, low = divmod(zlib.adler32(middle), 1 << 16)
    high = (high + before + after * low) % _ADLER  # each zero byte adds the low sum to the high one
    parts = _blank(before, zlib.Z_FULL_FLUSH), _deflated(middle, zlib.Z_FULL_FLUSH)
    end = _blank(after, zlib.Z_FINISH), struct.pack(">HH", high, low)
    return b"".join((b"\x78\x01", *parts, *end))


@lru_cache(maxsize=1024)
def _blank(count: int, flush: int) -> bytes:
    """Return ``count`` zero bytes as raw deflate data, ended by a flush mode of zlib."""
    return _deflated(bytes(count), flush)


def _deflated(data: bytes, flush: int) -> bytes:
    packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS, strategy=zlib.Z_RLE)
    return packer.compress(data) + packer.flush(flush)
