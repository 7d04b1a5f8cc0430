"""Tests of the choice of depth and colour streams among the topics of a recording."""

from pathlib import Path
from typing import Any

import pytest

from shapecat.recordings import cloud_streams, open_recording
from tests.messages import EPOCH, image, info, wavy_depth, write

Item = tuple[str, int, Any]


def depth_and_info(topic: str, info_topic: str, encoding: str = "16UC1") -> list[Item]:
    depth = wavy_depth().astype("<f4") if encoding == "32FC1" else wavy_depth()
    return [(info_topic, EPOCH, info(EPOCH)), (topic, EPOCH, image(EPOCH, depth, encoding))]


@pytest.mark.parametrize("lead", ["/", ""])
def test_calibration_is_found_beside_topic_without_slash(tmp_path: Path, lead: str) -> None:
    """Some recorders omit the leading slash; the depth would have no calibration."""
    items = depth_and_info(f"{lead}depth/image", f"{lead}depth/camera_info")
    items += [
        (f"{lead}rgb/camera_info", EPOCH, info(EPOCH)),
        (f"{lead}ir/image", EPOCH, image(EPOCH, wavy_depth())),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        found = [(s.topic, s.info_topic) for s in cloud_streams(recording)]

    assert found == [(f"{lead}depth/image", f"{lead}depth/camera_info")]
