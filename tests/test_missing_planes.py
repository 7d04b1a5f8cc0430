"""Tests of the warning about missing planes: its reason, in run.json and on screen."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.config import DetectionSettings, Settings
from shapecat.pipeline import process
from shapecat.recordings import open_recording
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.runs.perceive.missing_planes import explain_missing_planes
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.tables.segments import GROUP_FRAMES
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Frame, Perception, Plane, Scene
from tests.messages import CAMERA, EPOCH, SECOND, write
from tests.scenes import record
from tests.test_detection import ball, frame_of, render

MAKE = MessageFactory(2)


def walls(path: Path, depths_m: Iterable[Any]) -> Path:
    """Record a wall facing the camera at each depth, or each image of depths; 0 is no depth."""
    items: list[tuple[str, int, Any]] = []
    for k, depth_m in enumerate(depths_m):
        stamp = EPOCH + k * SECOND // 10
        depth = np.full((CAMERA.height, CAMERA.width), depth_m, np.float32)
        items.append(("/depth/camera_info", stamp, MAKE.camera_info(CAMERA, stamp, "camera")))
        items.append(("/depth/image_raw", stamp, MAKE.image(depth, stamp, "camera")))
    return write(path, items)


def warnings_of(path: Path, out: Path, *, up: str = "auto", range_m: float = 2.0) -> list[str]:
    settings = Settings(detection=DetectionSettings(max_range_m=range_m))
    process(Job(path, out / path.stem, settings=settings, up=up, rrd=False, mcap=False))
    return read_run(out / path.stem)["warnings"]


def test_warning_names_range_if_table_is_beyond_it(tmp_path: Path) -> None:
    """Otherwise users would look for the cause in the up direction."""
    path = record(tmp_path / "far.mcap", 3)

    (warning,) = warnings_of(path, tmp_path, range_m=0.3)

    assert warning == (
        "no supporting plane in 3 of 3 frames: 100% of their depth is beyond "
        "detection.max_range_m, 0.3 m; try a larger one, if the median of 1.3 m is right "
        "(16UC1 is in millimetres, 32FC1 and clouds in metres)"
    )
    assert not warnings_of(path, tmp_path / "again", range_m=2.0)


def test_warning_asks_for_unit_if_depth_is_implausible(tmp_path: Path) -> None:
    """Millimetres in a 32FC1 image read as metres; a larger range would only hide that."""
    (warning,) = warnings_of(walls(tmp_path / "unit.mcap", [30.0, 40.0, 41.0]), tmp_path)

    assert warning == (
        "no supporting plane in 3 of 3 frames: 100% of their depth is beyond "
        "detection.max_range_m, 2 m; the median is 40 m: is the unit right? "
        "16UC1 is in millimetres, 32FC1 and clouds in metres"
    )


def test_warning_distinguishes_missing_depth_wrong_up_and_noise(tmp_path: Path) -> None:
    """A covered lens and a wall at 1 m are not out of range."""
    without_depth = warnings_of(walls(tmp_path / "none.mcap", [0.0] * 3), tmp_path)
    wall = walls(tmp_path / "near.mcap", [1.0, 1.1, 1.2, 1.0])
    wall_in_range = warnings_of(wall, tmp_path, up="0,-1,0")
    noise = np.random.default_rng(1).uniform(0.4, 1.9, (3, CAMERA.height, CAMERA.width))
    only_noise = warnings_of(walls(tmp_path / "noise.mcap", noise), tmp_path)

    with open_recording(wall) as recording:
        run = {**read_run(tmp_path / "near"), "up": {"source": "imu"}}
        (from_imu,) = explain_missing_planes(recording, tmp_path / "near", cast("Any", run))

    assert from_imu.endswith("4 of 4 frames: is up (imu) right? Try another --up")
    assert without_depth == ["no supporting plane in 3 of 3 frames: they have no valid depth"]
    assert wall_in_range[-1] == (
        "no supporting plane in 4 of 4 frames: "
        "is --up right? --up auto estimates up from the planes"
    )
    assert only_noise[-1] == (
        "no supporting plane in 3 of 3 frames: "
        "try --up X,Y,Z, or another range with --set detection.max_range_m=M"
    )


def test_warning_says_that_a_single_object_lacks_its_table(tmp_path: Path) -> None:
    """The advice led users from a missing --up to a wrong one, and back."""
    images = np.zeros((2, CAMERA.height, CAMERA.width), np.float32)
    images[:, 10:40, 20:50] = np.random.default_rng(1).uniform(0.8, 1.1, (2, 30, 30))
    cut_out = walls(tmp_path / "object.mcap", images)
    images[1, 20, 60] = 1.0
    wider = walls(tmp_path / "wider.mcap", images)

    said = [warnings_of(cut_out, tmp_path / up, up=up)[-1] for up in ("auto", "0,-1,0")]

    reason = (
        "; all points are within 0.6 m: if they are a single object, cut out of its scene, "
        "shapecat also needs the points of the table below it"
    )
    assert [text.endswith(reason) for text in said] == [True, True]
    assert said[0].startswith("no supporting plane in 2 of 2 frames: try --up X,Y,Z")
    assert warnings_of(wider, tmp_path)[-1].endswith("with --set detection.max_range_m=M")


def test_only_first_frames_without_plane_are_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading hours of depth images would take as long as perceiving them.

    Another camera sees a plane in its first frames, which have the same numbers.
    """
    up, asked = np.array([0, -1, 0], np.float32), list[tuple[str, int]]()
    plane = Plane(up, -0.5, np.eye(3, dtype=np.float32), 0.5, 0.0)
    keys = [(topic, k) for k in range(3 * GROUP_FRAMES) for topic in ("/other", "/depth")[k > 2 :]]
    with PerceptionTables(tmp_path, categories=("can",), model_id="m") as tables:
        for topic, k in keys:
            scene = Scene(up, (plane,) if topic == "/other" else (), ())
            perception = Perception(topic, k, EPOCH + k, "camera", scene, (), {})
            tables.write([perception], [FrameRow(EPOCH + k, None)])

    def read(*_: Any, **__: Any) -> Iterator[tuple[Frame, None]]:
        for topic, k in keys:
            asked.append((topic, k))
            depth_m = 3.5 if topic == "/depth" and k < 3 else 1
            depth = np.full((CAMERA.height, CAMERA.width), depth_m, np.float32)
            yield Frame(topic, k, EPOCH + k, EPOCH + k, "camera", depth, CAMERA), None

    monkeypatch.setattr("shapecat.runs.perceive.missing_planes.read_frames", read)
    settings = {"detection": {"max_range_m": 2.0}}
    run: Any = {"options": {}, "settings": settings, "up": {"source": "planes"}}
    recording: Any = None
    (warning,) = explain_missing_planes(recording, tmp_path, run)

    assert asked == keys[:6]
    assert "no supporting plane in 96 of 99 frames: 100% of their depth is beyond" in warning


