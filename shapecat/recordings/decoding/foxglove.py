"""Convert Foxglove messages to the corresponding ROS messages."""

import base64
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from shapecat.geometry import rotation_from_quaternion
from shapecat.types import Pose

__all__ = ["as_ros", "ros_counterpart"]

_POINT_FIELDS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""PointField datatype of each PackedElementField type."""


def as_ros(kind: str, message: Any) -> Any:
    """Convert a decoded Foxglove message to an object with the fields of its ROS counterpart.

    Messages of other types are returned unchanged. Byte fields may be base64 text, as in JSON.
    """
    counterpart = _COUNTERPARTS.get(_foxglove_name(kind))
    return message if counterpart is None else counterpart[1](message)


def ros_counterpart(kind: str) -> str:
    """Return the ROS type that corresponds to a Foxglove type; any other type unchanged."""
    counterpart = _COUNTERPARTS.get(_foxglove_name(kind))
    return kind if counterpart is None else counterpart[0]


def _foxglove_name(kind: str) -> str:
    """Return a Foxglove type's name in JSON and protobuf; ``kind`` may also be its ROS name."""
    return kind.replace("foxglove_msgs/msg/", "foxglove.")


def _header(message: Any) -> Any:
    return SimpleNamespace(stamp=_stamp(message.timestamp), frame_id=str(message.frame_id))


def _stamp(time: Any) -> Any:
    """Read a time from JSON, ROS or protobuf; an absent one is 0."""
    seconds, nanoseconds = 0, 0
    for names in (("sec", "nsec"), ("sec", "nanosec"), ("seconds", "nanos")):
        seconds = int(getattr(time, names[0], seconds))
        nanoseconds = int(getattr(time, names[1], nanoseconds))
    return SimpleNamespace(sec=seconds, nanosec=nanoseconds)


def _vector(value: Any, names: str, default: Sequence[float]) -> Any:
    """Read the coordinates ``names`` of a message; return ``default`` if ``value`` is None."""
    values = default if value is None else [float(getattr(value, name)) for name in names]
    return SimpleNamespace(**dict(zip(names, values, strict=True)))


def _bytes(data: Any) -> Any:
    return base64.b64decode(data, validate=True) if isinstance(data, str) else data


def _cloud(message: Any) -> Any:
    data, step = _bytes(message.data), int(message.point_stride)
    fields = [
        SimpleNamespace(
            name=str(field.name),
            offset=int(field.offset),
            datatype=_POINT_FIELDS.get(int(field.type), 0),
        )
        for field in message.fields
    ]
    return SimpleNamespace(
        header=_header(message),
        height=1,
        width=len(data) // step if step > 0 else 0,
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=0,
        data=data,
        pose=_pose(getattr(message, "pose", None)),
    )


def _pose(pose: Any) -> Pose | None:
    """Return a cloud's own pose; None if it has none or it is the identity."""
    if pose is None:
        return None
    p = _vector(pose.position, "xyz", (0, 0, 0))
    q = _vector(pose.orientation, "xyzw", (0, 0, 0, 1))
    quaternion = (q.x, q.y, q.z, q.w) if any((q.x, q.y, q.z, q.w)) else (0, 0, 0, 1)
    result = Pose(rotation_from_quaternion(quaternion), np.array([p.x, p.y, p.z]))
    return (
        result
        if result.translation.any() or not np.array_equal(result.rotation, np.eye(3))
        else None
    )


def _image(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message),
        height=int(message.height),
        width=int(message.width),
        encoding=str(message.encoding),
        is_bigendian=False,
        step=int(message.step),
        data=_bytes(message.data),
    )


def _compressed(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message), format=str(message.format), data=_bytes(message.data)
    )


def _calibration(message: Any) -> Any:
    matrices = {
        name: np.array(getattr(message, name, getattr(message, name.upper(), ())), np.float64)
        for name in "dkrp"
    }
    return SimpleNamespace(
        header=_header(message),
        height=int(message.height),
        width=int(message.width),
        distortion_model=str(getattr(message, "distortion_model", "")),
        **matrices,
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0),
    )


def _transforms(message: Any) -> Any:
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=SimpleNamespace(
                    stamp=_stamp(item.timestamp), frame_id=str(item.parent_frame_id)
                ),
                child_frame_id=str(item.child_frame_id),
                transform=SimpleNamespace(
                    translation=_vector(item.translation, "xyz", (0, 0, 0)),
                    rotation=_vector(item.rotation, "xyzw", (0, 0, 0, 1)),
                ),
            )
            for item in getattr(message, "transforms", [message])
        ]
    )


_COUNTERPARTS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "foxglove.PointCloud": ("sensor_msgs/msg/PointCloud2", _cloud),
    "foxglove.RawImage": ("sensor_msgs/msg/Image", _image),
    "foxglove.CompressedImage": ("sensor_msgs/msg/CompressedImage", _compressed),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _calibration),
    "foxglove.FrameTransform": ("tf2_msgs/msg/TFMessage", _transforms),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", _transforms),
}
"""The ROS type that corresponds to each Foxglove type, and the conversion of its messages."""
