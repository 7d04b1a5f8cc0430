"""Warn if the pose of a sensor jumps in the fixed frame, as after a correction by localization."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from shapecat.arrays import F8, I4
from shapecat.runs.tables.reading import first_stamp, numbers, numbers_or_nan, read_by_topic

__all__ = ["explain_jumps"]

_JUMP_M = 0.1
"""Minimum distance of a jump. The tracker can follow objects over shorter ones."""
_JUMP_M_S = 2.0
"""Minimum speed of a jump. Cameras of indoor robots are slower."""
_SUDDEN = 5
"""A jump is more than this many times as fast as the motion before and after it."""


def explain_jumps(folder: Path, fixed_frame: str) -> Iterator[str]:
    """Yield a warning for each topic whose sensor jumps in the fixed frame.

    Parameters
    ----------
    folder : folder with the table of frames.
    fixed_frame : name of the fixed frame, for the message.
    """
    stamps = read_by_topic(folder, ["stamp_ns"], lambda frames: numbers(frames["stamp_ns"]))
    poses = read_by_topic(folder, ["fixed_translation", "fixed_rotation"], _places)
    for topic, all_places in poses.items():
        known = ~np.isnan(all_places[:, 0])
        places, stamps_ns = all_places[known], stamps[topic][known]
        jumps, steps = _jumps(places, stamps_ns)
        if len(jumps):
            seconds = (stamps_ns[jumps[0] + 1] - first_stamp(folder)) * 1e-9
            times = f"{len(jumps)} times, first" if len(jumps) > 1 else "once,"
            yield (
                f"{topic}: the pose of its sensor in {fixed_frame} jumps {times} at {seconds:.1f} "
                f"s, by up to {steps.max():.2f} m, and objects may get new tracks; if odometry has "
                "a frame of its own, pass it, for example --fixed-frame odom"
            )


def _places(frames: pa.Table) -> F8:
    """Return a point in front of the sensor in each frame (n, 3), fixed frame, metres.

    It is 1 m ahead, so that sudden rotations move it, too; NaN without a pose.
    """
    turns = numbers_or_nan(frames["fixed_rotation"]).reshape(-1, 3, 3)
    return np.asarray(numbers_or_nan(frames["fixed_translation"]) + turns[:, :, 2])


def _jumps(places: F8, stamps_ns: I4) -> tuple[I4, F8]:
    """Return the indices (k,) of the places before jumps, and the distances (k,), metres.

    ``places`` (n, 3) are from `_places`, in metres, and ``stamps_ns`` (n,) are their times.
    """
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    seconds = np.diff(stamps_ns) * 1e-9
    speeds = np.divide(steps, seconds, out=np.zeros_like(steps), where=seconds > 0)
    padded = np.pad(speeds, 1)
    usual = np.maximum(padded[:-2], padded[2:])
    sudden = speeds > np.maximum(_SUDDEN * usual, _JUMP_M_S)
    jumps = np.flatnonzero((steps > _JUMP_M) & sudden)
    return jumps, steps[jumps]
