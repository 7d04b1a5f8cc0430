"""Tests of the warning about a sensor whose clock is not that of the transforms."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from shapecat.geometry import LINK_FROM_OPTICAL
from shapecat.pipeline import process
from shapecat.recordings.transforms.delays import Delays
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Pose
from tests.messages import EPOCH, SECOND, write
from tests.scenes import OPTICAL, views

MAKE = MessageFactory(2)
FRAMES = 12
MS = 10**6
TOPIC = "/camera/depth/image_raw"


class Clocks(NamedTuple):
    """Functions from frame number ``k`` to stamp and log time (ns) of its image and transforms.

    The coordinate frame ``moves`` moves in ``odom``. ``later_s`` is added to the stamps of the
    transform from ``map`` to ``odom``, which then moves, too.
    """

    images: Callable[[int], tuple[int, int]]
    transforms: Callable[[int], tuple[int, int]]
    moves: str = "camera_link"
    later_s: float = 0


def at(k: int, ahead_ms: int = 0, late_ms: int = 0, epoch: int = EPOCH) -> tuple[int, int]:
    """Return a stamp by a clock that is ahead, and the log time of a message that comes late."""
    return epoch + (100 * k + ahead_ms) * MS, EPOCH + (100 * k + late_ms) * MS


def recorded(path: Path, clocks: Clocks) -> Path:
    """Write a recording at 10 Hz of a robot with a camera and an arm, of which one may move.

    Its depth images are empty: only poses and times matter here.
    """
    static = [("camera_link", OPTICAL, LINK_FROM_OPTICAL)]
    items: list[tuple[str, int, Any]] = [("/tf_static", EPOCH, MAKE.transforms(static, EPOCH))]
    for k in range(FRAMES):
        stamp, logged = clocks.transforms(k)
        for child in ("camera_link", "arm"):
            pose = views(FRAMES)[k if child == clocks.moves else 0].pose
            link = Pose(pose.rotation @ LINK_FROM_OPTICAL.rotation.T, pose.translation)
            items.append(("/tf", logged, MAKE.transforms([("odom", child, link)], stamp)))
        odom = Pose(np.eye(3), np.array([0.02 * k if clocks.later_s else 0, 0, 0]))
        later = stamp and stamp + round(clocks.later_s * SECOND)
        items.append(("/tf", logged, MAKE.transforms([("map", "odom", odom)], later)))
        view = views(FRAMES)[k]
        stamp, logged = clocks.images(k)
        info = MAKE.camera_info(view.camera, stamp, OPTICAL)
        items.append(("/camera/depth/camera_info", logged, info))
        items.append((TOPIC, logged, MAKE.image(0 * view.depth, stamp, OPTICAL)))
    return write(path, sorted(items, key=lambda item: item[1]))


def warnings(folder: Path, clocks: Clocks, **options: Any) -> list[str]:
    """Return the warnings of a run that are about clocks."""
    path = recorded(folder / "a.mcap", clocks)
    process(Job(path, folder / "out", mcap=False, rrd=False, **options))
    return [text for text in read_run(folder / "out")["warnings"] if "the clock of" in text]


@pytest.mark.parametrize(
    ("ahead_ms", "measured"),
    [
        (500, "0.48 s ahead of"),
        (-500, "0.52 s behind"),
        (7_200_000, "7199.98 s ahead of"),
        (-7_200_000, "7200.02 s behind"),
    ],
)
def test_clock_that_is_not_that_of_the_transforms_is_reported(
    ahead_ms: int, measured: str, tmp_path: Path
) -> None:
    """Poses were wrong by 27 cm, and nothing said so; log times show the difference."""
    clocks = Clocks(lambda k: at(k, ahead_ms, late_ms=23), lambda k: at(k, late_ms=3))

    (warning,) = warnings(tmp_path, clocks)
    assert warning == (
        f"the clock of {TOPIC} is {measured} that of the transforms, by their log times: poses of "
        "its sensor are wrong or unknown; synchronize the clocks of the computers; "
        f"--fixed-frame {OPTICAL} processes this recording without poses"
    )


GOOD = {
    "log times are stamps": Clocks(at, at),
    "images come late": Clocks(lambda k: at(k, late_ms=200), lambda k: at(k, late_ms=3)),
    "log times of one topic are stamps": Clocks(at, lambda k: at(k, late_ms=400)),
    "images without stamps": Clocks(lambda k: (0, at(k)[1]), lambda k: at(k, ahead_ms=-900)),
    "transforms without stamps": Clocks(lambda k: at(k, 900), lambda k: (0, at(k)[1])),
    "simulated time": Clocks(
        lambda k: at(k, late_ms=20, epoch=3 * SECOND), lambda k: at(k, epoch=3 * SECOND)
    ),
    "simulation that is slow": Clocks(
        lambda k: (SECOND * 3 + 100 * k * MS, EPOCH + 900 * k * MS + 60 * MS),
        lambda k: (SECOND * 3 + 100 * k * MS, EPOCH + 900 * k * MS),
    ),
    "only another frame moves": Clocks(lambda k: at(k, 800), lambda k: at(k, late_ms=3), "arm"),
    "nothing moves": Clocks(lambda k: at(k, 800), lambda k: at(k, late_ms=3), ""),
    "localization stamps the future": Clocks(at, lambda k: at(k, late_ms=3), later_s=0.9),
}


@pytest.mark.parametrize("name", GOOD)
def test_other_delays_are_no_different_clocks(name: str, tmp_path: Path) -> None:
    assert warnings(tmp_path, GOOD[name]) == []


def test_without_poses_clocks_do_not_matter(tmp_path: Path) -> None:
    """The warning says how to process such a recording, and must then not appear again."""
    clocks = Clocks(lambda k: at(k, 500), lambda k: at(k, late_ms=3))

    assert warnings(tmp_path, clocks, fixed_frame=OPTICAL) == []


def test_delays_are_kept_all_over_a_long_recording() -> None:
    """A clock may drift, and memory must not grow."""
    delays = Delays()
    for k in range(100_000):
        delays.add(EPOCH + k * MS, EPOCH + k * MS - 7 * k)
    times = np.array([0, 31_234, 77_777, 98_000])

    assert len(delays._delays) <= 1000
    np.testing.assert_allclose(delays.at(EPOCH + times * MS), 7 * times, atol=1)
    assert Delays().all_zero
