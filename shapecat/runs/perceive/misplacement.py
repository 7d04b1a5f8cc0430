"""Warn if the poses of a sensor are worse than none, for example if its extrinsics are wrong."""

from collections.abc import Iterator
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
from shapecat.runs.tables.reading import read_by_topic, read_together

__all__ = ["explain_misplacement"]

_MOVED_M = 0.03
"""The camera has moved if objects have moved farther than this relative to it."""
_WORSE = 1.5
"""Poses are worse than none if objects move more than this many times as far in the fixed frame as
relative to the camera."""
_MIN_MOTIONS = 5
"""Minimum number of comparisons for a warning."""
_WORSE_SHARE = 0.7
"""A warning needs poses that are worse than none in more than this fraction of comparisons."""


def explain_misplacement(folder: Path, fixed_frame: str) -> Iterator[str]:
    """Yield a warning for each topic with sensor poses that are worse than none.

    Parameters
    ----------
    folder : folder with the tables of frames and detections.
    fixed_frame : name of the frame of ``center_fixed``.
    """
    for topic, worse in _compare(folder).items():
        if len(worse) >= _MIN_MOTIONS and np.mean(worse) > _WORSE_SHARE:
            frame_ids = read_by_topic(
                folder, ["frame_id"], lambda frames: np.array(frames["frame_id"].to_pylist())
            )
            yield (
                f"{topic}: the transforms look wrong: while the camera moves, objects move farther "
                f"in {fixed_frame} than relative to the camera, and may get no tracks; to track in "
                f"the sensor frame, pass --fixed-frame {frame_ids[topic][0]}"
            )


def _compare(folder: Path) -> dict[str, list[bool]]:
    """Return, for each topic and each motion of its camera, whether poses are worse than none.

    Poses are worse if objects move much farther in the fixed frame than relative to the sensor.
    """
    latest: dict[str, Centers] = {}
    worse: dict[str, list[bool]] = {}
    for frames, detections in read_together(folder, CENTERS):
        for key, centers in centers_of(frames, detections):
            if not len(centers.fixed) or np.isnan(centers.fixed).any():
                continue
            previous = latest.setdefault(key[0], centers)
            seconds = abs(centers.stamp_ns - previous.stamp_ns) * 1e-9
            if seconds < APART_S:
                continue
            latest[key[0]] = centers
            moved = moved_m(previous.sensor, centers.sensor)
            if seconds < GAP_S and moved > _MOVED_M:
                farther = moved_m(previous.fixed, centers.fixed) > _WORSE * moved
                worse.setdefault(key[0], []).append(farther)
    return worse
