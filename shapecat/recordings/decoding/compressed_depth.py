"""Decode compressed depth images: 16-bit PNG, or compressed_depth_image_transport of ROS."""

import io
import struct
from typing import Any

import numpy as np

from shapecat.arrays import F4, U2
from shapecat.jit import kernel
from shapecat.recordings.decoding.colour_image import (
    MOST_PIXELS,
    compressed_kind,
    compressed_size,
)
from shapecat.recordings.decoding.depth_image import clean_depth
from shapecat.recordings.messages import MessageError

__all__ = ["depth_of_compressed", "is_grey_png16"]

_HEADER = struct.Struct("<iff")
_GREY_16 = b"\x10\x00"
"""Bit depth and colour type of a grey PNG of 16 bits: bytes 24 and 25 of the file."""


def is_grey_png16(data: Any) -> bool:
    """Return whether image data is a 16-bit grey PNG file; its first 26 bytes are enough."""
    begin = bytes(data[:26])
    return compressed_kind(begin) == "png" and begin[24:] == _GREY_16


def depth_of_compressed(message: Any) -> F4:
    """Read a decoded sensor_msgs/CompressedImage with a format such as ``16UC1; compressedDepth``.

    The data is a bare PNG file, or a header of 12 bytes (compression format, parameters A and B)
    followed by PNG or RVL data. With the format 32FC1, the stored values are A / depth + B, with
    depth in metres; otherwise, they are millimetres.

    Returns
    -------
    (h, w) float32 metres, 0 where depth is missing.

    Raises
    ------
    MessageError : the data is damaged, or is neither a 16-bit grey PNG nor RVL.
    """
    data = memoryview(message.data).cast("B").toreadonly()
    if len(data) < _HEADER.size + 8:
        msg = f"compressed depth of only {len(data)} bytes"
        raise MessageError(msg)
    bare, inverse = compressed_kind(data) == "png", str(message.format).startswith("32FC1")
    if bare and inverse:
        msg = "compressed depth in 32FC1 without its parameters"
        raise MessageError(msg)
    _, a, b = _HEADER.unpack_from(data)
    body = bytes(data if bare else data[_HEADER.size :])
    values = _read_png(body) if compressed_kind(body) == "png" else _read_rvl(body)
    if not inverse:
        return clean_depth(values, 1000)
    depth = np.zeros(values.shape, np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        np.divide(a, values - np.float32(b), out=depth, where=values > 0)
    return clean_depth(depth)


def _read_png(data: bytes) -> U2:
    """Read a 16-bit grey PNG (h, w)."""
    from PIL import Image  # noqa: PLC0415  # loaded where depth is in PNG

    compressed_size(data)  # raises if the image is truncated or very large
    if not is_grey_png16(data):
        msg = "compressed depth is not a 16-bit grey PNG"
        raise MessageError(msg)
    try:
        with Image.open(io.BytesIO(data), formats=["png"]) as file:
            return np.asarray(file, np.uint16)
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        msg = "compressed depth is damaged"
        raise MessageError(msg) from error


def _read_rvl(data: bytes) -> U2:
    """Read RVL data as (h, w): width, height, then nibbles in little-endian 32-bit words."""
    width, height = struct.unpack_from("<II", data)
    words = np.frombuffer(data, "<u4", (len(data) - 8) // 4, 8)
    # A nibble can hold a run of zeros of any length, so only the number of pixels is checked.
    if not 0 < height * width <= MOST_PIXELS or words.size == 0:
        msg = "compressed depth is neither PNG nor RVL"
        raise MessageError(msg)
    values = np.zeros(height * width, np.uint16)
    if not _expand_rvl(words.astype(np.uint32), values):
        msg = "compressed depth (RVL) is damaged"
        raise MessageError(msg)
    return values.reshape(height, width)


@kernel(inner=True)
def _number(words: Any, at: int) -> tuple[int, int]:
    """Return the number at nibble ``at``, and the index of the nibble after it, -1 if damaged."""
    value, shift = 0, 0
    while at < 8 * words.size and shift < 30:
        nibble = int(words[at // 8] >> np.uint32(28 - 4 * (at % 8))) & 15
        at += 1
        value |= (nibble & 7) << shift  # three bits of the value; the fourth is set if more follow
        shift += 3
        if nibble & 8 == 0:
            return value, at
    return 0, -1


@kernel
def _expand_rvl(words: Any, out: U2) -> bool:
    """Decode RVL words (n,) into ``out``, depth values (h * w,); return False if they are damaged.

    Source: Wilson 2017, Fast Lossless Depth Image Compression, DecompressRVL.
    """
    at, filled, previous = 0, 0, 0
    while filled < out.size:
        zeros, at = _number(words, at)  # (1) length of the run of zeros
        if at < 0 or zeros > out.size - filled:
            return False
        filled += zeros
        values, at = _number(words, at)  # (2) number of values after it
        if at < 0 or values > out.size - filled or zeros + values == 0:
            return False
        for _ in range(values):  # (3) each value: its zigzag-coded difference from the previous
            value, at = _number(words, at)
            if at < 0:
                return False
            previous += (value >> 1) ^ -(value & 1)
            out[filled] = previous & 65535
            filled += 1
    return True
