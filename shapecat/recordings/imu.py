"""Accelerometers: at rest they measure the reaction to gravity, which points up."""

from dataclasses import dataclass, field

import numpy as np

from shapecat.arrays import F8
from shapecat.recordings.messages import MessageError
from shapecat.recordings.recording import Recording
from shapecat.recordings.stamps import stamp_ns

__all__ = ["Accelerometer", "read_accelerometers"]

IMU = "sensor_msgs/msg/Imu"
_BIN_NS = 50_000_000
_WINDOW = 10
"""Bins averaged on each side: half a second, which smooths out motions."""


@dataclass
class Accelerometer:
    """Accelerations of one topic, summed in bins of 50 ms to save memory."""

    topic: str
    frame_id: str
    _sums: dict[int, F8] = field(default_factory=dict)

    def add(self, stamp: int, acceleration: F8) -> None:
        """Add a measurement (3,), in any unit, with its stamp in nanoseconds."""
        at = stamp // _BIN_NS
        self._sums[at] = self._sums.get(at, 0) + acceleration

    def up(self, stamp: int) -> F8 | None:
        """Return the up direction in the IMU's frame around a time (ns), a unit vector (3,).

        It averages half a second before and after; None if nothing was measured then.
        """
        at = stamp // _BIN_NS
        near = [self._sums[k] for k in range(at - _WINDOW, at + _WINDOW + 1) if k in self._sums]
        total = np.sum(near, axis=0) if near else np.zeros(3)
        norm = float(np.linalg.norm(total))
        return total / norm if norm > 1e-9 else None


def read_accelerometers(recording: Recording) -> tuple[Accelerometer, ...]:
    """Read the accelerations of all IMU topics in one pass, sorted by topic.

    Messages without an acceleration are left out: their first covariance is -1 (sensor_msgs/Imu),
    or all values are zero, as from a gyroscope alone.
    """
    topics = {topic.name for topic in recording.topics if topic.type == IMU and topic.count != 0}
    found: dict[str, Accelerometer] = {}
    for message in recording.messages(topics) if topics else ():
        if message.type != IMU:
            continue
        try:
            imu = recording.decode(message)
            a, stamp = imu.linear_acceleration, stamp_ns(imu.header) or message.log_time_ns
            acceleration = np.array([a.x, a.y, a.z], np.float64)
            absent = float(imu.linear_acceleration_covariance[0]) == -1
        except (MessageError, AttributeError, LookupError, TypeError, ValueError) as error:
            recording.warn(f"skipped an IMU message: {error}")
            continue
        size = float(np.abs(acceleration).max())
        if not absent and 1e-3 < size < 1e4:
            name = str(imu.header.frame_id)
            found.setdefault(message.topic, Accelerometer(message.topic, name)).add(
                stamp, acceleration
            )
    return tuple(found[topic] for topic in sorted(found))
