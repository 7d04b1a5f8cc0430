"""Tests of runs whose transforms have gaps."""

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from shapecat.geometry import LINK_FROM_OPTICAL
from shapecat.pipeline import process
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.simulation.messages import MessageFactory
from shapecat.simulation.recorder import robot_links
from tests.messages import EPOCH, SECOND, write
from tests.scenes import OPTICAL, views

MAKE = MessageFactory(2)
FRAMES = 14
STEP = SECOND // 10


def gappy(path: Path, missing: range, *, moves: bool = True) -> Path:
    """Write a recording at 10 Hz of a camera that moves or not; some transforms are missing."""
    static = [("camera_link", OPTICAL, LINK_FROM_OPTICAL)]
    items: list[tuple[str, int, Any]] = [("/tf_static", EPOCH, MAKE.transforms(static, EPOCH))]
    for k in range(FRAMES):
        view = views(FRAMES)[k if moves else 0]
        stamp = EPOCH + k * STEP
        if k not in missing:
            items.append(("/tf", stamp, MAKE.transforms(robot_links(view.pose), stamp)))
        info = MAKE.camera_info(view.camera, stamp, OPTICAL)
        items.append(("/camera/depth/camera_info", stamp, info))
        items.append(("/camera/depth/image_raw", stamp, MAKE.image(view.depth, stamp, OPTICAL)))
    return write(path, items)


@pytest.mark.parametrize(
    ("missing", "moves", "lost", "link"),
    [
        (range(4, 10), True, [5, 6, 7, 8], "base_link"),
        (range(2, 12), True, list(range(3, 11)), "camera_link"),
        (range(4, 8), True, [], ""),  # 0.5 s: as rarely as some localization publishes
        (range(2, 12), False, [], ""),
    ],
)
def test_frames_in_a_gap_have_no_pose_and_a_warning(
    missing: range, moves: bool, lost: list[int], link: str, tmp_path: Path
) -> None:
    """Poses that were interpolated over seconds were wrong by 10 cm, and nothing said so."""
    path = gappy(tmp_path / "a.mcap", missing, moves=moves)
    process(Job(path, tmp_path / "out", mcap=False, rrd=False))
    poses = pq.read_table(tmp_path / "out" / "frames.parquet")["fixed_translation"].to_pylist()

    assert [k for k, pose in enumerate(poses) if pose is None] == lost
    cost = ", whose objects are not tracked"
    if 2 * len(lost) > FRAMES:
        cost = ": its tracks are in the frame of the sensor"
    gaps = f"frames without pose ({len(lost)}×): gaps of up to {(len(missing) + 1) / 10:.2f} s in"
    unknown = f"/camera/depth/image_raw: the pose of its sensor in map is unknown in {len(lost)} of"
    expected = [
        f"{gaps} the transforms of {link}, which moves meanwhile",
        f"{unknown} {FRAMES} frames{cost}",
    ]
    assert read_run(tmp_path / "out")["warnings"] == (expected if lost else [])
