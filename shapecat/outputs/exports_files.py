"""Functions that several exports share: PCD and PNG files, names, clouds in the level frame."""

import re
import struct
import zlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from shapecat.arrays import F4, U1, U2
from shapecat.geometry import IDENTITY, level_from_sensor, quaternion_from_rotation, transform
from shapecat.types import Frame, LabelledFrame, LabelledObject, Pose

__all__ = [
    "finite_points",
    "png",
    "safe_name",
    "support_offset",
    "upright_cloud",
    "upward",
    "write_pcd",
]

_ADLER = 65521
"""Modulus of the sums of Adler-32, the checksum at the end of zlib data (RFC 1950)."""
_COLOUR_TYPES = {"grey": 0, "palette": 3}


def write_pcd(path: Path, points: F4, *, viewpoint: Pose = IDENTITY) -> None:
    """Write points (n, 3), metres, as a binary PCD file, version 0.7.

    ``viewpoint`` is the pose of the sensor in the frame of the points.
    """
    x, y, z, w = quaternion_from_rotation(viewpoint.rotation)
    place = " ".join(f"{value:.6f}" for value in (*viewpoint.translation, w, x, y, z))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {place}\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(header.encode("ascii") + np.ascontiguousarray(points, "<f4").tobytes())


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


def safe_name(text: str) -> str:
    """Return a text as the name of a file or folder, without separators and not hidden.

    Examples
    --------
    >>> safe_name("../wine glass")
    '_wine glass'
    """
    return re.sub(r"[^\w .+&'()-]", "_", text).strip(". ")[:120] or "_"


def finite_points(frame: Frame) -> F4:
    """Return the points (n, 3) of a frame that have a reading, in order, metres, sensor frame."""
    points = frame.xyz()
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def support_offset(item: LabelledObject, up: F4) -> float:
    """Return the offset of an object's support along ``up`` (3,) from the sensor, metres."""
    middle = float(np.dot(np.asarray(up, np.float64), item.box.center))
    half = float(item.box.size[2]) / 2
    return middle - (item.height_m if np.isfinite(item.height_m) else half)


def upward(labelled: LabelledFrame) -> F4:
    """Return the up direction of a frame in the sensor frame, a unit vector (3,).

    Raises
    ------
    ValueError : the up direction is unknown.
    """
    if labelled.up is None:
        msg = f"frame {labelled.index} of {labelled.topic} has no up direction"
        raise ValueError(msg)
    return labelled.up


def upright_cloud(
    labelled: LabelledFrame, frame: Frame, item: LabelledObject
) -> tuple[F4, Pose] | None:
    """Return the points (n, 3) of an object in the level frame, and the sensor's pose in it.

    The support is at z = 0; metres. None if no point has a reading.
    """
    points = frame.xyz(item.indices)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    up = upward(labelled)
    level = level_from_sensor(up, support_offset(item, up), points)
    return transform(level, points).astype(np.float32), level
