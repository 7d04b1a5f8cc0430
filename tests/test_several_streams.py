"""Several sensors in one run share a table, and tracks if they share a fixed frame."""

import json
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
from click.testing import Result

from shapecat.outputs.exports import export_run
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


def test_an_object_that_two_sensors_see_is_one_track(shapecat: Run, tmp_path: Path) -> None:
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
    assert all(seen == {DEPTH, POINTS} for seen in topics.values())
    # Frames of both sensors have the same numbers: no view may take another one's file.
    crops = export_run(tmp_path / "both" / "a", "crops", tmp_path / "crops")
    assert len(list((tmp_path / "crops").glob("*/*/*.pcd"))) == crops > 12


def test_without_a_fixed_frame_each_sensor_has_its_own_tracks(
    shapecat: Run, tmp_path: Path
) -> None:
    """Their coordinates have nothing to do with each other."""
    recording = two_cameras(tmp_path / "a.mcap", transforms=False)
    options = ("--topic", DEPTH, "--topic", POINTS, "--no-rrd")
    assert shapecat("process", recording, "--out", tmp_path, *options).exit_code == 0
    topics: dict[int, set[str]] = {}
    for row in pq.read_table(tmp_path / "a" / "tracks.parquet").to_pylist():
        topics.setdefault(row["track"], set()).add(row["topic"])

    assert {len(seen) for seen in topics.values()} == {1}
    assert set().union(*topics.values()) == {DEPTH, POINTS}