def test_no_warning_if_objects_stand_on_assumed_plane(tmp_path: Path) -> None:
    """A heap of balls hides the table below it, so planes.parquet is empty."""
    centers = [(x / 10, y / 10, 0.03 * abs(x + y)) for x in range(-3, 4) for y in range(-2, 3)]
    depth, _ = render([ball(center, 0.06) for center in centers], tilt_deg=35, noise=0)
    camera = frame_of(depth).camera
    assert camera is not None
    info = MAKE.camera_info(camera, EPOCH, "camera")
    image = MAKE.image(depth, EPOCH, "camera")
    path = write(
        tmp_path / "heap.mcap",
        [("/depth/camera_info", EPOCH, info), ("/depth/image_raw", EPOCH, image)],
    )

    assert not warnings_of(path, tmp_path, up="0.1,-0.8,-0.6")
    assert read_run(tmp_path / "heap")["counts"]["detections"] > 0
    assert pq.read_metadata(tmp_path / "heap" / "planes.parquet").num_rows == 0


def test_warning_is_printed(shapecat: Callable[..., Result], tmp_path: Path) -> None:
    """Users do not open run.json to learn why there are no tracks."""
    path = record(tmp_path / "far.mcap", 2)
    options = ("--set", "detection.max_range_m=0.3", "--jobs", "1", "--no-rrd")

    result = shapecat("process", path, "--out", tmp_path / "out", *options)

    assert result.exit_code == 0
    assert "Warning: far: no supporting plane in 2 of 2 frames: 100%" in result.stderr
    assert "none" in result.stdout
