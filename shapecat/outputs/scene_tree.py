"""A text tree of the planes and objects in a frame, from the tables of a run."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.errors import OutputError
from shapecat.outputs.scene_graph import Node, format_tree
from shapecat.runs.finished import read_finished
from shapecat.runs.tables.reading import keys_of, opened, read_row_groups, read_rows
from shapecat.types import Box, Candidate, LabelledFrame, LabelledObject, Plane, Scene

__all__ = ["describe_scene"]

_CANDIDATE_COLUMNS = (
    "indices",
    "center",
    "size",
    "orientation",
    "plane",
    "on_detection",
    "height_m",
    "touches_border",
    "occluded",
)
"""Columns of detections.parquet from which a candidate is made."""


def describe_scene(folder: Path, frame: int, *, topic: str | None = None) -> str:
    """Return the tree of planes and objects in a frame, in the format of `format_tree`.

    As in the other outputs, merged tracks are one object, and deleted ones are left out.

    Parameters
    ----------
    frame : number of the frame on its topic.
    topic : needed only if several topics have the frame.

    Raises
    ------
    OutputError : the run has no such frame, has it on several topics, or is damaged.
    """
    finished = read_finished(folder)
    topic = _topic(folder, frame, topic)
    labelled = next(f for f in finished.frames() if (f.topic, f.index) == (topic, frame))
    rows = _rows(folder, "tracks", topic, frame, ["detection", "track"])
    deleted = {row["detection"] for row in rows if row["track"] not in finished.labels}
    scene = _read_scene(folder, labelled)
    scene, objects = _apply_labels(scene, labelled.objects, deleted)
    return format_tree(scene, lambda node: _described(scene, node, objects))


def _read_scene(folder: Path, labelled: LabelledFrame) -> Scene:
    """Return the planes and objects of a frame as detection found them.

    Raises
    ------
    OutputError : an object stands on a plane or an object that the frame lacks, or on itself.
    """
    topic, frame, planes = labelled.topic, labelled.index, labelled.planes
    rows = _rows(folder, "detections", topic, frame, _CANDIDATE_COLUMNS)
    if not _are_supported([row["on_detection"] for row in rows]) or any(
        row["plane"] not in (None, *range(len(planes))) for row in rows
    ):
        damage = f"damaged; frame {frame} has objects on nothing"
        msg = f"{folder}: {damage}; process the recording again"
        raise OutputError(msg)
    objects = [_candidate(row, planes) for row in rows]
    return Scene(labelled.up, planes, tuple(objects))


def _are_supported(below: Sequence[int | None]) -> bool:
    """Return False if an object stands, directly or through others, on itself or a missing one.

    ``below`` holds, for each object, the index of the object directly below it, or None.
    """
    supported: set[int | None] = {None}
    while more := {k for k, lower in enumerate(below) if lower in supported} - supported:
        supported |= more
    return len(supported) == len(below) + 1


def _candidate(row: dict[str, Any], planes: Sequence[Plane]) -> Candidate:
    support = 0.0
    if row["plane"] is not None:
        plane = planes[row["plane"]]
        support = float(plane.normal @ row["center"]) - plane.offset - row["height_m"]
    return Candidate(
        indices=row["indices"],
        box=Box(row["center"], row["size"], row["orientation"]),
        plane=row["plane"],
        on_candidate=row["on_detection"],
        support_m=support if abs(support) > 1e-5 else 0.0,  # rounded to float32 in the table
        touches_border=row["touches_border"],
        occluded=row["occluded"],
    )


def _rows(
    folder: Path, table: str, topic: str, frame: int, columns: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the rows of a frame in ``table``; for other rows, only topic and frame are read."""
    path = folder / f"{table}.parquet"
    groups = read_row_groups(path, ["topic", "frame"])
    keys = enumerate(key for group in groups for key in keys_of(group))
    wanted = np.array([k for k, key in keys if key == (topic, frame)], np.int64)
    with opened(path, columns=columns) as file:
        return [row for _, rows in read_rows(file, columns, wanted) for row in rows.to_pylist()]


def _topic(folder: Path, frame: int, topic: str | None) -> str:
    """Return the only topic that has the frame; if ``topic`` is not None, search no other.

    Raises
    ------
    OutputError : no topic has the frame, or several have it.
    """
    frames: dict[str, list[int]] = {}
    for group in read_row_groups(folder / "frames.parquet", ["topic", "frame"]):
        for name, number in keys_of(group):
            frames.setdefault(name, []).append(number)
    if topic in frames:
        frames = {topic: frames[topic]}
    elif topic is not None:
        msg = f"{folder}: no frame on {topic}; its topics: {', '.join(frames) or 'none'}"
        raise OutputError(msg)
    having = [name for name, numbers in frames.items() if frame in numbers]
    if len(having) == 1:
        return having[0]
    if having:
        msg = f"{folder}: frame {frame} is on {', '.join(having)}; choose one with --topic"
        raise OutputError(msg)
    available = ", ".join(f"{n[0]} to {n[-1]} of {name}" for name, n in frames.items()) or "none"
    msg = f"{folder}: no frame {frame}{f' on {topic}' if topic else ''}; its frames: {available}"
    raise OutputError(msg)


def _apply_labels(
    scene: Scene, objects: Sequence[LabelledObject], deleted: Collection[int]
) -> tuple[Scene, dict[int, LabelledObject]]:
    """Join the parts of merged objects, and leave deleted candidates out.

    An object on a deleted one now stands on the support of the deleted one. A merged object stands
    on the support of its lowest part.

    Parameters
    ----------
    deleted : indices of the candidates whose track was deleted.

    Returns
    -------
    The changed scene, and the labelled objects by the index of their candidate in this scene.
    """
    owner = {part: item for item in objects for part in item.detections}
    parts = {n: owner[n].detections if n in owner else (n,) for n in range(len(scene.candidates))}
    shown = [n for n, group_of in parts.items() if n == group_of[0] and n not in deleted]
    index = {part: k for k, n in enumerate(shown) for part in parts[n]}

    def bottom(n: int) -> float:
        """Return the height of the bottom of a candidate's box along up, metres."""
        box = scene.candidates[n].box
        return float(scene.up @ box.center - box.size[2] / 2)

    def changed(n: int) -> Candidate:
        """Return a kept candidate with the box of its object, on the support of its lowest part."""
        base = scene.candidates[min(parts[n], key=bottom)]
        while (below := base.on_candidate) is not None and index.get(below, index[n]) == index[n]:
            base = scene.candidates[below]
        return replace(
            scene.candidates[n],
            box=(owner.get(n) or scene.candidates[n]).box,
            plane=base.plane,
            on_candidate=None if below is None else index[below],
            support_m=base.support_m,
        )

    candidates = tuple(changed(n) for n in shown)
    return replace(scene, candidates=candidates), {index[part]: owner[part] for part in owner}


def _described(scene: Scene, node: Node, objects: Mapping[int, LabelledObject]) -> str:
    if node.kind == "plane":
        plane = scene.planes[node.index]
        return f"plane {node.index}: {plane.height_m:.2f} m high, {plane.area_m2:.2f} m²"
    item = objects.get(node.index)
    name = "object in no track" if item is None else f"{item.category} #{item.track}"
    shown_item = item or scene.candidates[node.index]
    box = shown_item.box if item is None else item.full or item.box
    x, y, z = (100 * float(side) for side in box.size)
    border = ", cut by the border" if shown_item.touches_border else ""
    occluded = ", occluded" if shown_item.occluded else ""
    return f"{name}: {x:.0f} x {y:.0f} x {z:.0f} cm{border}{occluded}"
