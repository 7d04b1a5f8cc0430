"""Tests of the warning about jumps of the sensor in the fixed frame."""

from pathlib import Path

import numpy as np
import pytest

from shapecat.arrays import F8, I4
from shapecat.geometry import compose
from shapecat.pipeline import process
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.perceive.pose_jumps import explain_jumps
from shapecat.simulation.containers import CONTAINERS
from shapecat.simulation.recorder import robot_links
from shapecat.types import Perception, Pose, Scene
from tests.messages import EPOCH, SECOND
from tests.scenes import PERIOD, back_and_forth, stream

SCENE = Scene(np.array([0, 0, 1], np.float32), (), ())


def turned(yaws: F8) -> F8:
    """Return rotations (n, 3, 3) of a camera that looks horizontally, for ``yaws`` in radians."""
    c, s, o = np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)
    return np.stack([np.stack(row, 1) for row in ((s, o, c), (-c, o, s), (o, o - 1, o))], 1)


def write_frames(
    folder: Path, places: F8, yaws: F8, numbers: I4, rate_hz: float, *, hand_s: int = 1
) -> None:
    """Write the table of the frames of two topics; only the first topic has poses (sensor in map).

    A pose is missing where ``places`` (n, 3) is NaN. Frame ``numbers`` (n,) at ``rate_hz`` give the
    stamps. The second topic begins ``hand_s`` seconds later.
    """
    with PerceptionTables(folder, categories=("can",), model_id="m") as tables:
        for number, place, turn in zip(numbers, places, turned(yaws), strict=True):
            head = None if np.isnan(place).any() else Pose(turn, place)
            for topic, pose, later in (("/head", head, 0), ("/hand", None, hand_s)):
                stamp = EPOCH + int(number * SECOND / rate_hz) + later * SECOND
                perception = Perception(topic, int(number), stamp, "cam", SCENE, (), {})
                tables.write([perception], [FrameRow(stamp, pose)])


def driven(count: int, rate_hz: float) -> F8:
    """Return the places (n, 3) of a robot that drives at .7 m/s and stops after two seconds."""
    seconds = np.minimum(np.arange(count) / rate_hz, 2)
    return seconds[:, None] * [0.6, 0.36, 0] + [3.1, -2.2, 1.3]


def test_correction_of_the_map_is_reported(tmp_path: Path) -> None:
    """All objects get new tracks where localization corrects the pose; nothing else says why."""
    places, yaws = driven(90, 30), np.full(90, 0.7)
    places[40:] += [0.12, -0.16, 0]
    places[75:] += [0, 0.11, 0]
    write_frames(tmp_path, places, yaws, np.arange(90), 30)
    (warning,) = explain_jumps(tmp_path, "map")

    assert warning.startswith(
        "/head: the pose of its sensor in map jumps 2 times, first at 1.3 s, by up to 0.2"
    )
    assert "--fixed-frame" in warning


def test_correction_of_the_heading_is_reported(tmp_path: Path) -> None:
    """Ten degrees at once move objects by 17 cm per metre of distance."""
    yaws = np.where(np.arange(60) < 31, 0.2, 0.2 + np.radians(10))
    write_frames(tmp_path, np.tile([1.0, 2.0, 0.5], (60, 1)), yaws, np.arange(60), 30)
    (warning,) = explain_jumps(tmp_path, "odom")

    assert "jumps once, at 1.0 s, by up to 0.17 m" in warning


def test_time_of_jump_counts_from_first_frame_of_run(tmp_path: Path) -> None:
    """Users look for this time in the recording: poses may begin late, another camera earlier."""
    places = driven(40, 5)
    places[:11], places[17] = np.nan, np.nan
    places[23:] += [0.5, 0.3, 0]
    write_frames(tmp_path, places, np.full(40, 0.7), np.arange(40), 5, hand_s=-2)
    (warning,) = explain_jumps(tmp_path, "map")

    assert "jumps once, at 6.6 s, by up to 0.58 m" in warning  # 2 s, and 23 frames at 5 Hz


@pytest.mark.parametrize("rate_hz", [1, 5, 30])
def test_motion_of_a_robot_is_not_a_jump(tmp_path: Path, rate_hz: float) -> None:
    """A robot may start, stop and turn its head between two frames."""
    places = driven(60, rate_hz)
    yaws = np.sin(np.arange(60) / rate_hz)
    write_frames(tmp_path, places, yaws, np.arange(60), rate_hz)

    assert list(explain_jumps(tmp_path, "map")) == []


def test_motion_during_a_gap_is_not_a_jump(tmp_path: Path) -> None:
    """A recorder that drops frames, or is paused, misses the motion."""
    places, yaws = driven(60, 30), np.full(60, 0.4)
    kept = np.r_[0:20, 45:60]
    write_frames(tmp_path, places[kept], yaws[kept], kept, 30)

    assert list(explain_jumps(tmp_path, "map")) == []


def test_run_of_a_corrected_map_has_the_warning(tmp_path: Path) -> None:
    """A warning that is not in run.json would be lost after processing."""
    shift = Pose(np.eye(3), np.array([0.4, -0.3, 0.0]))
    with CONTAINERS["mcap"].open(tmp_path / "a.mcap") as writer:
        for topic, time, message in stream(writer.messages, 10):
            number = (time - EPOCH) // PERIOD
            if topic == "/tf" and number >= 6:
                pose = compose(shift, tuple(back_and_forth(10))[number].pose)
                message = writer.messages.transforms(robot_links(pose), time)  # noqa: PLW2901
            writer.write(topic, message, time)
    process(Job(tmp_path / "a.mcap", tmp_path / "out"))

    warning = next(text for text in read_run(tmp_path / "out")["warnings"] if "jumps" in text)
    assert warning.startswith(
        "/camera/depth/image_raw: the pose of its sensor in map jumps once, at 0.2 s"
    )
