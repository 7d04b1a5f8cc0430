"""Warn if colour images are so far in time from their depth images that masks are displaced."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from shapecat.runs.perceive.centers import (
    APART_S,
    CENTERS,
    GAP_S,
    Centers,
    centers_of,
    moved_m,
)
from shapecat.runs.tables.reading import keys_of, numbers, read_together

__all__ = ["explain_colour_offsets"]

_FAR_S = 0.25
"""Between images that are farther apart in time, objects may have moved."""
_SHIFT_M = 0.01
"""Masks are displaced if objects move farther than this between the two images."""
_UNEXPLAINED = 0.5
"""Poses explain the motion of objects relative to the camera if this fraction of it exceeds their
motion in the fixed frame. No object seems at rest there, since its visible sides change."""
_MIN_MOTIONS = 3
"""Minimum number of comparisons on which the speed of objects is based."""


@dataclass
class _Stream:
    """The colour images of a depth stream.

    Attributes
    ----------
    offsets_s : time between depth and colour image, seconds, for each frame that has both.
    speeds : speeds of objects relative to the camera, m/s; 0 if poses explain the motion.
    compared : the last compared frame.
    """

    offsets_s: list[float] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    compared: Centers | None = None

    def compare(self, centers: Centers) -> None:
        """Add the speed of the objects since the last compared frame to ``speeds``.

        Frames are compared if they have objects, and `APART_S` to `GAP_S` are between them.
        """
        if not len(centers.sensor):
            return
        previous = centers if self.compared is None else self.compared
        seconds = abs(centers.stamp_ns - previous.stamp_ns) * 1e-9
        if 0 < seconds < APART_S:
            return
        self.compared = centers
        if APART_S <= seconds < GAP_S:
            moved = moved_m(previous.sensor, centers.sensor)
            explained = moved_m(previous.fixed, centers.fixed) < _UNEXPLAINED * moved
            self.speeds.append(0.0 if explained else moved / seconds)

    def speed(self) -> float:
        """Return the median speed of the objects relative to the camera, m/s.

        It is 0 if too few motions were measured.
        """
        return float(np.median(self.speeds)) if len(self.speeds) >= _MIN_MOTIONS else 0.0


def explain_colour_offsets(folder: Path) -> Iterator[str]:
    """Yield a warning for each topic whose masks may be displaced on colour images.

    The motion of the camera between the depth image and the colour image of a frame is corrected
    if transforms give it; that of objects is not.

    Parameters
    ----------
    folder : folder with the tables of frames, detections and masks.
    """
    for topic, stream in _read(folder).items():
        speed = stream.speed()
        effect = "masks of objects that moved meanwhile are displaced"
        offsets_s = [offset for offset in stream.offsets_s if offset > _FAR_S]
        displaced_s = [offset for offset in stream.offsets_s if offset * speed > _SHIFT_M]
        if displaced_s:
            offsets_s = displaced_s
            effect = (
                f"objects move by about {speed * max(offsets_s):.2f} m meanwhile, so that their "
                "masks are displaced; if it is the camera that moves, record transforms that give "
                "its motion"
            )
        if offsets_s:
            yield (
                f"{topic}: in {len(offsets_s)} of {len(stream.offsets_s)} frames, the colour image "
                f"is up to {max(offsets_s):.2f} s older or newer than the depth image; {effect}"
            )


def _read(folder: Path) -> dict[str, _Stream]:
    """Return the colour images of each depth topic."""
    streams: dict[str, _Stream] = {}
    columns = {**CENTERS, "masks": ("topic", "frame", "color_stamp_ns")}
    for frames, detections, masks in read_together(folder, columns):
        colour_ns = dict(
            zip(keys_of(masks), numbers(masks["color_stamp_ns"]).tolist(), strict=True)
        )
        for key, centers in centers_of(frames, detections):
            stream = streams.setdefault(key[0], _Stream())
            stream.compare(centers)
            if key in colour_ns:
                stream.offsets_s.append(abs(colour_ns[key] - centers.stamp_ns) * 1e-9)
    return streams
