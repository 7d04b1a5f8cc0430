"""Records of the measurements of a sensor, its camera and its pose."""

from dataclasses import dataclass

import numpy as np

from shapecat.arrays import F4, F8, U4, Record, array

__all__ = ["Camera", "Frame", "Pose"]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: pixel (u, v) sees the ray ((u - cx) / fx, (v - cy) / fy, 1).

    All numbers are in pixels; the centre of the first pixel is (0, 0).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


class Pose(Record):
    """A rigid transform ``a_from_b``: ``p_a = rotation @ p_b + translation``."""

    rotation: F8 = array("3 3", "f8")
    translation: F8 = array("3", "f8")


class Frame(Record):
    """One measurement of a depth sensor: a depth image with its camera, or a point cloud.

    It has either ``depth`` and ``camera``, or ``points``, never both. An index into a frame is a
    pixel index (row by row) or the row of a point.

    Attributes
    ----------
    topic : name of the topic.
    index : number of the frame on its topic, counted from 0 at the selected start; frames that
        are skipped count, too.
    stamp_ns : time of the measurement (``header.stamp``).
    log_time_ns : time at which the message was recorded.
    frame_id : name of a coordinate frame: the sensor frame, unless ``frame_from_sensor`` is given.
    depth : (h, w) metres along the optical axis; 0 where depth is missing, never NaN.
    points : (n, 3) metres, sensor frame; rows of NaN where depth is missing.
    frame_from_sensor : pose of the sensor in the frame ``frame_id``; None if ``frame_id`` is the
        sensor frame.
    """

    topic: str
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    depth: F4 | None = array("h w", "f4", default=None)
    camera: Camera | None = None
    points: F4 | None = array("n 3", "f4", default=None)
    frame_from_sensor: Pose | None = None

    def __post_init__(self) -> None:
        """Make arrays contiguous; require either points, or depth and a camera of the same size."""
        for name in ("depth", "points"):  # kernels would be compiled again for strided arrays
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, np.asarray(value, np.float32, order="C"))
        super().__post_init__()
        if (self.depth is None) == (self.points is None):
            msg = "a Frame has either depth or points"
            raise ValueError(msg)
        if self.depth is not None and (
            self.camera is None or self.depth.shape != (self.camera.height, self.camera.width)
        ):
            msg = f"depth {self.depth.shape} needs a camera of the same size, got {self.camera}"
            raise ValueError(msg)

    @property
    def organized(self) -> bool:
        """Whether the frame is a depth image."""
        return self.depth is not None

    def xyz(self, indices: U4 | None = None) -> F4:
        """Return the points at ``indices``, by default all: (n, 3) metres, sensor frame.

        Points without depth are rows of NaN.
        """
        if self.depth is None or self.camera is None:
            points = self.points if self.points is not None else np.zeros((0, 3), np.float32)
            return points if indices is None else points[indices]
        camera, flat = self.camera, self.depth.reshape(-1)
        pixel = np.arange(flat.size) if indices is None else np.asarray(indices, np.int64)
        z = flat[pixel]
        v, u = np.divmod(pixel, camera.width)
        z = np.where(z > 0, z, np.float32(np.nan))
        result = np.zeros((pixel.size, 3), np.float32)
        result[:, 0] = (u - camera.cx) / camera.fx * z
        result[:, 1] = (v - camera.cy) / camera.fy * z
        result[:, 2] = z
        return result

    def finite_xyz(self, indices: U4 | None = None) -> F4:
        """Return the points at ``indices``, by default all, that have depth: (n, 3) as in `xyz`."""
        points = self.xyz(indices)
        return np.asarray(points[np.isfinite(points).all(axis=1)])
