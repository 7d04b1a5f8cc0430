"""PNG files."""

import struct
import zlib

import numpy as np

from shapecat.arrays import U1, U2

__all__ = ["png", "with_palette"]

_COLOUR_TYPES = {"grey": 0, "palette": 3}


def png(
    image: U1 | U2,
    palette: U1 | None = None,
    alpha: U1 | None = None,
    *,
    level: int = 9,
) -> bytes:
    """Encode an image as PNG.

    Parameters
    ----------
    image : (h, w) grey values, uint16 or uint8; with a palette, uint8 indices into it.
    palette : (k, 3) red, green, blue.
    alpha : (a,) opacity, from 0 to 255, of the first entries of the palette.
    level : compression from 1 (fast, for images with long runs, such as masks) to 9 (small).
    """
    height, width = image.shape
    wide = image.dtype == np.uint16
    rows = np.ascontiguousarray(image, ">u2" if wide else "u1").view(np.uint8).reshape(height, -1)
    unfiltered = np.zeros((height, 1), np.uint8)  # filter type of each row: none
    kind = _COLOUR_TYPES["grey" if palette is None else "palette"]
    depth = 16 if wide else 8
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    parts = [(b"IHDR", header)]
    if palette is not None:
        parts.append((b"PLTE", np.ascontiguousarray(palette, np.uint8).tobytes()))
    if alpha is not None:
        parts.append((b"tRNS", np.ascontiguousarray(alpha, np.uint8).tobytes()))
    pixels = np.concatenate([unfiltered, rows], axis=1)
    strategy = zlib.Z_RLE if level == 1 else zlib.Z_DEFAULT_STRATEGY
    packer = zlib.compressobj(level, strategy=strategy)
    parts += [(b"IDAT", packer.compress(pixels.tobytes()) + packer.flush()), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(name, body) for name, body in parts)


def with_palette(image: bytes, palette: U1) -> bytes:
    """Return a copy of a PNG from `png` with another palette (k, 3) of the same length."""
    chunk = _chunk(b"PLTE", np.ascontiguousarray(palette, np.uint8).tobytes())
    start = image.index(b"PLTE") - 4  # a chunk starts with its length
    return image[:start] + chunk + image[start + len(chunk) :]


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
