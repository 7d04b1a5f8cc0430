"""Convert depth images to metres along the optical axis."""

from typing import Any

import numpy as np

from shapecat.arrays import F4, U2
from shapecat.recordings.messages import MessageError

__all__ = ["DEPTH_ENCODINGS", "clean_depth", "depth_of_image"]

DEPTH_ENCODINGS = {"16UC1": ("u2", 1000), "mono16": ("u2", 1000), "32FC1": ("f4", 1)}
"""Pixel type and units per metre of each depth encoding (REP 118)."""


def depth_of_image(message: Any, units: float | None = None) -> F4:
    """Read a decoded sensor_msgs/Image as depth.

    Parameters
    ----------
    units : units per metre of integer pixels; None for 1000, which means millimetres.

    Returns
    -------
    (h, w) float32 metres, 0 where depth is missing.

    Raises
    ------
    MessageError : the encoding is not depth, the image is empty, its rows are too short, or data is
        missing.
    """
    height, width = int(message.height), int(message.width)
    if message.encoding not in DEPTH_ENCODINGS:
        msg = f"image encoding {message.encoding!r} is not depth"
        raise MessageError(msg)
    kind, default = DEPTH_ENCODINGS[message.encoding]
    pixel = np.dtype(("<" if not message.is_bigendian else ">") + kind)
    row = int(message.step) or width * pixel.itemsize
    data = np.frombuffer(message.data, np.uint8)
    need = (height - 1) * row + width * pixel.itemsize
    if 0 < row < width * pixel.itemsize:
        msg = f"image of {width} pixels in {message.encoding} per row with a step of {row} bytes"
        raise MessageError(msg)
    if height * width == 0 or need > data.size:
        msg = f"image of {width} x {height} pixels needs {need} bytes and has {data.size}"
        raise MessageError(msg)
    values = np.ndarray((height, width), pixel, data, 0, (row, pixel.itemsize))
    return clean_depth(values, units or default)


def clean_depth(values: F4 | U2, units: float = 1) -> F4:
    """Convert depth values (h, w) to metres; negative, infinite and NaN values become 0.

    ``units`` is the number of integer units per metre; floating-point values are in metres.
    """
    if values.dtype.kind == "u":
        # Dividing rounds to the nearest float; multiplying by 0.001 does not.
        return np.divide(values, np.float32(units), dtype=np.float32)
    depth = np.array(values, np.float32)
    depth[~((depth > 0) & (depth < np.inf))] = 0
    return depth
