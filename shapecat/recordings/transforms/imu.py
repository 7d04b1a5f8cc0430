"""Measure the up direction with accelerometers, which at rest sense the reaction to gravity."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from shapecat.arrays import F8
from shapecat.errors import RecordingError
from shapecat.recordings.look_ahead import LookAhead
from shapecat.recordings.messages import MALFORMED, Message, reason_of
from shapecat.recordings.recording import Recording
from shapecat.recordings.stamps import Estimates, stamp_ns

__all__ = ["Accelerometer", "Accelerometers"]

IMU = "sensor_msgs/msg/Imu"
_BIN_NS = 50_000_000
_WINDOW = 10
"""Number of bins averaged before and after a time: half a second each, to smooth out motions."""


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

    def forget(self, stamp: int) -> None:
        """Remove the measurements before a time (ns)."""
        self._sums = {at: total for at, total in self._sums.items() if at >= stamp // _BIN_NS}

    def up(self, stamp: int) -> F8 | None:
        """Return the up direction in the IMU's frame at a time (ns), a unit vector (3,).

        It is an average over half a second before and after; None if there is no measurement.
        """
        at = stamp // _BIN_NS
        windows = [self._sums[k] for k in range(at - _WINDOW, at + _WINDOW + 1) if k in self._sums]
        total = np.sum(windows, axis=0) if windows else np.zeros(3)
        norm = float(np.linalg.norm(total))
        return total / norm if norm > 1e-9 else None


class Accelerometers:
    """The accelerometers of a recording, with their measurements around the current frame.

    Messages without an acceleration are left out: their first covariance is -1 (sensor_msgs/Imu),
    or all values are zero, as in messages of a gyroscope alone.
    """

    def __init__(self, recording: Recording) -> None:
        """Prepare reading; nothing is read until it is needed."""
        self._recording = recording
        self._found: dict[str, Accelerometer] = {}
        self._estimates = Estimates(recording)

    def measure_anything(self) -> bool:
        """Return whether the recording holds any acceleration; this may read all of it."""
        if not self._ahead.whole and not self._found:
            self._ahead.read_all()
        return bool(self._found)

    def around(self, log_time_ns: int, stamp_ns: int) -> list[Accelerometer]:
        """Return the accelerometers, sorted by topic, with what they measured around a frame."""
        self._ahead.advance(log_time_ns, stamp_ns)
        return [self._found[topic] for topic in sorted(self._found)]

    @cached_property
    def _ahead(self) -> LookAhead:
        topics = {t.name for t in self._recording.topics if t.type == IMU and t.count != 0}
        return LookAhead(self._recording, topics, self._take, self._forget)

    def _take(self, message: Message) -> None:
        if message.type != IMU:
            return
        try:
            imu = self._recording.decode(message)
            a, stamp = imu.linear_acceleration, stamp_ns(imu.header)
            stamp = stamp or self._estimates.stamp_ns(message.topic, message.log_time_ns)
            acceleration = np.array([a.x, a.y, a.z], np.float64)
            absent = float(imu.linear_acceleration_covariance[0]) == -1
            name = str(imu.header.frame_id)
        except (RecordingError, *MALFORMED) as error:
            reason = reason_of(error, message.topic)
            self._recording.warn(f"skipped an IMU message: {message.topic}: {reason}")
            return
        size = float(np.abs(acceleration).max())
        if not absent and 1e-3 < size < 1e4:
            sensor = self._found.setdefault(message.topic, Accelerometer(message.topic, name))
            sensor.add(stamp, acceleration)

    def _forget(self, stamp: int) -> None:
        for one in self._found.values():
            one.forget(stamp)
