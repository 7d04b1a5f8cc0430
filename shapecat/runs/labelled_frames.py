"""Join the tables and labels of a run into labelled frames for the outputs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shapecat.arrays import F4
from shapecat.geometry import box_around
from shapecat.runs.labelled_tracks import LabelledTracks
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.tables.masks import masks_in
from shapecat.runs.tables.reading import misfit, numbers, read_together
from shapecat.system.memory import release_memory
from shapecat.types import (
    Box,
    LabelledFrame,
    LabelledObject,
    NeuralGas,
    Plane,
    Pose,
)

__all__ = ["read_labelled_frames", "rows_by_frame"]


_OBJECT = (
    "topic",
    "frame",
    "detection",
    "touches_border",
    "occluded",
    "center",
    "size",
    "orientation",
    "height_m",
    "indices",
    "posterior",
    "neurons",
    "edges",
)
"""Columns of a detection that the outputs show."""


def read_labelled_frames(folder: Path, labels: Mapping[int, TrackLabel]) -> Iterator[LabelledFrame]:
    """Yield the frames of a run in reading order, with their final labels.

    Tracks missing from ``labels`` (deleted by a person) are left out. Merged tracks have the same
    number; if several of them are in one frame, they are joined into one object.

    Raises
    ------
    OutputError : a table is unreadable, or the tables do not fit together.
    """
    tracks = LabelledTracks.read(folder, labels, causal=True)
    release_memory()  # of the table of tracks
    ended = tracks.endings()
    tables = {"frames": None, "detections": _OBJECT, "planes": None}
    if (folder / "masks.parquet").exists():
        tables["masks"] = None
    for frames, detections, planes, *masks in read_together(folder, tables):
        objects = rows_by_frame(detections)
        supports = rows_by_frame(planes)
        masks_of = dict(chain.from_iterable(map(masks_in, masks)))
        for row in frames.to_pylist():
            key = (row["topic"], row["frame"])
            detected_rows = {row["detection"]: row for row in objects.get(key, [])}
            if any(rows.keys() - detected_rows.keys() for rows in tracks.objects(key).values()):
                raise misfit(folder)
            planes_of_frame = supports.get(key, [])
            frame = _labelled_frame(row, detected_rows, planes_of_frame, tracks, ended(key))
            yield replace(frame, masks=masks_of.pop(key, None))
        if masks_of:  # of frames that are not in the frames table
            raise misfit(folder)


def rows_by_frame(table: pa.Table) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Group rows by frame; the values of list columns without nulls become arrays."""
    columns = {name: _values(table[name]) for name in table.column_names}
    grouped: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for k in range(table.num_rows):
        row = {name: values[k] for name, values in columns.items()}
        grouped.setdefault((row["topic"], row["frame"]), []).append(row)
    return grouped


def _values(column: pa.ChunkedArray) -> Sequence[Any]:
    """Return the values of a column, one per row.

    Values of list columns without nulls are arrays, others are Python values.
    """
    fixed = pa.types.is_fixed_size_list(column.type)
    if column.null_count or not (fixed or pa.types.is_list(column.type)):
        return list(column.to_pylist())
    if fixed:
        return list(numbers(column).reshape(len(column), column.type.list_size))
    stops = np.cumsum(column.combine_chunks().value_lengths().to_numpy()).tolist()
    flat = numbers(column)
    return [flat[a:b] for a, b in zip([0, *stops[:-1]], stops, strict=True)] if stops else []


def _labelled_frame(
    row: Mapping[str, Any],
    detections: Mapping[int, Mapping[str, Any]],
    planes: Sequence[Mapping[str, Any]],
    tracks: LabelledTracks,
    ended: tuple[int, ...],
) -> LabelledFrame:
    """Join the table rows of a frame, its detections (by number) and its planes.

    ``ended`` are the tracks that ended in the topic's previous frame.
    """
    key = (row["topic"], row["frame"])
    pose = None
    if row["fixed_translation"] is not None:
        pose = Pose(np.reshape(row["fixed_rotation"], (3, 3)), row["fixed_translation"])
    objects = [
        [
            _labelled_object(detections[number], label, tracks.causal[row], tracks.full_box(row))
            for number, row in rows.items()
        ]
        for label, rows in tracks.objects(key).items()
    ]
    return LabelledFrame(
        topic=row["topic"],
        index=row["frame"],
        stamp_ns=row["stamp_ns"],
        log_time_ns=row["log_time_ns"],
        frame_id=row["frame_id"],
        fixed_from_sensor=pose,
        planes=tuple(_plane_of(plane) for plane in planes),
        objects=tuple(_join(parts, row["up"]) for parts in objects),
        ended=ended,
        seconds=dict(zip(row["stages"], row["seconds"], strict=True)),
        up=row["up"],
        reused_from=row["reused_from"],
    )


def _plane_of(row: Mapping[str, Any]) -> Plane:
    """Return the plane of a row of planes.parquet."""
    return Plane(
        normal=row["normal"],
        offset=row["offset"],
        outline=np.reshape(row["outline"], (-1, 3)),
        area_m2=row["area_m2"],
        height_m=row["height_m"],
    )


def _labelled_object(
    row: Mapping[str, Any], label: TrackLabel, causal: F4, full: Box | None
) -> LabelledObject:
    """Return an object from its detection's row; ``causal`` (c,) is the causal posterior."""
    return LabelledObject(
        track=label.track,
        category=label.category,
        confidence=label.confidence,
        box=Box(row["center"], row["size"], row["orientation"]),
        indices=row["indices"],
        gas=NeuralGas(row["neurons"].reshape(-1, 3), row["edges"].reshape(-1, 2)),
        posterior=row["posterior"],
        causal=causal,
        height_m=row["height_m"],
        touches_border=row["touches_border"],
        occluded=row["occluded"],
        detections=(row["detection"],),
        full=full,
    )


def _join(parts: Sequence[LabelledObject], up: Sequence[float]) -> LabelledObject:
    """Join the parts of a merged track in one frame into one object.

    ``up`` (3,) is the up direction of the frame.
    """
    if len(parts) == 1:
        return parts[0]
    box = box_around([part.box for part in parts], up)
    full = box_around([part.full or part.box for part in parts], up)
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
        height_m=float(np.dot(up, box.center) - np.fmin.reduce(bottoms)),  # NaN without a plane
        touches_border=any(part.touches_border for part in parts),
        occluded=any(part.occluded for part in parts),
        detections=tuple(number for part in parts for number in part.detections),
        full=full if any(part.full for part in parts) else None,
    )
