"""Explain why most frames of a run have no supporting plane, and so no objects."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from shapecat.arrays import F4
from shapecat.recordings import Recording
from shapecat.runs.run_info import RunInfo
from shapecat.runs.selection import read_frames
from shapecat.runs.tables.reading import Key, keys_of, read_together
from shapecat.types import Frame

__all__ = ["explain_missing_planes"]

_NO_ROOM_M = 10.0
"""A larger median depth is blamed on the unit, since rooms are smaller; else on the range."""

_OBJECT_M = 0.6
"""If all points of a frame are within this length, they may be a single object."""
_CUT_OUT = (
    f"; all points are within {_OBJECT_M:g} m: if they are a single object, cut out of its scene, "
    "shapecat also needs the points of the table below it"
)

_FRAMES = 3
"""Maximum number of frames without a plane whose depths are examined."""


def explain_missing_planes(recording: Recording, folder: Path, run: RunInfo) -> Iterator[str]:
    """Yield a warning with the likely reason if most frames have no plane; else nothing.

    Parameters
    ----------
    folder : folder with the tables of frames, planes and detections.
    run : its options select the frames; its settings have the range of detection.
    """
    range_m = run["settings"]["detection"]["max_range_m"]
    frames, bare, first = _count(folder)
    if 2 * bare <= frames:
        return
    pairs = read_frames(recording, run["options"])
    chosen = (frame for frame, _ in pairs if (frame.topic, frame.index) in first)
    seen = [(_distances(frame), _extent_m(frame)) for frame in islice(chosen, len(first))]
    distances = [each for each, _ in seen if each.size]
    reason = _reason(distances, range_m, run["up"]["source"])
    if distances and max(extent_m for _, extent_m in seen) <= _OBJECT_M:
        reason += _CUT_OUT
    yield f"no supporting plane in {bare} of {frames} frames: {reason}"


def _reason(distances: Sequence[F4], range_m: float, source: str) -> str:
    """Return the likely reason why frames have no plane.

    ``distances`` holds an array (n,) for each frame, the distances of its points in metres;
    ``range_m`` is the range of detection; ``source`` says where the up direction is from, as in
    run.json.
    """
    if not distances:
        return "they have no valid depth"
    share = float(np.mean(np.concatenate(distances) > range_m))
    if share > 1 / 2:
        unit = "16UC1 is in millimetres, 32FC1 and clouds in metres"
        middle = float(np.median([np.median(each) for each in distances]))
        hint = f"the median is {middle:.0f} m: is the unit right? {unit}"
        if middle <= _NO_ROOM_M:
            hint = f"try a larger one, if the median of {middle:.2g} m is right ({unit})"
        setting = f"detection.max_range_m, {range_m:g} m"
        return f"{share:.0%} of their depth is beyond {setting}; {hint}"
    if source == "option":
        return "is --up right? --up auto estimates up from the planes"
    if source == "planes":
        return "try --up X,Y,Z, or another range with --set detection.max_range_m=M"
    return f"is up ({source}) right? Try another --up"


def _count(folder: Path) -> tuple[int, int, set[Key]]:
    """Return the number of frames, the number without a plane, and the first few of these.

    A frame with objects counts as one with a plane, which may be assumed and not in the table.
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
    with np.errstate(over="ignore"):
        distances: F4 = np.linalg.norm(frame.finite_xyz(), axis=1)
    return distances


def _extent_m(frame: Frame) -> float:
    """Return the longest side of the box around all points, along the sensor's axes, metres.

    It is 0 without valid points.
    """
    valid = frame.finite_xyz()
    with np.errstate(over="ignore"):
        return float(np.ptp(valid, axis=0).max()) if len(valid) else 0.0
