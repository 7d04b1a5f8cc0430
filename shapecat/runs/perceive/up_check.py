"""Compare the up direction that a recording gives with the planes in its first frames.

Otherwise a fixed frame whose z axis is not up would spoil all frames.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from shapecat.arrays import F4
from shapecat.cameras.colour import ColourView
from shapecat.config import Settings
from shapecat.perception import find_up
from shapecat.recordings.transforms.gravity import (
    MISNAMINGS,
    Orientation,
    PoseFinder,
    has_z_up,
    turned,
)
from shapecat.types import Frame

__all__ = ["Oriented", "UpCheck"]

_CONFIRMS_DEG = 15.0
"""A plane confirms an up direction within this angle, as in `estimate_up`."""
_MISNAMED_DEG = 5.0
"""A plane confirms a `Misnaming` within this angle, since transforms of simulators are exact. A
larger angle would also accept maps of visual SLAM with z forward, off by the camera's pitch."""
_DOUBTS = 3
"""Number of frames with a plane that must contradict an up direction to reject it."""
_LOOKS = 10
"""Maximum number of frames of a topic that are checked."""
_MOST_HELD = 64
"""Maximum number of frames held back, since a topic may have few frames or begin late."""

Oriented = tuple[Frame, ColourView | None, Orientation]
"""A frame, its colour image or None, and the up direction and pose of the sensor."""


class UpCheck:
    """Rejects or corrects an up direction that contradicts the planes in a topic's first frames."""

    def __init__(self, poses: PoseFinder, settings: Settings) -> None:
        self._poses, self._settings = poses, settings
        self._off_deg: dict[str, list[float]] = {}
        self._misnamed_off_deg: dict[str, list[list[float]]] = {}  # per frame and misnaming
        self._sources: dict[str, str] = {}
        self._looks: Counter[str] = Counter()
        self._decided: set[str] = set()

    def before(self, source: Iterator[Oriented]) -> Iterator[Oriented]:
        """Yield all frames, but hold the first ones back until the up directions are decided.

        Topics without a given up direction need no decision.
        """
        pending: list[Oriented] = []
        for oriented in source:
            frame, _, orientation = oriented
            pending.append(oriented)
            if frame.topic not in self._decided:
                self._look(frame, orientation)
            if len(pending) == _MOST_HELD:
                self._decide_all()
            if self._off_deg.keys() <= self._decided:
                yield from pending
                pending.clear()
        self._decide_all()
        yield from pending

    def _look(self, frame: Frame, orientation: Orientation) -> None:
        """Compare the up direction of a frame with its planes.

        After enough frames, decide whether the topic has the right up direction. At the first
        frame of the topic, warn if its clouds are not in the frame of a camera.
        """
        self._looks[frame.topic] += 1
        hint, off = orientation.up, self._off_deg.get(frame.topic, [])
        elsewhere = frame.points is not None and has_z_up(frame.frame_id)
        if elsewhere and self._looks[frame.topic] == 1:
            self._poses.warnings.append(
                f"{frame.topic}: its clouds are in {frame.frame_id}, which is not the frame of a "
                "camera: objects may be missed or split; use its depth images, if recorded"
            )
        if hint is not None:
            off = self._off_deg.setdefault(frame.topic, off)
            estimate = find_up(frame, self._settings)
            if estimate is not None:
                angle = _angle_deg(hint, estimate)
                corrected = [turned(hint, misnaming.named_from_data) for misnaming in MISNAMINGS]
                self._misnamed_off_deg.setdefault(frame.topic, []).append(
                    [_angle_deg(up, estimate) for up in corrected]
                )
                if elsewhere:  # from the base of a robot, a table seems to be seen from below
                    angle = min(angle, 180 - angle)
                off.append(angle)
                self._sources[frame.topic] = orientation.source
        enough = len(off) == _DOUBTS or self._looks[frame.topic] == _LOOKS
        if enough or min(off, default=np.inf) <= _CONFIRMS_DEG:
            self._decide(frame.topic)

    def _decide_all(self) -> None:
        for topic in sorted(self._off_deg.keys() - self._decided):
            self._decide(topic)

    def _decide(self, topic: str) -> None:
        """Reject the up direction of a topic if no frame confirms it and enough contradict it.

        If it fits a `Misnaming`, it is corrected instead.
        """
        self._decided.add(topic)
        off = self._off_deg.get(topic, [])
        enough = len(off) >= min(_DOUBTS, self._looks[topic])
        if not enough or min(off) <= _CONFIRMS_DEG:
            return
        source = self._sources[topic]
        worst = np.max(self._misnamed_off_deg[topic], axis=0)
        fits = [m for m, off_deg in zip(MISNAMINGS, worst, strict=True) if off_deg <= _MISNAMED_DEG]
        if source.startswith("transforms") and fits:
            self._poses.assume_misnamed(topic, fits[0])
        else:
            self._poses.contradict(topic, source, off)


def _angle_deg(a: F4, b: F4) -> float:
    """Return the angle between two unit vectors (3,), degrees."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
