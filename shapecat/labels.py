"""From the tables of a run to labelled frames: what the outputs show."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq

from shapecat.arrays import F4, F8
from shapecat.corrections import TrackLabel
from shapecat.geometry import rotation_from_quaternion, upright_box
from shapecat.tables import read_row_groups
from shapecat.types import Box, LabelledFrame, LabelledObject, NeuralGas, Plane, Pose

__all__ = ["box_corners", "read_labelled_frames"]


_BOXES = (
    *("topic", "frame", "detection", "center", "size", "orientation", "posterior"),
    *("height_m", "touches_border", "occluded"),
)
"""The columns of detections that an object needs without its points and its surface."""


def read_labelled_frames(
    folder: Path, labels: Mapping[int, TrackLabel], *, surfaces: bool = True
) -> Iterator[LabelledFrame]:
    """Yield the frames of a run in the order they were read, with the final labels.

    Tracks missing from ``labels`` (deleted by a person) are left out. Tracks that were merged have
    one number; where several are seen in one frame, they are the parts of one object. Without
    ``surfaces`` the objects have no points and an empty gas, and reading takes half the time.
    """
    shown = _shown_tracks(folder, labels)
    groups = (
        read_row_groups(folder / f"{name}.parquet", columns)
        for name, columns in (
            ("frames", None),
            ("detections", None if surfaces else _BOXES),
            ("planes", None),
        )
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
        key, track = (row["topic"], row["frame"]), labels[row["track"]].track
        shown[key][0][row["detection"]] = (track, np.array(row["posterior"], np.float32))
        last[track] = key
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
    parts: dict[int, list[LabelledObject]] = {}
    for found in objects:
        if found["detection"] in tracks:
            track, causal = tracks[found["detection"]]
            parts.setdefault(track, []).append(_labelled_object(found, causal, labels[track]))
    return LabelledFrame(
        topic=row["topic"],
        index=row["frame"],
        stamp_ns=row["stamp_ns"],
        log_time_ns=row["log_time_ns"],
        frame_id=row["frame_id"],
        fixed_from_sensor=pose,
        planes=tuple(_plane(plane) for plane in planes),
        objects=tuple(_join(found, row["up"]) for found in parts.values()),
        ended=ended,
        seconds=dict(zip(row["stages"], row["seconds"], strict=True)),
        up=row["up"],
    )


def _plane(row: Mapping[str, Any]) -> Plane:
    return Plane(
        normal=row["normal"],
        offset=row["offset"],
        outline=row["outline"].reshape(-1, 3),
        area_m2=row["area_m2"],
        height_m=row["height_m"],
    )


def _labelled_object(row: Mapping[str, Any], causal: F4, label: TrackLabel) -> LabelledObject:
    neurons, edges = row.get("neurons", _NONE), row.get("edges", _NONE)
    return LabelledObject(
        track=label.track,
        category=label.category,
        confidence=label.confidence,
        box=Box(row["center"], row["size"], row["orientation"]),
        indices=row.get("indices", _NONE),
        gas=NeuralGas(neurons.reshape(-1, 3), edges.reshape(-1, 2)),
        posterior=row["posterior"],
        causal=causal,
        height_m=row["height_m"],
        touches_border=row["touches_border"],
        occluded=row["occluded"],
    )


_NONE = np.zeros(0, np.uint32)


def _join(parts: Sequence[LabelledObject], up: Sequence[float]) -> LabelledObject:
    """Make one object of the parts of a merged track that are seen in the same frame."""
    if len(parts) == 1:
        return parts[0]
    corners = np.concatenate([box_corners(part.box) for part in parts])
    box = upright_box(corners.astype(np.float32), up)
    bottoms = [float(np.dot(up, part.box.center)) - part.height_m for part in parts]
    starts = np.cumsum([0, *(len(part.gas.neurons) for part in parts)])
    edges = [part.gas.edges + start for part, start in zip(parts, starts[:-1], strict=True)]
    return replace(
        parts[0],
        box=box,
        indices=np.unique(np.concatenate([part.indices for part in parts])),
        gas=NeuralGas(np.concatenate([part.gas.neurons for part in parts]), np.concatenate(edges)),
        posterior=np.mean([part.posterior for part in parts], axis=0),
        causal=np.mean([part.causal for part in parts], axis=0),
        height_m=float(np.dot(up, box.center)) - min(bottoms),
        touches_border=any(part.touches_border for part in parts),
        occluded=any(part.occluded for part in parts),
    )


def box_corners(box: Box) -> F8:
    """Return (8, 3) the corners of a box, sensor frame: the lower four around, then the upper."""
    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    unit = np.array([[x, y, z] for z in (-1, 1) for x, y in signs.tolist()], np.float64)
    rotation = rotation_from_quaternion(box.orientation)
    return np.asarray(box.center + (unit * box.size / 2) @ rotation.T)
