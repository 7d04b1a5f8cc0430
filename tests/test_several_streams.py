"""Tests of runs with several sensors: tables, and tracks shared in a fixed frame."""

import json
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
from click.testing import Result

from shapecat.outputs.exports.formats import export_run
from shapecat.simulation.messages import MessageFactory
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
    crops = export_run(tmp_path / "both" / "a", "crops", tmp_path / "crops")
    assert len(list((tmp_path / "crops").glob("*/*/*.pcd"))) == crops > 12


def test_without_fixed_frame_sensors_share_no_tracks(shapecat: Run, tmp_path: Path) -> None:
    """Their coordinates are unrelated."""
    recording = two_cameras(tmp_path / "a.mcap", transforms=False)
    options = ("--topic", DEPTH, "--topic", POINTS, "--no-rrd")
    assert shapecat("process", recording, "--out", tmp_path, *options).exit_code == 0
    topics: dict[int, set[str]] = {}
    for row in pq.read_table(tmp_path / "a" / "tracks.parquet").to_pylist():
        topics.setdefault(row["track"], set()).add(row["topic"])

    assert {len(sensors) for sensors in topics.values()} == {1}
    assert set().union(*topics.values()) == {DEPTH, POINTS}
