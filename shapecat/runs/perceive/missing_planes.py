"""Explain why most frames of a run have no supporting plane, and so no objects."""

from collections import Counter
from itertools import islice
from pathlib import Path

import numpy as np

from shapecat.arrays import F4
from shapecat.recordings import Recording
from shapecat.runs.perceive.selection import read_frames
from shapecat.runs.run_info import RunInfo
from shapecat.runs.tables.reading import Key, keys_of, read_together
from shapecat.types import Frame

__all__ = ["explain_missing_planes"]

_NO_ROOM_M = 10.0
"""A median depth that no indoor camera measures: the unit is wrong, not the range."""

_FRAMES = 3
"""Number of frames without a plane whose depths are examined."""


def explain_missing_planes(
    recording: Recording, folder: Path, run: RunInfo, range_m: float
) -> list[str]:
    """Return a warning with the likely reason if most frames have no plane; else nothing.

    Parameters
    ----------
    folder : with the tables of frames, planes and detections.
    run : its options select the frames.
    range_m : the range of detection, metres.
    """
    frames, bare, first = _count(folder)
    if 2 * bare <= frames:
        return []
    text = f"no supporting plane in {bare} of {frames} frames"
    samples = beyond_range = 0
    typical: list[float] = []
    pairs = read_frames(recording, run["options"], skipped=Counter())
    chosen = (frame for frame, _ in pairs if (frame.topic, frame.index) in first)
    for frame in islice(chosen, len(first)):
        distance = _distances(frame)
        samples += distance.size
        beyond_range += int(np.count_nonzero(distance > range_m))
        if distance.size:
            typical.append(float(np.median(distance)))
    if not samples:
        return [f"{text}: they have no valid depth"]
    if 2 * beyond_range > samples:
        share, setting = beyond_range / samples, f"detection.max_range_m, {range_m:g} m"
        unit = "16UC1 is in millimetres, 32FC1 and clouds in metres"
        middle = float(np.median(typical))
        hint = f"the median is {middle:.0f} m: is the unit right? {unit}"
        if middle <= _NO_ROOM_M:
            hint = f"try a larger one, if the median of {middle:.2g} m is right ({unit})"
        return [f"{text}: {share:.0%} of their depth is beyond {setting}; {hint}"]
    source = run["up"]["source"]
    if source == "option":
        return [f"{text}: is --up right? --up auto estimates up from the planes"]
    if source == "planes":
        return [f"{text}: try --up X,Y,Z, or another range with --set detection.max_range_m=M"]
    return [f"{text}: is up ({source}) right? Try another --up"]


def _count(folder: Path) -> tuple[int, int, set[Key]]:
    """Return the number of frames, of those without a plane, and the first few of the latter.

    A frame with objects has a plane, even if it is only assumed and not in the table.
    """
    count, bare, first = 0, 0, list[Key]()
    tables = dict.fromkeys(("frames", "planes", "detections"), ("topic", "frame"))
    for frames, planes, detections in read_together(folder, tables):
        with_planes_or_objects = {*keys_of(planes), *keys_of(detections)}
        without = [key for key in keys_of(frames) if key not in with_planes_or_objects]
        count, bare = count + frames.num_rows, bare + len(without)
        first += without[: _FRAMES - len(first)]
    return count, bare, set(first)


def _distances(frame: Frame) -> F4:
    """Return the depths (n,) of a depth image, or the distances of a cloud's points, metres."""
    if frame.depth is not None:
        depths: F4 = frame.depth[frame.depth > 0]
        return depths
    points = frame.xyz()
    distances: F4 = np.linalg.norm(points[np.isfinite(points).all(axis=1)], axis=1)
    return distances
