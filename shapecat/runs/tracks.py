"""Track the detections of a run, and write the tables of tracks."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from shapecat.arrays import F4, F8
from shapecat.config import TrackingSettings
from shapecat.runs.full_boxes import FullBoxes, full_columns
from shapecat.runs.labels.track_table import ORIGINAL, write_csv
from shapecat.runs.tables.placed_frames import DetectedFrames, sensor_poses, streams_with_poses
from shapecat.runs.tables.reading import (
    first_stamp,
    frame_rows,
    keys_of,
    numbers,
    numbers_or_nan,
    partial_of,
    read_together,
)
from shapecat.runs.tables.schemas import TRACKS
from shapecat.runs.tables.writing import arrow_table, open_writer, rows_as_lists
from shapecat.system.files import replacing
from shapecat.system.memory import release_memory
from shapecat.tracking import DetectionTable, TableBuilder, Track, track_recording
from shapecat.types import UNKNOWN

__all__ = ["track_run"]

_BATCH = 2**17  # rows of tracks.parquet written at a time
_CSV = {
    "track": "",
    "first_s": ".3f",
    "last_s": ".3f",
    "frames": "",
    "category": "",
    "confidence": ".3f",
    "label": "",
    "x": ".3f",
    "y": ".3f",
    "z": ".3f",
    "novelty": ".2f",
    "guess": "",
    "topic": "",
    "run": "",
}
"""The columns of tracks.csv and the format of their numbers."""
_COLUMNS = (
    "topic",
    "frame",
    "center",
    "size",
    "orientation",
    "center_fixed",
    "posterior",
    "novelty",
    "reused_from",
    "touches_border",
    "occluded",
)
"""The columns of the detections table that the tracker needs."""
_UNMOVED = ("numbers", "sizes", "posteriors", "novelties", "partial", "described")
"""Columns of `DetectionTable` that are the same in every coordinate frame."""


def track_run(
    folder: Path, settings: TrackingSettings, categories: Sequence[str], *, work: str = ""
) -> dict[str, int]:
    """Track the detections of a run; write tracks.parquet, tracks.csv and tracks.original.csv.

    Parameters
    ----------
    work : ``work`` id of the run, written to each line of tracks.csv.

    Returns
    -------
    The number of tracks per category.

    Raises
    ------
    OutputError : a table of the run is unreadable, or a table cannot be written.
    """
    placed = streams_with_poses(folder)
    tracks = track_recording(_read_streams(folder, len(categories), placed), settings)
    lines, start_ns = [], first_stamp(folder)
    with replacing(folder / "tracks.parquet") as path, open_writer(path, TRACKS) as writer:
        release_memory()
        full = FullBoxes(folder / "detections.parquet", DetectedFrames.read(folder, placed))
        release_memory()
        for batch in _batches(tracks):
            _write(writer, batch, full, categories)
            lines += [_line(track, categories, start_ns, work) for track in batch]
            batch.clear()  # the next batch may be as long
            release_memory()
    for name in (ORIGINAL, "tracks.csv"):
        with replacing(folder / name) as path:
            _write_csv(path, lines)
    return dict(Counter(line["category"] for line in lines))


def _write(
    writer: pq.ParquetWriter, tracks: list[Track], full: FullBoxes, categories: Sequence[str]
) -> None:
    """Write some tracks with their full boxes."""
    boxes = full.of_tracks(tracks, categories)
    for parts, rows in _parts(tracks):
        columns = _columns(parts, full.frames, boxes[rows], categories)
        writer.write_table(arrow_table(columns, TRACKS))


def _batches(tracks: Iterable[Track]) -> Iterator[list[Track]]:
    """Yield batches of tracks: a long track, or several short ones. The last batch may be empty."""
    batch: list[Track] = []
    for track in tracks:
        if len(track.frames) > _BATCH and batch:
            yield batch
            batch = []
        batch.append(track)
        del track
        if sum(len(one.frames) for one in batch) > _BATCH:
            yield batch
            batch = []
    yield batch


def _parts(tracks: list[Track]) -> Iterator[tuple[list[Track], slice]]:
    """Yield the tracks to write at once, and their rows among those of all ``tracks``.

    A long track is written in parts.
    """
    if len(tracks) != 1:
        yield tracks, slice(None)
        return
    for first in range(0, len(tracks[0].frames), _BATCH):
        rows = slice(first, first + _BATCH)
        yield [tracks[0].part(rows)], rows


def _read_streams(folder: Path, categories: int, placed: set[str]) -> Iterator[DetectionTable]:
    """Yield the detections that are tracked together, numbered by their rows in the table.

    Those of all topics in ``placed`` are tracked together, in the fixed frame; those of any other
    topic on their own, in its sensor frame. Detections without a position in this frame are left
    out. ``categories`` is the number of categories.
    """
    streams: dict[str, TableBuilder] = {}
    count = 0
    of_frames = ("topic", "frame", "stamp_ns", "fixed_translation", "fixed_rotation")
    tables = {"frames": of_frames, "detections": _COLUMNS}
    for frames, detections in read_together(folder, tables):
        keys, rows_of_key = keys_of(frames), frame_rows(detections)
        streams_of_frames = ["" if topic in placed else topic for topic, _ in keys]
        values = _columns_of(detections, categories)
        values["numbers"] = np.arange(count, count + detections.num_rows)
        count += detections.num_rows
        stamps_ns, turns = numbers(frames["stamp_ns"]), sensor_poses(frames, placed)[:, :, :3]
        for stream in dict.fromkeys(streams_of_frames):
            own = [k for k, name in enumerate(streams_of_frames) if name == stream]
            spans = [rows_of_key.get(keys[k], slice(0, 0)) for k in own]
            rows = np.concatenate([np.arange(span.start, span.stop) for span in spans])
            frame_of = np.repeat(own, [span.stop - span.start for span in spans])
            centers = values["center" if stream else "center_fixed"][rows]
            known = ~np.isnan(centers[:, 0])
            rows, frame_of = rows[known], frame_of[known]
            streams.setdefault(stream, TableBuilder(categories)).add(
                [keys[k][0] for k in own],
                frames=[keys[k][1] for k in own],
                stamps_ns=stamps_ns[own],
                counts=np.bincount(frame_of, minlength=len(keys))[own],
                centers=centers[known],
                orientations=_turned(values["orientation"][rows], turns[frame_of]),
                **{name: values[name][rows] for name in _UNMOVED},
            )
    while streams:  # free each stream as soon as possible
        yield streams.pop(next(iter(streams))).table()


def _columns_of(table: pa.Table, categories: int) -> dict[str, Any]:
    """Return the columns for the tracker as arrays; ``center_fixed`` is NaN if unknown.

    ``categories`` is the number of categories.
    """
    first = table["reused_from"].combine_chunks()
    return {
        "center": numbers(table["center"]).reshape(-1, 3),
        "center_fixed": numbers_or_nan(table["center_fixed"]),
        "orientation": numbers(table["orientation"]).reshape(-1, 4),
        "sizes": numbers(table["size"]).reshape(-1, 3),
        "posteriors": numbers(table["posterior"]).reshape(-1, categories),
        "novelties": table["novelty"].to_numpy(),
        "partial": partial_of(table),
        "described": np.where(first.is_null(), table["frame"], first.fill_null(0)),
    }


def _turned(orientations: F4, turns: F8) -> F8:
    """Return orientations (n, 4), x y z w, rotated by rotation matrices (n, 3, 3)."""
    if not len(orientations):
        return np.zeros((0, 4))
    return np.asarray((Rotation.from_matrix(turns) * Rotation.from_quat(orientations)).as_quat())


def _columns(
    tracks: Sequence[Track], frames: DetectedFrames, boxes: F4, categories: Sequence[str]
) -> dict[str, Any]:
    """Return the table columns of some tracks, track after track.

    ``boxes`` (n, 13) are their full boxes, from `FullBoxes.of_tracks`.
    """

    def column(name: str, kind: str, *width: int) -> Any:
        """Concatenate an attribute of the tracks; the result is empty if there are no tracks."""
        values = [np.asarray(getattr(track, name), kind) for track in tracks]
        return np.concatenate([np.zeros((0, *width), kind), *values])

    rows = column("detections", "i4")
    return {
        "track": np.repeat([track.id for track in tracks], [len(track.frames) for track in tracks]),
        "topic": [topic for track in tracks for topic in track.topics],
        "frame": column("frames", "i4"),
        "stamp_ns": column("stamps_ns", "i8"),
        "detection": pa.array(frames.numbers_of(rows).astype(np.int32), mask=rows < 0),
        "center_fixed": pa.FixedSizeListArray.from_arrays(column("centers", "f8", 3).ravel(), 3),
        **full_columns(boxes),
        "posterior": rows_as_lists(column("causal", "f4", len(categories))),
    }


def _line(track: Track, categories: Sequence[str], start_ns: int, work: str) -> dict[str, Any]:
    """Return the values of a track in tracks.csv.

    ``start_ns`` is the stamp from which seconds count; ``work`` is as in `track_run`.
    """
    guess = categories[int(np.argmax(track.posterior))]
    x, y, z = np.median(track.centers, axis=0)
    return {
        "track": track.id,
        "first_s": (int(track.stamps_ns.min()) - start_ns) * 1e-9,
        "last_s": (int(track.stamps_ns.max()) - start_ns) * 1e-9,
        "frames": track.hits,
        "category": UNKNOWN if track.novelty > 1 else guess,
        "confidence": track.confidence,
        "label": "",
        "x": x,
        "y": y,
        "z": z,
        "novelty": track.novelty,
        "guess": guess,
        # After a space, which readers strip, a spreadsheet does not take it for a formula.
        "topic": f" {track.topic}" if track.topic.startswith(("=", "+", "-", "@")) else track.topic,
        "run": work,
    }


def _write_csv(path: Path, lines: Sequence[dict[str, Any]]) -> None:
    """Write a line per track, unknown categories first, then by ascending confidence."""

    def order(line: dict[str, Any]) -> tuple[bool, float, int]:
        return line["category"] != UNKNOWN, line["confidence"], line["track"]

    cells = (
        [format(line[n], kind) for n, kind in _CSV.items()] for line in sorted(lines, key=order)
    )
    write_csv(path, [list(_CSV), *cells])
