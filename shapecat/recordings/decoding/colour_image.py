"""Decode colour images (raw, JPEG or PNG) and the colours of point clouds to RGB pixels."""

import io
import struct
from typing import Any

import numpy as np

from shapecat.arrays import U1
from shapecat.cameras.colour import COMPRESSED_FORMATS, ColourImage
from shapecat.recordings.messages import MessageError

__all__ = [
    "COLOUR_ENCODINGS",
    "MOST_PIXELS",
    "bytes_per_row",
    "cloud_colours",
    "colour_image",
    "compressed_kind",
    "compressed_size",
    "encoded",
    "pixels_of",
]

MOST_PIXELS = 1 << 26
"""Images with more pixels are rejected."""

_CHANNELS = {
    "rgb8": (1, (0, 1, 2), 3),
    "bgr8": (1, (2, 1, 0), 3),
    "8UC3": (1, (2, 1, 0), 3),
    "rgba8": (1, (0, 1, 2), 4),
    "bgra8": (1, (2, 1, 0), 4),
    "8UC4": (1, (2, 1, 0), 4),
    "rgb16": (2, (0, 1, 2), 3),
    "bgr16": (2, (2, 1, 0), 3),
    "mono8": (1, (0, 0, 0), 1),
}
"""Bytes per channel, indices of the red, green and blue channels, and channels per pixel."""

_BAYER = {"bayer_rggb8": 0, "bayer_grbg8": 1, "bayer_gbrg8": 2, "bayer_bggr8": 3}
"""Index of the red pixel in a block of 2 x 2 pixels, row by row."""

_LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
"""Index of the first luma byte among the four bytes that encode two pixels."""

_PIXEL_BYTES = {
    **{name: size * channels for name, (size, _, channels) in _CHANNELS.items()},
    **dict.fromkeys(_BAYER, 1),
    **dict.fromkeys(_LUMA, 2),
}

COLOUR_ENCODINGS = frozenset(_PIXEL_BYTES)
"""Encodings of sensor_msgs/Image that can be decoded to RGB; mono8 becomes grey."""

_PNG = b"\x89PNG\r\n\x1a\n"


def compressed_kind(data: bytes | memoryview) -> str:
    """Return ``jpeg``, ``png`` or an empty string, from the first bytes of a compressed image."""
    begin = bytes(data[:8])
    return "jpeg" if begin.startswith(b"\xff\xd8\xff") else "png" if begin == _PNG else ""


def compressed_size(data: bytes | memoryview) -> tuple[str, int, int]:
    """Return format, width and height of a JPEG or PNG file, without decoding it.

    Raises
    ------
    MessageError : the data is neither JPEG nor PNG, is truncated, or has too many pixels.
    """
    from PIL import Image  # noqa: PLC0415  # loaded where there is colour

    kind, view = compressed_kind(data), memoryview(data)
    if not kind:
        msg = f"compressed image is neither JPEG nor PNG: begins with {bytes(view[:4])!r}"
        raise MessageError(msg)
    end = b"\xff\xd9" if kind == "jpeg" else b"IEND"
    if end not in bytes(view[max(0, len(view) - 4096) :]):
        msg = f"{kind} image is truncated"
        raise MessageError(msg)
    try:
        with Image.open(io.BytesIO(view), formats=[kind]) as file:
            width, height = file.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        msg = f"{kind} image without a size, or of too many pixels"
        raise MessageError(msg) from error
    if not 0 < width * height <= MOST_PIXELS:
        msg = f"image of {width} x {height} pixels"
        raise MessageError(msg)
    return kind, width, height


