"""The timeline of each track: when it was detected, and its posterior over time."""

from pathlib import Path

import numpy as np

from shapecat.arrays import F4, F8, Bool, Record, array
from shapecat.runs.tables.reading import first_stamp, opened, read_row_groups

__all__ = ["Detected", "Timeline", "read_length", "read_stage_seconds", "read_timelines"]

Detected = tuple[str, int, int]
"""Topic, frame number, and detection number; the last is -1 while the track coasts."""


class Timeline(Record):
    """A track over time: its rows in tracks.parquet, by stamp.

    Attributes
    ----------
    seconds : (k,) time of each row since the first frame of the run, ascending.
    seen : (k,) whether the track was detected.
    causal : (k, c) posterior fused from the views so far.
    keys : topic, frame and detection of each row, as in `Detected`.
    fused : (c,) posterior fused from all views: the last row of ``causal``, unless a clock was set
        back.
    """

    seconds: F8 = array("k", "f8")
    seen: Bool = array("k", "?")
    causal: F4 = array("k c", "f4")
    keys: tuple[Detected, ...]
    fused: F4 = array("c", "f4")


def read_timelines(folder: Path) -> dict[int, Timeline]:
    """Read the timeline of every track of a run, by track number."""
    start = first_stamp(folder)
    with opened(folder / "tracks.parquet") as file:
        table = file.read()
    width = len(table["posterior"][0]) if table.num_rows else 0
    tracks = table["track"].to_numpy()
    seconds = (table["stamp_ns"].to_numpy() - start) * 1e-9
    causal = table["posterior"].combine_chunks().flatten().to_numpy().reshape(-1, width or 1)
    detections = table["detection"].fill_null(-1).to_numpy()
    topics, frames = table["topic"].to_pylist(), table["frame"].to_pylist()
    timelines = {}
    order = np.lexsort((seconds, tracks))
    names, starts = np.unique(tracks[order], return_index=True)
    for track, rows in zip(names.tolist(), np.split(order, starts[1:]), strict=False):
        keys = tuple((topics[k], frames[k], int(detections[k])) for k in rows.tolist())
        seen, fused = detections[rows] >= 0, causal[rows.max()]  # the last row recorded
        timelines[track] = Timeline(seconds[rows], seen, causal[rows], keys, fused)
    return timelines


def read_stage_seconds(folder: Path) -> dict[str, F8]:
    """Return the seconds (n,) that each stage took, one value for each frame in which it ran."""
    seconds_by_stage: dict[str, list[float]] = {}
    for group in read_row_groups(folder / "frames.parquet", ["stages", "seconds"]):
        for row in group.to_pylist():
            for stage, seconds in zip(row["stages"], row["seconds"], strict=True):
                seconds_by_stage.setdefault(stage, []).append(seconds)
    return {stage: np.array(values) for stage, values in seconds_by_stage.items()}


def read_length(folder: Path) -> float:
    """Return the time between the first and last frame by log time, seconds; 0 without frames."""
    groups = read_row_groups(folder / "frames.parquet", ["log_time_ns"])
    times = [time for group in groups for time in group["log_time_ns"].to_pylist()]
    return (max(times) - min(times)) * 1e-9 if times else 0.0
