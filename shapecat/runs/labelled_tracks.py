"""The tracks of a run with their final labels, and the boxes to annotate."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import F4, F8, I4
from shapecat.geometry import (
    box_around,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.tables.reading import (
    Key,
    frame_rows,
    full_boxes_of,
    misfit,
    numbers,
    opened,
    read_rows,
    read_together,
    rows_of,
    topic_codes,
)
from shapecat.runs.tables.schemas import BOX_WIDTH, FULL_BOX
from shapecat.types import AnnotationBox, AnnotationFrame, Box, Pose

__all__ = ["LabelledTracks", "read_annotation_frames"]

_AT_ONCE = 8  # row groups of boxes in memory
_NO_ROWS = slice(0, 0)
_NONE = np.zeros((0, 0), np.float32)


@dataclass(frozen=True)
class LabelledTracks:
    """The detections of a run that have a track, frame by frame, and the labels of the tracks.

    Attributes
    ----------
    frames : the rows of each frame in the arrays below.
    detections : (rows,) number of each detection in its frame.
    tracks : (rows,) number of each detection's track, before tracks were merged.
    labels : the final label of each track.
    last_in : by frame, the final numbers of the tracks that end in it; frames in which none ends
        are missing.
    causal : (rows, categories) posterior of each track up to the frame; empty unless requested.
    full : (rows, 10) centre, size (metres) and orientation of the full boxes in the sensor frame;
        NaN if unknown.
    """

    frames: dict[Key, slice]
    detections: I4
    tracks: I4
    labels: Mapping[int, TrackLabel]
    last_in: dict[Key, tuple[int, ...]]
    causal: F4
    full: F4

    @classmethod
    def read(
        cls, folder: Path, labels: Mapping[int, TrackLabel], *, causal: bool = False
    ) -> "LabelledTracks":
        """Read the tracks of a run; those missing from ``labels`` are left out.

        Raises
        ------
        OutputError : the table of tracks is unreadable.
        """
        with opened(folder / "tracks.parquet", read_dictionary=["topic"]) as file:
            table = file.read(columns=["track", "topic", "frame", "stamp_ns", "detection"])
            topics, codes = topic_codes(table)
            rows = np.flatnonzero(table["detection"].is_valid().to_numpy())
            detections = numbers(table["detection"].drop_null())
            frames, tracks = numbers(table["frame"])[rows], numbers(table["track"])[rows]
            order = np.lexsort((detections, frames, codes[rows]))
            order = order[np.isin(tracks[order], list(labels))]
            rows, tracks = rows[order], tracks[order]
            of_frames = rows_of(topics, codes[rows], frames[order])
            names, named = np.unique(tracks, return_inverse=True)
            final = np.array([labels[name].track for name in names.tolist()], np.int64)[named]
            return cls(
                of_frames,
                detections[order],
                tracks,
                labels,
                _last_in(of_frames, final, numbers(table["stamp_ns"])[rows]),
                _causal(file, rows) if causal else _NONE,
                _full(file, rows),
            )

    def objects(self, key: Key) -> dict[TrackLabel, dict[int, int]]:
        """Return the objects of a frame: for each label, the array row of each detection number.

        An object has several detections if a person merged tracks that are both in the frame.
        Objects are in the order of their first detections.
        """
        rows = self.frames.get(key, _NO_ROWS)
        rows_by_label: dict[TrackLabel, dict[int, int]] = {}
        pairs = zip(self.detections[rows].tolist(), self.tracks[rows].tolist(), strict=True)
        for row, (number, track) in enumerate(pairs, rows.start):
            rows_by_label.setdefault(self.labels[track], {})[number] = row
        return rows_by_label

    def endings(self) -> Callable[[Key], tuple[int, ...]]:
        """Return a function that must be called with each frame in turn.

        For each, it returns the tracks that ended in the previous frame of the same topic.
        """
        latest: dict[str, Key] = {}

        def ended(key: Key) -> tuple[int, ...]:
            before, latest[key[0]] = latest.get(key[0]), key
            return self.last_in.get(before, ()) if before else ()

        return ended

    def full_box(self, row: int) -> Box | None:
        """Return the full box of a row; None if unknown."""
        full = self.full[row]
        return None if np.isnan(full[0]) else Box(full[:3], full[3:6], full[6:])


def read_annotation_frames(
    folder: Path, tracks: LabelledTracks, *, visible: bool = False
) -> Iterator[AnnotationFrame]:
    """Yield the annotations of a run, frame by frame in reading order.

    Annotations have no points, surfaces or posteriors, so that reading them is several times as
    fast as `shapecat.runs.labelled_frames.read_labelled_frames`. Their boxes are full boxes if
    these are known and ``visible`` is False, else visible boxes. The boxes are in the frame
    ``frame_id``.

    Raises
    ------
    OutputError : a table is unreadable, or the tables do not fit together.
    """
    ended = tracks.endings()
    plain_columns = ("topic", "frame", "stamp_ns", "log_time_ns", "frame_id")
    pose_columns = ("frame_translation", "frame_rotation")
    frame_columns = (*plain_columns, "up", *pose_columns)
    detection_columns = ("topic", "frame", "detection", "center", "size", "orientation")
    tables = {"frames": frame_columns, "detections": detection_columns}
    for frames, detections in read_together(folder, tables, at_once=_AT_ONCE):
        plain = [frames[name].to_pylist() for name in plain_columns]
        keys = list(zip(*plain[:2], strict=True))
        ups = numbers(frames["up"]).reshape(-1, 3)
        boxes = _boxes(folder, keys, ups, tracks, detections, visible=visible)
        if frames["frame_rotation"].null_count < len(frames):
            poses = (frames[name].to_pylist() for name in pose_columns)
            boxes = map(_in_named_frame, boxes, *poses)
        yield from map(AnnotationFrame, *plain, boxes, map(ended, keys))


def _boxes(
    folder: Path,
    keys: Sequence[Key],
    ups: F4,
    tracks: LabelledTracks,
    detections: pa.Table,
    *,
    visible: bool,
) -> Iterator[tuple[AnnotationBox, ...]]:
    """Yield the boxes of each frame, sensor frame.

    ``keys`` are n frames, ``ups`` (n, 3) their up directions, and ``detections`` their rows of the
    table. ``visible`` is as in `read_annotation_frames`.
    """
    all_rows, places = frame_rows(detections), _places(detections)
    spans = [tracks.frames.get(key, _NO_ROWS) for key in keys]
    of_frames = [all_rows.get(key, _NO_ROWS) for key in keys]
    firsts, ends = [rows.start for rows in of_frames], [rows.stop for rows in of_frames]
    counts = [span.stop - span.start for span in spans]
    numbered = np.concatenate([tracks.detections[span] for span in spans])
    rows = np.repeat(firsts, counts) + numbered  # detections are numbered by their rows
    detection_numbers = numbers(detections["detection"])
    if np.any(rows >= np.repeat(ends, counts)) or np.any(detection_numbers[rows] != numbered):
        raise misfit(folder)
    places = places[rows]
    if not visible:
        full = np.concatenate([tracks.full[span] for span in spans])
        places = np.where(np.isnan(full), places, full)
    for key, up, span, stop in zip(keys, ups, spans, accumulate(counts), strict=True):
        objects, boxes = tracks.objects(key), places[stop - span.stop + span.start : stop]
        if len(objects) < len(boxes):
            parts = (np.subtract([*rows.values()], span.start) for rows in objects.values())
            boxes = np.array([_join(boxes[rows], up) for rows in parts])
        yield tuple(map(_box, objects, boxes.tolist()))


def _join(places: F8, up: F4) -> F8:
    """Return the only box of an object, or the upright box (10,) around its boxes (n, 10).

    ``up`` (3,) is the up direction of the frame.
    """
    place: F8 = places[0]
    if len(places) > 1:
        box = box_around((Box(row[:3], row[3:6], row[6:]) for row in places), up)
        place = np.concatenate([box.center, box.size, box.orientation])
    return place


def _box(label: TrackLabel, row: Sequence[float]) -> AnnotationBox:
    """Return a box for annotations; ``row`` (10,) is centre, size and orientation."""
    center, size, orientation = tuple(row[:3]), tuple(row[3:6]), tuple(row[6:])
    return AnnotationBox(*label, center, size, orientation)  # type: ignore[arg-type]  # lengths fit


def _causal(file: pq.ParquetFile, rows: I4) -> F4:
    """Return the causal posteriors (n, c) in ``rows`` (n,) of the table of tracks."""
    posteriors = _NONE
    for at, table in read_rows(file, ["posterior"], rows):
        values = np.reshape(numbers(table["posterior"]), (len(table), -1))
        if not len(posteriors):
            posteriors = np.zeros((len(rows), values.shape[1]), np.float32)
        posteriors[at] = values
    return posteriors


def _full(file: pq.ParquetFile, rows: I4) -> F4:
    """Return the full boxes (n, 10) in ``rows`` (n,) of the table of tracks; NaN if unknown."""
    boxes = np.zeros((len(rows), BOX_WIDTH), np.float32)
    for at, table in read_rows(file, FULL_BOX, rows):
        boxes[at] = full_boxes_of(table)
    return boxes


def _places(table: pa.Table) -> F8:
    """Return the visible boxes (n, 10) of detections."""
    widths = {"center": 3, "size": 3, "orientation": 4}
    columns = [numbers(table[name]).reshape(-1, width) for name, width in widths.items()]
    return np.hstack(columns).astype(np.float64)


def _in_named_frame(
    boxes: Sequence[AnnotationBox], translation: Sequence[float] | None, rotation: Any
) -> tuple[AnnotationBox, ...]:
    """Transform boxes from the sensor frame to the frame named in ``frame_id``.

    ``translation`` and ``rotation`` (row by row) are None if the two frames are the same.
    """
    if translation is None:
        return tuple(boxes)
    pose = Pose(np.reshape(rotation, (3, 3)), np.array(translation))
    centers = [transform(pose, box.center).tolist() for box in boxes]
    turns = [pose.rotation @ rotation_from_quaternion(box.orientation) for box in boxes]
    return tuple(
        box._replace(
            center=tuple(center), orientation=tuple(quaternion_from_rotation(turn).tolist())
        )
        for box, center, turn in zip(boxes, centers, turns, strict=True)
    )


def _last_in(frames: Mapping[Key, slice], tracks: I4, stamps_ns: I4) -> dict[Key, tuple[int, ...]]:
    """Return the tracks that end in each frame.

    ``frames`` are the rows of each frame; ``tracks`` and ``stamps_ns`` (n,) are the final track
    number and the stamp of each row.
    Within a topic, the last frame of a track is the one with the highest number, since a clock may
    be set back. If a track is in several topics, it ends in the latest of these frames by stamp.
    """
    keys = np.repeat(np.arange(len(frames)), [rows.stop - rows.start for rows in frames.values()])
    names = list(frames)
    _, topics = np.unique([topic for topic, _ in names], return_inverse=True)
    by_topic = tracks.astype(np.int64) * len(names) + topics[keys]
    at = len(tracks) - 1 - np.unique(by_topic[::-1], return_index=True)[1]
    at = at[np.argsort(stamps_ns[at], kind="stable")]
    last = {t: names[k] for t, k in zip(tracks[at].tolist(), keys[at].tolist(), strict=True)}
    tracks_of: dict[Key, tuple[int, ...]] = {}
    for track, frame in last.items():
        tracks_of[frame] = (*tracks_of.get(frame, ()), track)
    return tracks_of