def bytes_per_row(image: ColourImage) -> int:
    """Return the bytes per row of a raw image, without decoding it.

    Raises
    ------
    MessageError : the image is truncated or has too many pixels, its rows are too short, or its
        encoding is unknown.
    """
    if image.encoding not in _PIXEL_BYTES:
        msg = f"image encoding {image.encoding!r} is not colour"
        raise MessageError(msg)
    width, height, size = image.width, image.height, memoryview(image.data).nbytes
    used = width * _PIXEL_BYTES[image.encoding]
    row = image.step or used
    need = (height - 1) * row + used
    if not 0 < width * height <= MOST_PIXELS or row < used or need > size:
        msg = f"image of {width} x {height} pixels needs {need} bytes and has {size}"
        raise MessageError(msg)
    return row


def pixels_of(image: ColourImage, *, shrink: int = 1) -> U1:
    """Decode an image to RGB.

    Parameters
    ----------
    shrink : a JPEG image may be decoded at 1/2, 1/4 or 1/8 of its size, but at no less than
        1 / ``shrink``; that is several times as fast. Other formats ignore this.

    Returns
    -------
    (h, w, 3) uint8 red, green, blue.

    Raises
    ------
    MessageError : the image is damaged or truncated, or its encoding is unknown.
    """
    if image.encoding in COMPRESSED_FORMATS:
        return _decompressed(image, shrink)
    return _raw_pixels(image)


def encoded(image: ColourImage, pixels: U1) -> tuple[str, bytes]:
    """Return the suffix and bytes of an image file: the recorded JPEG or PNG, else a new PNG.

    Parameters
    ----------
    pixels : (h, w, 3) RGB of the image, from `pixels_of` at full size.
    """
    from PIL import Image  # noqa: PLC0415  # loaded where there is colour

    if image.encoding in COMPRESSED_FORMATS:
        return ".jpg" if image.encoding == "jpeg" else ".png", bytes(image.data)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png", compress_level=4)
    return ".png", file.getvalue()


