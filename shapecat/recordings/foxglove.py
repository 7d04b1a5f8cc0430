"""Foxglove's messages in the shape of the ROS messages they correspond to."""

import base64
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from shapecat.geometry import IDENTITY, rotation_from_quaternion

__all__ = ["FOXGLOVE_TYPES", "as_ros"]

FOXGLOVE_TYPES = {
    "foxglove.PointCloud": "sensor_msgs/msg/PointCloud2",
    "foxglove.RawImage": "sensor_msgs/msg/Image",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "foxglove.FrameTransform": "tf2_msgs/msg/TFMessage",
    "foxglove.FrameTransforms": "tf2_msgs/msg/TFMessage",
}
"""The ROS type that each corresponds to."""

_POINT_FIELDS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""PointField datatype of each PackedElementField type."""


def as_ros(kind: str, message: Any) -> Any:
    """Give a decoded Foxglove message the fields of its ROS counterpart.

    Messages of other types are returned as they are. Bytes may be base64 text, as in JSON.
    """
    return _CONVERSIONS[kind](message) if kind in _CONVERSIONS else message


def _header(message: Any) -> Any:
    return SimpleNamespace(stamp=_stamp(message.timestamp), frame_id=message.frame_id)


def _stamp(time: Any) -> Any:
    seconds = getattr(time, "sec", None)
    if seconds is None:
        return SimpleNamespace(sec=time.seconds, nanosec=time.nanos)
    return SimpleNamespace(sec=seconds, nanosec=getattr(time, "nsec", 0))


def _bytes(data: Any) -> Any:
    return base64.b64decode(data, validate=True) if isinstance(data, str) else data


def _cloud(message: Any) -> Any:
    data, step = _bytes(message.data), int(message.point_stride)
    fields = [
        SimpleNamespace(name=f.name, offset=f.offset, datatype=_POINT_FIELDS.get(int(f.type), 0))
        for f in message.fields
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


def _pose(pose: Any) -> Any:
    """Return rotation and translation of a cloud's own pose, None where it is the identity."""
    if pose is None or pose.orientation is None or pose.position is None:
        return None
    q, p = pose.orientation, pose.position
    quaternion = np.array([q.x, q.y, q.z, q.w], np.float64)
    turned = quaternion.any()
    rotation = rotation_from_quaternion(quaternion) if turned else IDENTITY.rotation
    translation = np.array([p.x, p.y, p.z], np.float64)
    if not translation.any() and np.array_equal(rotation, IDENTITY.rotation):
        return None
    return rotation, translation


def _image(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message),
        height=message.height,
        width=message.width,
        encoding=message.encoding,
        is_bigendian=False,
        step=message.step,
        data=_bytes(message.data),
    )


def _calibration(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message),
        height=message.height,
        width=message.width,
        distortion_model=message.distortion_model,
        d=message.D,
        k=message.K,
        r=message.R,
        p=message.P,
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0),
    )


def _transforms(message: Any) -> Any:
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=SimpleNamespace(stamp=_stamp(item.timestamp), frame_id=item.parent_frame_id),
                child_frame_id=item.child_frame_id,
                transform=SimpleNamespace(translation=item.translation, rotation=item.rotation),
            )
            for item in getattr(message, "transforms", [message])
        ]
    )


_CONVERSIONS: dict[str, Callable[[Any], Any]] = {
    "foxglove.PointCloud": _cloud,
    "foxglove.RawImage": _image,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.FrameTransform": _transforms,
    "foxglove.FrameTransforms": _transforms,
}
