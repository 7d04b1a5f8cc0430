"""The last few frames of each topic, kept for depth fusion (thesis 4.2)."""

from collections import Counter, deque
from typing import NamedTuple

from shapecat.geometry import compose, inverse
from shapecat.types import Frame, Pose

__all__ = ["Earlier", "RecentFrames"]

GAP_NS = 500_000_000
"""Longest time between consecutive frames that are fused, nanoseconds."""


class Earlier(NamedTuple):
    """An earlier frame, and the pose of the current sensor frame in the sensor frame of that time.

    The pose is None if it is unknown; the sensor is then assumed not to have moved.
    """

    frame: Frame
    earlier_from_sensor: Pose | None


class RecentFrames:
    """Keeps the last frames of each topic, to fuse them with the next one."""

    def __init__(self, count: int) -> None:
        """Keep ``count - 1`` frames of each topic, so that ``count`` are fused into one."""
        self._kept = count - 1
        self._recent: dict[str, deque[tuple[Frame, Pose | None]]] = {}
        self._clouds: Counter[str] = Counter()
        self._unplaced: Counter[str] = Counter()

    def before(self, frame: Frame, fixed_from_sensor: Pose | None) -> tuple[Earlier, ...]:
        """Return the earlier frames to fuse with this one, the newest first, and keep this one.

        ``fixed_from_sensor`` is the pose of the sensor in the fixed frame; None if it is unknown.
        Earlier frames are dropped after a jump of the clock, a gap, a change of the camera or the
        sensor frame, and when the pose becomes known or unknown. Point clouds are not fused:
        without pixels, depths of an object that has moved away cannot be recognised.
        """
        if not self._kept:
            return ()
        if not frame.organized:
            self._clouds[frame.topic] += 1
            return ()
        self._unplaced[frame.topic] += fixed_from_sensor is None
        recent = self._recent.setdefault(frame.topic, deque(maxlen=self._kept))
        if recent and not _follows(frame, fixed_from_sensor, *recent[0]):
            recent.clear()
        earlier = tuple(Earlier(f, _relative(p, fixed_from_sensor)) for f, p in recent)
        recent.appendleft((frame, fixed_from_sensor))
        return earlier

    def warnings(self) -> list[str]:
        """Return warnings for the user, per topic: clouds that are not fused, and unknown poses."""
        return [
            f"{topic}: clouds are not fused, only depth images (frames: {n})"
            for topic, n in self._clouds.items()
        ] + [
            f"{topic}: the pose of the sensor is unknown (frames: {n}): where their depths agree, "
            "these frames are fused as if it had not moved"
            for topic, n in self._unplaced.items()
            if n
        ]


def _follows(frame: Frame, pose: Pose | None, last: Frame, last_pose: Pose | None) -> bool:
    return (
        0 < frame.stamp_ns - last.stamp_ns <= GAP_NS
        and (frame.camera, frame.frame_id) == (last.camera, last.frame_id)
        and (pose is None) == (last_pose is None)
    )


def _relative(fixed_from_earlier: Pose | None, fixed_from_sensor: Pose | None) -> Pose | None:
    if fixed_from_earlier is None or fixed_from_sensor is None:
        return None
    return compose(inverse(fixed_from_earlier), fixed_from_sensor)