def _decompressed(image: ColourImage, shrink: int) -> U1:
    """Return the pixels (h, w, 3) of a JPEG or PNG file, RGB; ``shrink`` is as in `pixels_of`."""
    from PIL import Image  # noqa: PLC0415  # loaded where there is colour

    kind, width, height = compressed_size(image.data)
    if (width, height) != (image.width, image.height):
        msg = f"image of {width} x {height} pixels instead of {image.width} x {image.height}"
        raise MessageError(msg)
    try:
        with Image.open(io.BytesIO(image.data), formats=[kind]) as file:
            if shrink > 1:
                file.draft("RGB", (max(1, width // shrink), max(1, height // shrink)))
            return np.asarray(file.convert("RGB"))
    except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
        msg = f"{kind} image is damaged: {' '.join(str(error).split())[:100]}"
        raise MessageError(msg) from error


def _raw_pixels(image: ColourImage) -> U1:
    """Return the pixels (h, w, 3) of a raw image, RGB."""
    name, rows = image.encoding, _rows(image)
    if name in _LUMA:
        return _from_yuv(rows, _LUMA[name])
    if name in _BAYER:
        return _from_bayer(rows[..., 0], _BAYER[name])
    size, order, _ = _CHANNELS[name]
    # Take the high byte of 16-bit channels: the last one, assuming little-endian data.
    return np.ascontiguousarray(rows[..., [size * k + size - 1 for k in order]])


def _rows(image: ColourImage) -> U1:
    """Return the bytes of a raw image, (h, w, bytes per pixel)."""
    row, pixel = bytes_per_row(image), _PIXEL_BYTES[image.encoding]
    data = np.frombuffer(image.data, np.uint8)
    return np.ndarray((image.height, image.width, pixel), np.uint8, data, 0, (row, pixel, 1))


def _from_yuv(rows: U1, luma: int) -> U1:
    """Convert YUV 4:2:2 (h, w, 2) to RGB with the JFIF matrix (ITU-R BT.601, full range).

    ``luma`` is from `_LUMA`. An odd last column becomes black.
    """
    height, width, _ = rows.shape
    y = rows[..., luma].astype(np.float32)
    chroma = rows[..., 1 - luma].astype(np.float32) - 128
    u, v = (np.repeat(chroma[:, k : 2 * (width // 2) : 2], 2, axis=1) for k in (0, 1))
    y = y[:, : u.shape[1]]
    planes = (y + 1.402 * v, y - 0.344136 * u - 0.714136 * v, y + 1.772 * u)
    result = np.zeros((height, width, 3), np.uint8)
    result[:, : u.shape[1]] = np.clip(np.stack(planes, axis=-1) + 0.5, 0, 255)
    return result


def _from_bayer(mosaic: U1, red: int) -> U1:
    """Demosaic a Bayer image (h, w): all pixels of a 2 x 2 block get the same colour.

    ``red`` is from `_BAYER`. An odd last row or column becomes black.
    """
    height, width = (size // 2 * 2 for size in mosaic.shape)
    corner = [mosaic[k // 2 : height : 2, k % 2 : width : 2] for k in range(4)]
    green = [k for k in range(4) if k not in {red, 3 - red}]
    mean = (corner[green[0]].astype(np.uint16) + corner[green[1]]) // 2
    block = np.stack([corner[red], mean.astype(np.uint8), corner[3 - red]], axis=-1)
    result = np.zeros((*mosaic.shape, 3), np.uint8)
    result[:height, :width] = block.repeat(2, axis=0).repeat(2, axis=1)
    return result


def cloud_colours(message: Any) -> U1:
    """Read the packed ``rgb`` or ``rgba`` field of a decoded PointCloud2.

    Returns
    -------
    (h, w, 3) uint8 red, green, blue.

    Raises
    ------
    MessageError : the cloud is empty, the field is missing or does not fit into a point, or data is
        missing.
    """
    field = next((f for f in message.fields if f.name in {"rgb", "rgba"}), None)
    if field is None:
        msg = "cloud without colours"
        raise MessageError(msg)
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row, offset = int(message.row_step) or width * step, int(field.offset)
    data = np.frombuffer(message.data, np.uint8)
    need = (height - 1) * row + (width - 1) * step + offset + 4
    if height * width == 0 or offset + 4 > step or row < width * step or need > data.size:
        msg = f"colours of {width} x {height} points do not fit in {data.size} bytes"
        raise MessageError(msg)
    packed = np.ndarray((height, width, 4), np.uint8, data, offset, (row, step, 1))
    order = [1, 2, 3] if message.is_bigendian else [2, 1, 0]  # 0xAARRGGBB
    return np.ascontiguousarray(packed[..., order])


def colour_image(
    kind: str, topic: str, stamp_ns: int, log_time_ns: int, decoded: Any
) -> ColourImage:
    """Return the colour image in a decoded message.

    An image remains as it is encoded in the message; the colours of a cloud are decoded to RGB.

    Parameters
    ----------
    kind : ``raw``, ``compressed`` or ``cloud``.
    stamp_ns, log_time_ns : of the message, nanoseconds.

    Raises
    ------
    MessageError : the image is truncated, too large, or not in colour.
    """
    content: tuple[str, int, int, int, bytes | memoryview]
    if kind == "cloud":
        colours = cloud_colours(decoded)
        height, width, _ = colours.shape
        content = ("rgb8", width, height, 3 * width, colours.tobytes())
    elif kind == "compressed":
        data = _bytes(decoded.data)
        content = (*compressed_size(data), 0, data)
    else:
        sizes = int(decoded.width), int(decoded.height), int(decoded.step)
        content = (str(decoded.encoding), *sizes, _bytes(decoded.data))
    image = ColourImage(topic, stamp_ns, log_time_ns, str(decoded.header.frame_id), *content)
    if kind == "raw":
        bytes_per_row(image)  # raises if the image is truncated
    return image


def _bytes(data: Any) -> memoryview:
    return memoryview(data).cast("B") if len(data) else memoryview(b"")
