"""Tests of the warning about poses of the sensor that are worse than none."""

from collections.abc import Container
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shapecat.arrays import F8
from shapecat.runs.perceive.misplacement import explain_misplacement
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES
from tests.messages import EPOCH, SECOND

OBJECTS = np.array([[1.9, 0.3, 0.1], [2.1, -0.4, 0.2], [2.4, 0.1, 0.15]])
TURN = np.array([[0.0, 0.8, 0.6], [-1.0, 0.0, 0.0], [0.0, -0.6, 0.8]])
"""Rotation of a camera that looks along x and down, in the map."""


def write_run(
    folder: Path,
    speed_m_s: float,
    rotation_error: F8,
    object_speed_m_s: float = 0,
    *,
    cells: int = 1,
    empty: Container[int] = range(2, 130, 7),
) -> None:
    """Write the tables of a camera that drives along x; its poses have a ``rotation_error`` (3, 3).

    Objects move along x at ``object_speed_m_s``; the frames ``empty`` have none. There are
    ``cells`` equal rooms, each with such a camera.
    """
    rows: dict[str, list[Any]] = {"topic": [], "center": [], "center_fixed": [], "frame": []}
    frames = range(130)
    for k in (k for k in frames if k not in empty):
        place = np.array([0.1 * k * speed_m_s, -0.2, 1.3])
        own = (OBJECTS + np.array([0.1 * k * object_speed_m_s, 0, 0]) - place) @ TURN
        for cell in range(cells):
            rows["center"] += own.tolist()
            rows["center_fixed"] += (
                own @ rotation_error @ TURN.T + place + [0, 3.0 * cell, 0]
            ).tolist()
            rows["frame"] += [k] * len(own)
            rows["topic"] += [f"/depth{cell or ''}"] * len(own)
    seen: dict[str, list[Any]] = {
        "topic": [f"/depth{cell or ''}" for _ in frames for cell in range(cells)],
        "stamp_ns": [EPOCH + k * SECOND // 10 for k in frames for _ in range(cells)],
        "frame": [k for k in frames for _ in range(cells)],
        "frame_id": [f"optical{cell}" for _ in frames for cell in range(cells)],
    }
    for name, schema, columns in (("frames", FRAMES, seen), ("detections", DETECTIONS, rows)):
        nulls = [None] * len(columns["frame"])
        filled = {field.name: columns.get(field.name, nulls) for field in schema}
        pq.write_table(pa.table(filled, schema), folder / f"{name}.parquet")


OPENGL = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    ("speed_m_s", "rotation_error", "object_speed_m_s", "warns"),
    [
        (0.2, OPENGL, 0, True),
        (0.2, np.eye(3), 0, False),
        (0, OPENGL, 0, False),  # nothing shows that they are wrong
        (0, np.eye(3), 0.2, False),
        (0.2, np.eye(3), 0.2, False),  # on a tray of the robot
    ],
)
def test_poses_that_are_worse_than_none_are_reported(
    tmp_path: Path, speed_m_s: float, rotation_error: F8, object_speed_m_s: float, *, warns: bool
) -> None:
    """In a map with y up, wrong axes of the sensor's frame go unnoticed: tracks drift, or end."""
    write_run(tmp_path, speed_m_s, rotation_error, object_speed_m_s)

    warnings = list(explain_misplacement(tmp_path, "map"))
    assert [w.split(":")[0] for w in warnings] == ["/depth"] * warns


@pytest.mark.parametrize(
    ("seen", "warns"),
    [
        ({*range(6), *range(35, 60)}, True),  # once before the gap, eight times after it
        ({*range(6), *range(46, 60)}, True),
        ({*range(6), *range(48, 60)}, False),  # too seldom
        (range(0, 130, 19), True),  # 1.9 s apart
        (range(0, 130, 20), False),  # 2 s apart
    ],
)
def test_frames_two_seconds_apart_are_not_compared(
    tmp_path: Path, seen: Container[int], *, warns: bool
) -> None:
    """The camera may see other objects by then, but comparisons must go on after such a gap."""
    write_run(tmp_path, 0.2, OPENGL, empty=[k for k in range(130) if k not in seen])

    assert len(list(explain_misplacement(tmp_path, "map"))) == warns


@pytest.mark.parametrize(
    ("rotation_error", "topics"), [(np.eye(3), []), (OPENGL, ["/depth", "/depth1"])]
)
def test_sensors_are_not_compared_with_each_other(
    tmp_path: Path, rotation_error: F8, topics: list[str]
) -> None:
    """Two robots in equal cells see the same, at places far from each other."""
    write_run(tmp_path, 0.2, rotation_error, cells=2)

    warnings = list(explain_misplacement(tmp_path, "map"))
    assert [w.split(":")[0] for w in warnings] == topics
    # With another name, the suggested command would track in a wrong frame again.
    assert [w.split("--fixed-frame ")[1] for w in warnings] == ["optical0", "optical1"][
        : len(topics)
    ]
