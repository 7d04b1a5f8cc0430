"""From the tables of a run to labelled frames: what the outputs show."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq

from shapecat.errors import OutputError
from shapecat.run_folder import replacing
from shapecat.tables import read_row_groups
from shapecat.types import Box, LabelledFrame, LabelledObject, NeuralGas, Plane, Pose

__all__ = ["TrackLabel", "adopt_labels", "read_labelled_frames", "read_labels"]

TrackLabel = tuple[str, float]
"""Final category and confidence of a track."""


def read_labels(path: Path) -> dict[int, TrackLabel]:
    """Read tracks.csv: the label a person filled in wins over the category, at confidence 1.

    Raises
    ------
    OutputError : lines that cannot be understood, each named.
    """
    labels: dict[int, TrackLabel] = {}
    problems = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for line, row in enumerate(csv.DictReader(file), start=2):
                try:
                    track = int(row["track"])
                    label = (row["label"] or "").strip()
                    labels[track] = (
                        (label, 1.0) if label else (row["category"], float(row["confidence"]))
                    )
                except (KeyError, TypeError, ValueError):
                    problems.append(f"line {line} needs track, category, confidence, label")
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        problems.append(str(error))
    if problems:
        msg = f"{path}: {'; '.join(problems[:5])}"
        raise OutputError(msg)
    return labels


def adopt_labels(corrected: Path, folder: Path) -> None:
    """Make a corrected table the tracks.csv of a run; the first original is kept beside it.

    Raises
    ------
    OutputError : the table is unreadable or names a track that the run does not have.
    """
    original = folder / "tracks.csv"
    unknown = sorted(read_labels(corrected).keys() - read_labels(original).keys())
    if unknown:
        msg = f"{corrected}: tracks that {folder} does not have: {', '.join(map(str, unknown))}"
        raise OutputError(msg)
    kept = folder / "tracks.original.csv"
    if not kept.exists():
        kept.write_bytes(original.read_bytes())
    with replacing(original) as path:
        path.write_bytes(corrected.read_bytes())


def read_labelled_frames(folder: Path, labels: Mapping[int, TrackLabel]) -> Iterator[LabelledFrame]:
    """Yield the frames of a run in the order they were read, with the final labels.

    Tracks missing from ``labels`` (deleted by a person) are left out.
    """
    shown = _shown_tracks(folder, labels)
    groups = (
        read_row_groups(folder / f"{name}.parquet") for name in ("frames", "detections", "planes")
    )
    for frames, detections, planes in zip(*groups, strict=True):
        objects = _by_frame(detections)
        supports = _by_frame(planes)
        for row in frames.to_pylist():
            key = (row["topic"], row["frame"])
            yield _labelled_frame(
                row, objects.get(key, []), supports.get(key, []), shown.get(key, ({}, ())), labels
            )


_Shown = tuple[dict[int, tuple[int, Any]], tuple[int, ...]]


def _shown_tracks(folder: Path, labels: Mapping[int, TrackLabel]) -> dict[tuple[str, int], _Shown]:
    """Map each frame to its tracks by detection, and to the tracks seen last before it."""
    table = pq.read_table(folder / "tracks.parquet")
    rows = table.filter(pa.compute.is_valid(table["detection"])).to_pylist()
    order = [
        (row["topic"], row["frame"])
        for group in read_row_groups(folder / "frames.parquet", ["topic", "frame"])
        for row in group.to_pylist()
    ]
    shown: dict[tuple[str, int], tuple[dict[int, tuple[int, Any]], list[int]]] = {
        key: ({}, []) for key in order
    }
    last: dict[int, tuple[str, int]] = {}
    for row in sorted(rows, key=lambda r: r["stamp_ns"]):
        if row["track"] not in labels:
            continue
        key = (row["topic"], row["frame"])
        shown[key][0][row["detection"]] = (row["track"], np.array(row["posterior"], np.float32))
        last[row["track"]] = key
    following = _next_of_topic(order)
    for track, key in sorted(last.items()):
        if key in following:
            shown[following[key]][1].append(track)
    return {key: (tracks, tuple(ended)) for key, (tracks, ended) in shown.items()}


def _next_of_topic(order: Sequence[tuple[str, int]]) -> dict[tuple[str, int], tuple[str, int]]:
    following: dict[tuple[str, int], tuple[str, int]] = {}
    latest: dict[str, tuple[str, int]] = {}
    for key in order:
        if key[0] in latest:
            following[latest[key[0]]] = key
        latest[key[0]] = key
    return following


def _by_frame(table: pa.Table) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Group rows by frame; list columns of numbers become arrays without a detour."""
    columns = {
        name: _arrays(table[name])
        if pa.types.is_list(table[name].type)
        else table[name].to_pylist()
        for name in table.column_names
    }
    grouped: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for k in range(table.num_rows):
        row = {name: values[k] for name, values in columns.items()}
        grouped.setdefault((row["topic"], row["frame"]), []).append(row)
    return grouped


def _arrays(column: pa.ChunkedArray) -> list[Any]:
    array = column.combine_chunks()
    return (
        np.split(
            array.flatten().to_numpy(), array.offsets.to_numpy()[1:-1] - array.offsets[0].as_py()
        )
        if len(array)
        else []
    )


def _labelled_frame(
    row: Mapping[str, Any],
    objects: Sequence[Mapping[str, Any]],
    planes: Sequence[Mapping[str, Any]],
    shown: _Shown,
    labels: Mapping[int, TrackLabel],
) -> LabelledFrame:
    tracks, ended = shown
    pose = None
    if row["fixed_translation"] is not None:
        pose = Pose(np.reshape(row["fixed_rotation"], (3, 3)), row["fixed_translation"])
    return LabelledFrame(
        topic=row["topic"],
        index=row["frame"],
        stamp_ns=row["stamp_ns"],
        log_time_ns=row["log_time_ns"],
        frame_id=row["frame_id"],
        fixed_from_sensor=pose,
        planes=tuple(_plane(plane) for plane in planes),
        objects=tuple(
            _labelled_object(found, *tracks[found["detection"]], labels)
            for found in objects
            if found["detection"] in tracks
        ),
        ended=ended,
        seconds=dict(zip(row["stages"], row["seconds"], strict=True)),
    )


def _plane(row: Mapping[str, Any]) -> Plane:
    return Plane(
        normal=row["normal"],
        offset=row["offset"],
        outline=row["outline"].reshape(-1, 3),
        area_m2=row["area_m2"],
        height_m=row["height_m"],
    )


def _labelled_object(
    row: Mapping[str, Any], track: int, causal: Any, labels: Mapping[int, TrackLabel]
) -> LabelledObject:
    category, confidence = labels[track]
    return LabelledObject(
        track=track,
        category=category,
        confidence=confidence,
        box=Box(row["center"], row["size"], row["orientation"]),
        indices=row["indices"],
        gas=NeuralGas(row["neurons"].reshape(-1, 3), row["edges"].reshape(-1, 2)),
        posterior=row["posterior"],
        causal=causal,
    )
