"""The last few frames of each topic, for those that fuse them (thesis 4.2)."""

from collections import Counter, deque
from typing import NamedTuple

from shapecat.geometry import compose, inverse
from shapecat.types import Frame, Pose

__all__ = ["Earlier", "RecentFrames"]

GAP_NS = 500_000_000
"""Frames that are farther apart do not follow each other."""


class Earlier(NamedTuple):
    """A frame, and where the sensor of a later one stood in its sensor frame.

    The pose is None where it is not known: then the sensor can only be taken to have rested.
    """

    frame: Frame
    earlier_from_sensor: Pose | None


class RecentFrames:
    """Remembers of each topic as many frames as are fused with the next one."""

    def __init__(self, count: int) -> None:
        """Remember for fusing ``count`` frames into one; 1 remembers nothing."""
        self._kept = count - 1
        self._recent: dict[str, deque[tuple[Frame, Pose | None]]] = {}
        self._loose: Counter[str] = Counter()
        self._unplaced: Counter[str] = Counter()

    def before(self, frame: Frame, fixed_from_sensor: Pose | None) -> tuple[Earlier, ...]:
        """Return the frames to fuse with this one, the newest first, and remember this one.

        None are left after a jump of the clock, a gap, another resolution or another sensor
        frame, or when the pose comes or goes. Clouds that are no depth images are not fused:
        without pixels nothing tells a reading of the same place from one of what was there before.
        """
        if not self._kept:
            return ()
        if not frame.organized:
            self._loose[frame.topic] += 1
            return ()
        self._unplaced[frame.topic] += fixed_from_sensor is None
        recent = self._recent.setdefault(frame.topic, deque(maxlen=self._kept))
        if recent and not _follows(frame, fixed_from_sensor, *recent[0]):
            recent.clear()
        found = tuple(Earlier(f, _relative(p, fixed_from_sensor)) for f, p in recent)
        recent.appendleft((frame, fixed_from_sensor))
        return found

    def warnings(self) -> list[str]:
        """Return what a person should know about the frames seen so far."""
        return [
            f"{topic}: {n} frames are clouds, not depth images, and not fused"
            for topic, n in self._loose.items()
        ] + [
            f"{topic}: nothing tells where the sensor was in {n} frames: "
            "they are fused as if it had rested, where their readings agree"
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
