"""Where up is, and where the sensor is, in each frame of a recording."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from shapecat.arrays import F4
from shapecat.errors import ConfigError
from shapecat.recordings.recording import Recording
from shapecat.recordings.transforms import (
    TransformBuffer,
    TransformError,
    fixed_frame,
    read_transforms,
)
from shapecat.types import Frame, Pose

__all__ = ["Upright"]

_LEVEL_FRAMES = ("map", "odom", "world", "earth", "base_footprint", "base_link")
"""Frames whose z axis is up by convention (REP 105, REP 103)."""


@dataclass
class Upright:
    """Answers, frame by frame, where up is and where the sensor is in the fixed frame.

    Counts the look-ups that failed, for the report.
    """

    transforms: TransformBuffer
    fixed_frame: str | None
    vector: F4 | None
    use_transforms: bool
    _failed: int = 0
    _first_failure: str = ""
    _source: str = "planes"

    @classmethod
    def of(cls, recording: Recording, *, up: str, fixed_frame: str | None) -> "Upright":
        """Prepare the answers for a recording.

        Parameters
        ----------
        up : ``auto``, ``tf``, or a vector ``X,Y,Z`` in the sensor frame.
        fixed_frame : name of the frame in which things stand still; None to choose one.

        Raises
        ------
        ConfigError : ``up`` is none of these.
        """
        vector = None if up in {"auto", "tf"} else _parse_vector(up)
        transforms = read_transforms(recording)
        if fixed_frame is not None and fixed_frame not in transforms.frames:
            known = ", ".join(sorted(transforms.frames)) or "none, it has no transforms"
            msg = f"--fixed-frame {fixed_frame}: not in {recording.path}; its frames: {known}"
            raise ConfigError(msg)
        return cls(transforms, fixed_frame, vector, use_transforms=vector is None)

    def fixed_from_sensor(self, frame: Frame) -> Pose | None:
        """Return the pose of the sensor in the fixed frame, or None if it is not known."""
        if self.fixed_frame is None:
            self.fixed_frame = fixed_frame(self.transforms, frame.frame_id)
        if self.fixed_frame is None:
            return None
        return self._lookup(self.fixed_frame, frame)

    def up(self, frame: Frame) -> F4 | None:
        """Return the unit vector (3,) that points up in the sensor frame, or None to estimate."""
        if self.vector is not None:
            self._source = "option"
            return self.vector
        if not self.use_transforms:
            return None
        for level in (name for name in _LEVEL_FRAMES if name in self.transforms.frames):
            pose = self._lookup(level, frame)
            if pose is not None:
                self._source = f"transforms, z of {level}"
                return np.asarray(pose.rotation[2], np.float32)
        return None

    def _lookup(self, target: str, frame: Frame) -> Pose | None:
        try:
            return self.transforms.lookup(target, frame.frame_id, frame.stamp_ns)
        except TransformError as error:
            self._failed += 1
            self._first_failure = self._first_failure or str(error)
            return None

    @property
    def warnings(self) -> list[str]:
        """One line if transforms were missed."""
        if not self._failed:
            return []
        return [f"{self._failed} transform look-ups failed, the first: {self._first_failure}"]

    def report(self) -> dict[str, Any]:
        """Return where up came from, for run.json."""
        return {"source": self._source}


def _parse_vector(text: str) -> F4:
    try:
        vector = np.array([float(part) for part in text.split(",")], np.float64)
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 1e-6 < length < np.inf:
        msg = f"--up {text}: expected auto, tf, or a vector such as 0,-1,0"
        raise ConfigError(msg)
    return np.asarray(vector / length, np.float32)
