"""Builders of depth camera messages as drivers publish them, and recordings of them."""

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from shapecat.types import Camera, Frame
from tests.mcap_files import McapChannels, mcap_writer

STORE = get_typestore(Stores.ROS2_HUMBLE)
SECOND = 10**9  # ns
EPOCH = 1_700_000_000 * SECOND  # ns since 1970
CLOUD, IMAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
INFO, COMPRESSED = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
CAMERA = Camera(64, 48, 60.0, 61.0, 31.2, 23.7)


def make(kind: str, *values: Any) -> Any:
    """Make a message of a ROS 2 type from its fields, in order."""
    return STORE.types[kind](*values)


def header(stamp: int, frame_id: str = "camera") -> Any:
    """Make a header with a stamp in nanoseconds."""
    time = make("builtin_interfaces/msg/Time", *divmod(stamp, SECOND))
    return make("std_msgs/msg/Header", time, frame_id)


def image(stamp: int, depth: Any, encoding: str = "16UC1", frame_id: str = "camera") -> Any:
    """Make a raw depth image from an array (h, w) of the type of its encoding."""
    h, w = depth.shape
    data = np.frombuffer(np.ascontiguousarray(depth).tobytes(), np.uint8)
    return make(IMAGE, header(stamp, frame_id), h, w, encoding, 0, depth.itemsize * w, data)


def info(stamp: int, camera: Camera = CAMERA, d: Iterable[float] = ()) -> Any:
    """Make the calibration of a pinhole camera, with distortion ``d``."""
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], np.float64)
    p = np.insert(k, (3, 6, 9), 0.0)
    roi = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = (camera.height, camera.width)
    return make(
        INFO,
        header(stamp),
        *size,
        "plumb_bob",
        np.array(list(d)),
        k,
        np.eye(3).ravel(),
        p,
        0,
        0,
        roi,
    )


def cloud(stamp: int, points: Any, **changes: Any) -> Any:
    """Make a cloud of float32 coordinates from points (h, w, 3); ``changes`` are other fields."""
    h, w = points.shape[:2]
    data = np.frombuffer(np.ascontiguousarray(points, "<f4").tobytes(), np.uint8)
    fields = [make("sensor_msgs/msg/PointField", n, 4 * k, 7, 1) for k, n in enumerate("xyz")]
    order, dense = False, True
    message = make(CLOUD, header(stamp), h, w, fields, order, 12, 12 * w, data, dense)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def write(
    path: Path,
    items: Iterable[tuple[str, int, Any]],
    *,
    empty: Iterable[tuple[str, str]] = (),
    **options: Any,
) -> Path:
    """Write messages given as topic, log time, and message or (type, bytes).

    ``empty`` holds topic and type of topics without messages, ``options`` those of the writer.
    """
    with mcap_writer(path, **options) as writer:
        channels = McapChannels(writer, STORE)
        for topic, kind in empty:
            channels.declare(topic, kind)
        for topic, time, item in items:
            kind = item[0] if isinstance(item, tuple) else item.__msgtype__
            raw = item[1] if isinstance(item, tuple) else bytes(STORE.serialize_cdr(item, kind))
            channels.write(topic, kind, time, raw)
    return path


def wavy_depth(camera: Camera = CAMERA) -> Any:
    """Make a depth image in millimetres with holes."""
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = (900 + 200 * np.sin(u / 9) + 150 * np.cos(v / 7)).astype(np.uint16)
    depth[(u + 2 * v) % 11 == 0] = 0
    return depth


def organized_points(depth: Any, camera: Camera = CAMERA) -> Any:
    """Return the points (h, w, 3), in metres, of a depth image in millimetres."""
    frame = Frame("", 0, 0, 0, "", depth=depth / np.float32(1000), camera=camera)
    return frame.xyz().reshape(*depth.shape, 3)


def compressed(stamp: int, body: bytes, kind: str = "16UC1", ab: Any = (0.0, 0.0)) -> Any:
    """Make a compressedDepth image; ``ab`` are the parameters of its quantization."""
    data = np.frombuffer(struct.pack("<iff", 0, *ab) + body, np.uint8)
    return make(COMPRESSED, header(stamp), f"{kind}; compressedDepth", data)
