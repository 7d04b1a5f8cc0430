"""What the report tells of each track: its course, and the view that shows it best."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq

from shapecat.arrays import F4, F8, Bool, Record, array
from shapecat.errors import RecordingError, ShapecatError
from shapecat.geometry import level_from_sensor, transform
from shapecat.outputs.report_drawing import Snapshot
from shapecat.outputs.rereading import FinishedRun, clouds_again, open_source
from shapecat.runs.tables import read_row_groups
from shapecat.runs.track_table import TrackRow
from shapecat.types import Frame, NeuralGas

__all__ = ["Course", "Portrait", "read_courses", "read_portraits", "read_stage_seconds"]

_MOST_POINTS = 8000
_Key = tuple[str, int, int]
"""Topic, frame, detection."""


class Course(Record):
    """A track over time.

    ``seconds`` (k,) from the first frame of the run; ``seen`` (k,) where it was detected;
    ``causal`` (k, c) the posterior of the views so far; ``keys`` topic, frame and detection of
    each row, -1 where it coasts.
    """

    seconds: F8 = array("k", "f8")
    seen: Bool = array("k", "?")
    causal: F4 = array("k c", "f4")
    keys: tuple[_Key, ...]


@dataclass(frozen=True)
class Portrait:
    """A track's best view, level; ``size`` (3,) of its box in metres."""

    shot: Snapshot
    size: tuple[float, float, float]
    from_cloud: bool


def read_courses(folder: Path) -> dict[int, Course]:
    """Read the course of every track."""
    start = min(_first_stamps(folder), default=0)
    table = pq.read_table(folder / "tracks.parquet")
    width = len(table["posterior"][0]) if table.num_rows else 0
    tracks = table["track"].to_numpy()
    seconds = (table["stamp_ns"].to_numpy() - start) * 1e-9
    causal = table["posterior"].combine_chunks().flatten().to_numpy().reshape(-1, width or 1)
    detections = pa.compute.fill_null(table["detection"], -1).to_numpy()
    topics, frames = table["topic"].to_pylist(), table["frame"].to_pylist()
    courses = {}
    for track in np.unique(tracks).tolist():
        rows = np.flatnonzero(tracks == track)
        rows = rows[np.argsort(seconds[rows], kind="stable")]
        keys = tuple((topics[k], frames[k], int(detections[k])) for k in rows.tolist())
        courses[track] = Course(seconds[rows], detections[rows] >= 0, causal[rows], keys)
    return courses


def _first_stamps(folder: Path) -> Iterator[int]:
    for group in read_row_groups(folder / "frames.parquet", ["stamp_ns"]):
        if group.num_rows:
            yield int(pa.compute.min(group["stamp_ns"]).as_py())


def read_stage_seconds(folder: Path) -> dict[str, F8]:
    """Return the seconds each stage took on each frame."""
    found: dict[str, list[float]] = {}
    for group in read_row_groups(folder / "frames.parquet", ["stages", "seconds"]):
        for row in group.to_pylist():
            for stage, seconds in zip(row["stages"], row["seconds"], strict=True):
                found.setdefault(stage, []).append(seconds)
    return {stage: np.array(values) for stage, values in found.items()}


def read_portraits(
    finished: FinishedRun, courses: Mapping[int, Course], rows: Sequence[TrackRow]
) -> tuple[dict[int, Portrait], str | None]:
    """Return the best view of each track, and why there are no clouds, if there are none.

    Where the recording is gone, a portrait has the graph alone.
    """
    wanted = _best_views(finished.folder, {row.track: courses[row.track] for row in rows})
    views = _read_views(finished.folder, wanted)
    clouds: dict[int, F4] = {}
    reason = None
    try:
        clouds = _read_clouds(finished, views)
    except ShapecatError as error:
        reason = str(error)
    portraits = {}
    for track, view in views.items():
        portraits[track] = _portrait(view, clouds.get(track, np.zeros((0, 3), np.float32)))
    return portraits, reason


def _best_views(folder: Path, courses: Mapping[int, Course]) -> dict[_Key, int]:
    """Return the view of each track with the most points, one that is whole if there is any."""
    owner = {key: track for track, course in courses.items() for key in course.keys if key[2] >= 0}
    best: dict[int, tuple[float, _Key]] = {}
    columns = ["topic", "frame", "detection", "points", "touches_border", "occluded"]
    for group in read_row_groups(folder / "detections.parquet", columns):
        for topic, frame, detection, points, border, occluded in zip(
            *(group[name].to_pylist() for name in columns), strict=True
        ):
            key = (topic, frame, detection)
            if key in owner:
                score = points * (0.2 if border or occluded else 1.0)
                best[owner[key]] = max(best.get(owner[key], (-1.0, key)), (score, key))
    return {key: track for track, (_, key) in best.items()}


def _read_views(folder: Path, wanted: Mapping[_Key, int]) -> dict[int, dict[str, Any]]:
    """Read the rows of some detections, each with the up vector of its frame."""
    views: dict[int, dict[str, Any]] = {}
    frames = read_row_groups(folder / "frames.parquet", ["topic", "frame", "up"])
    for group, detections in zip(
        frames, read_row_groups(folder / "detections.parquet"), strict=True
    ):
        ups = {(row["topic"], row["frame"]): row["up"] for row in group.to_pylist()}
        names = zip(
            *(detections[name].to_pylist() for name in ("topic", "frame", "detection")), strict=True
        )
        chosen = [k for k, key in enumerate(names) if key in wanted]
        for row in detections.take(pa.array(chosen, pa.int64())).to_pylist():
            track = wanted[row["topic"], row["frame"], row["detection"]]
            views[track] = row | {"up": ups[row["topic"], row["frame"]]}
    return views


def _read_clouds(finished: FinishedRun, views: Mapping[int, Mapping[str, Any]]) -> dict[int, F4]:
    """Read the points of the views from the recording, up to the last that is needed."""
    wanted: dict[tuple[str, int], list[int]] = {}
    for track, view in views.items():
        wanted.setdefault((view["topic"], view["frame"]), []).append(track)
    clouds: dict[int, F4] = {}
    if not wanted:
        return clouds
    with open_source(finished.run) as recording:
        for frame in clouds_again(recording, finished.run):
            for track in wanted.pop((frame.topic, frame.index), []):
                clouds[track] = _points(frame, views[track]["indices"])
            if not wanted:
                break
    return clouds


def _points(frame: Frame, indices: Sequence[int]) -> F4:
    chosen = np.array(indices, np.int64)
    readings = frame.depth.size if frame.depth is not None else len(frame.xyz())
    if chosen.size and chosen.max() >= readings:
        msg = f"frame {frame.index} of {frame.topic} has changed since it was processed"
        raise RecordingError(msg)
    points = frame.xyz(chosen[:: 1 + chosen.size // _MOST_POINTS])
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _portrait(view: Mapping[str, Any], points: F4) -> Portrait:
    up = np.array(view["up"], np.float64)
    neurons = np.array(view["neurons"], np.float32).reshape(-1, 3)
    middle = float(up @ view["center"])
    height = view["height_m"]
    half = view["size"][2] / 2
    offset = middle - (half if height is None or not np.isfinite(height) else height)
    body = points if len(points) else neurons if len(neurons) else np.array([view["center"]])
    level = level_from_sensor(up, offset, body)
    gas = NeuralGas(transform(level, neurons), np.array(view["edges"], np.uint16).reshape(-1, 2))
    shot = Snapshot(transform(level, points), gas, level.translation)
    x, y, z = (float(value) for value in view["size"])
    return Portrait(shot, (x, y, z), bool(len(points)))
