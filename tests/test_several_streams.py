"""Tests of runs with several sensors: tables, and tracks shared in a fixed frame."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.outputs.exports.formats import export_run
from shapecat.runs.finished import read_finished
from shapecat.runs.perceive.clocks import explain_clocks
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Perception, Scene
from tests.messages import write
from tests.scenes import stream

Run = Callable[..., Result]
DEPTH, POINTS = "/left/depth/image_raw", "/right/depth/points"


def two_cameras(path: Path, frames: int = 6, *, transforms: bool = True) -> Path:
    make = MessageFactory(2)
    left = list(stream(make, frames, camera="/left"))
    right = [
        item for item in stream(make, frames, camera="/right", clouds=True) if "tf" not in item[0]
    ]
    items = sorted([*left, *right], key=lambda item: item[1])
    return write(path, [item for item in items if transforms or "tf" not in item[0]])


def test_object_seen_by_two_sensors_is_one_track(shapecat: Run, tmp_path: Path) -> None:
    recording = two_cameras(tmp_path / "a.mcap")
    for out, names in {"both": [DEPTH, POINTS], "one": [DEPTH]}.items():
        options = [part for name in names for part in ("--topic", name)]
        result = shapecat("process", recording, "--out", tmp_path / out, "--no-rrd", *options)
        assert result.exit_code == 0, result.output
    both, one = (json.loads((tmp_path / o / "a" / "run.json").read_text()) for o in ("both", "one"))
    rows = pq.read_table(tmp_path / "both" / "a" / "tracks.parquet").to_pylist()
    topics: dict[int, set[str]] = {}
    for row in rows:
        topics.setdefault(row["track"], set()).add(row["topic"])

    assert both["counts"]["frames"] == 2 * one["counts"]["frames"] == 12
    assert set(pq.read_table(tmp_path / "both" / "a" / "frames.parquet")["topic"].to_pylist()) == {
        DEPTH,
        POINTS,
    }
    assert sum(both["counts"]["tracks"].values()) == sum(one["counts"]["tracks"].values()) > 3
    assert all(sensors == {DEPTH, POINTS} for sensors in topics.values())
    # Frames of both sensors have equal numbers; their files must not collide.
    crops = export_run(read_finished(tmp_path / "both" / "a"), "crops", tmp_path / "crops")
    assert len(list((tmp_path / "crops").glob("*/*/*.pcd"))) == crops > 12


@pytest.mark.parametrize("ahead_s", [0.5, 0.1])
def test_clocks_that_differ_are_reported(tmp_path: Path, ahead_s: float) -> None:
    """If computers' clocks differ, poses are looked up at wrong times; nothing else reveals it."""
    scene = Scene(np.array([0, 0, 1], np.float32), (), ())
    with PerceptionTables(tmp_path, categories=("can",), model_id="m") as tables:
        for k in range(9):
            for topic, own_s, late_s in ((DEPTH, ahead_s, 0.02), (POINTS, 0, 0.05)):
                logged = k * 10**8 + round(late_s * 1e9)
                stamp = k * 10**8 + round(own_s * 1e9)
                perception = Perception(topic, k, stamp, "cam", scene, (), {})
                tables.write([perception], [FrameRow(logged, None)])
    warnings = list(explain_clocks(tmp_path))

    expected = [f"the clock of {DEPTH} is 0.53 s ahead of that of {POINTS}"]
    assert [text.split(",")[0] for text in warnings] == expected * (ahead_s > 0.3)


def test_without_fixed_frame_sensors_share_no_tracks(shapecat: Run, tmp_path: Path) -> None:
    """Coordinates of the sensors are unrelated: different objects would be merged."""
    recording = two_cameras(tmp_path / "a.mcap", transforms=False)
    options = ("--topic", DEPTH, "--topic", POINTS, "--no-rrd")
    assert shapecat("process", recording, "--out", tmp_path, *options).exit_code == 0
    topics: dict[int, set[str]] = {}
    for row in pq.read_table(tmp_path / "a" / "tracks.parquet").to_pylist():
        topics.setdefault(row["track"], set()).add(row["topic"])

    assert {len(sensors) for sensors in topics.values()} == {1}
    assert set().union(*topics.values()) == {DEPTH, POINTS}
