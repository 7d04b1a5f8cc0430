"""Read the coordinates of PointCloud2 messages of any layout."""

from typing import Any

import numpy as np

from shapecat.arrays import F4
from shapecat.recordings.messages import MessageError
from shapecat.types import Camera

__all__ = ["cloud_points", "organized", "unorganized"]

_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy type of each PointField datatype."""


def cloud_points(message: Any) -> F4:
    """Read the coordinates of a decoded PointCloud2.

    Parameters
    ----------
    message : has ``height, width, fields, is_bigendian, point_step, row_step, data`` as in
        sensor_msgs/PointCloud2. ``is_dense`` is ignored.

    Returns
    -------
    (h, w, 3) float32 metres, as recorded: coordinates may be NaN, infinite or zero. w is 0 if the
    cloud is empty.

    Raises
    ------
    MessageError : x, y or z is missing, the layout is inconsistent, or data is missing.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    if height * width == 0:
        return np.zeros((height and 1, 0, 3), np.float32)
    row = int(message.row_step) or width * step
    axes = _axes(message, step)
    data = np.frombuffer(message.data, np.uint8)
    # The last row may be cut after its last coordinate.
    need = (height - 1) * row + (width - 1) * step + max(o + np.dtype(f).itemsize for o, f in axes)
    if row < width * step or need > data.size:
        msg = f"cloud of {width} x {height} points needs {need} bytes and has {data.size}"
        raise MessageError(msg)
    points = np.zeros((height, width, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # hostile values become inf
        for k, (offset, kind) in enumerate(axes):
            points[..., k] = np.ndarray((height, width), kind, data, offset, (row, step))
    return points


def _axes(message: Any, step: int) -> list[tuple[int, str]]:
    """Return the byte offset and the NumPy type of x, y and z in a point."""
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    missing = [n for n in "xyz" if n not in fields or int(fields[n].datatype) not in _FORMATS]
    if missing:
        names = ", ".join(fields)[:80] or "none"
        msg = f"cloud without fields {', '.join(missing)} of a known type; fields: {names}"
        raise MessageError(msg)
    axes = []
    for name in "xyz":
        field = fields[name]
        kind = _FORMATS[int(field.datatype)]
        if int(field.offset) + np.dtype(kind).itemsize > step:
            msg = f"field {name} at byte {field.offset} lies outside the point of {step} bytes"
            raise MessageError(msg)
        axes.append((int(field.offset), order + kind))
    return axes


def organized(points: F4, camera: Camera) -> dict[str, Any]:
    """Return the content of a `Frame` from an organized cloud (h, w, 3): depth and camera."""
    x, y, z = (points[..., k] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        valid = np.isfinite(x + y + z) & (z > 0)
    return {"depth": np.where(valid, z, np.float32(0)), "camera": camera}


def unorganized(points: F4) -> dict[str, Any]:
    """Return the content of a `Frame` from a cloud (h, w, 3): its points (h * w, 3), row by row.

    Points without depth become NaN. Drivers mark them with NaN, infinity or the origin.
    """
    flat = np.array(points.reshape(-1, 3), np.float32)
    valid = np.isfinite(flat).all(1) & (flat != 0).any(1)  # flat.any() warns of signaling NaNs
    flat[~valid] = np.nan
    return {"points": flat}
