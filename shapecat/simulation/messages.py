"""Frames and transforms as ROS 1 or ROS 2 messages."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from shapecat.arrays import F4
from shapecat.geometry import quaternion_from_rotation
from shapecat.types import Camera, Pose

__all__ = ["MessageFactory"]

_TF = "tf2_msgs/msg/TFMessage"


@cache  # each type store compiles the code of its message types anew
def _typestore(ros_version: int) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if ros_version == 1 else Stores.ROS2_HUMBLE)
    if _TF not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))
    return store


class MessageFactory:
    """Makes messages of one ROS version, with timestamps in nanoseconds.

    Parameters
    ----------
    ros_version : 1 or 2.
    """

    def __init__(self, ros_version: int) -> None:
        self.ros_version = ros_version
        self.typestore = _typestore(ros_version)

    def serialize(self, message: Any) -> bytes:
        """Return a message as bytes: the ROS 1 encoding, or CDR for ROS 2."""
        encode = (
            self.typestore.serialize_ros1 if self.ros_version == 1 else self.typestore.serialize_cdr
        )
        return bytes(encode(message, message.__msgtype__))

    def image(self, depth: F4, stamp_ns: int, frame_id: str) -> Any:
        """Return a depth image (h, w) in metres as a sensor_msgs/Image in 16-bit millimetres."""
        millimetres = np.round(np.asarray(depth, np.float64) * 1000).astype("<u2")
        height, width = depth.shape
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(stamp_ns, frame_id),
            height=height,
            width=width,
            encoding="16UC1",
            is_bigendian=0,
            step=2 * width,
            data=millimetres.view(np.uint8).reshape(-1),
        )

    def cloud(self, points: F4, stamp_ns: int, frame_id: str) -> Any:
        """Return points (h, w, 3) in metres, NaN where missing, as an organized PointCloud2."""
        height, width, _ = points.shape
        data = np.zeros((height, width, 4), "<f4")
        data[..., :3] = points
        data[..., 3] = 1.0  # as PCL pads x, y, z
        fields = [
            self._make("sensor_msgs/msg/PointField", name=n, offset=4 * k, datatype=7, count=1)
            for k, n in enumerate("xyz")
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(stamp_ns, frame_id),
            height=height,
            width=width,
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * width,
            data=data.view(np.uint8).reshape(-1),
            is_dense=False,
        )

    def compressed(self, data: bytes, stamp_ns: int, frame_id: str) -> Any:
        """Return the bytes of a JPEG file as a sensor_msgs/CompressedImage."""
        return self._make(
            "sensor_msgs/msg/CompressedImage",
            header=self._header(stamp_ns, frame_id),
            format="rgb8; jpeg compressed bgr8",
            data=np.frombuffer(data, np.uint8),
        )

    def camera_info(
        self, camera: Camera, stamp_ns: int, frame_id: str, distortion: Sequence[float] = ()
    ) -> Any:
        """Return a sensor_msgs/CameraInfo; ``distortion`` are five ``plumb_bob`` coefficients."""
        k = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
        p = [camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
        matrices = {"d": [*distortion] or [0] * 5, "k": k, "r": np.eye(3).ravel(), "p": p}
        if self.ros_version == 1:
            matrices = {name.upper(): value for name, value in matrices.items()}
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(stamp_ns, frame_id),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            **{name: np.array(value, np.float64) for name, value in matrices.items()},
            binning_x=0,
            binning_y=0,
            roi=self._make(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
        )

    def transforms(self, links: Sequence[tuple[str, str, Pose]], stamp_ns: int) -> Any:
        """Return a tf2_msgs/TFMessage of links (parent, child, ``parent_from_child``)."""
        stamped = []
        for parent, child, pose in links:
            x, y, z, w = (float(q) for q in np.round(quaternion_from_rotation(pose.rotation), 9))
            tx, ty, tz = (float(t) for t in np.round(pose.translation, 9))
            transform = self._make(
                "geometry_msgs/msg/Transform",
                translation=self._make("geometry_msgs/msg/Vector3", x=tx, y=ty, z=tz),
                rotation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            )
            stamped.append(
                self._make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self._header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=transform,
                )
            )
        return self._make(_TF, transforms=stamped)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        sequence = {"seq": 0} if self.ros_version == 1 else {}
        return self._make("std_msgs/msg/Header", **sequence, stamp=stamp, frame_id=frame_id)

    def _make(self, type_name: str, /, **values: Any) -> Any:
        return self.typestore.types[type_name](**values)
