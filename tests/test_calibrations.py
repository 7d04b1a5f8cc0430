"""Tests of recordings in which some CameraInfo messages hold only zeros."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from shapecat.errors import NoStreamError
from shapecat.pipeline import process
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.simulation.messages import MessageFactory
from tests.messages import EPOCH, write
from tests.scenes import PERIOD, stream

MAKE = MessageFactory(2)
FRAMES = 6


def recorded(path: Path, zeros: Collection[int], *, late: bool = False) -> Path:
    """Write depth images; the calibrations of some frames are zeros.

    The calibrations precede their images, or come ``late``.
    """
    items: list[tuple[str, int, Any]] = []
    for topic, stamp, message in stream(MAKE, FRAMES):
        is_calibration = topic.endswith("camera_info")
        if is_calibration and (stamp - EPOCH) // PERIOD in zeros:
            message.k, message.p = np.zeros(9), np.zeros(12)
        items.append((topic, stamp + (late and is_calibration), message))
    return write(path, sorted(items, key=lambda item: item[1]))


@pytest.mark.parametrize(
    ("zeros", "late"),
    [
        pytest.param(range(3), False, marks=pytest.mark.many),
        (range(3), True),
        ((2, 3), False),
        pytest.param(range(3, 6), True, marks=pytest.mark.many),
    ],
)
def test_zeros_do_not_replace_a_calibration(
    zeros: Collection[int], late: bool, tmp_path: Path
) -> None:
    """Some drivers publish zeros at first; frames with them must not be skipped."""
    names = ("zeros", "plain")
    for name, own in zip(names, (zeros, ()), strict=True):
        path = recorded(tmp_path / f"{name}.mcap", own, late=late)
        process(Job(path, tmp_path / name, mcap=False, rrd=False))
    run, plain = (read_run(tmp_path / name) for name in names)

    assert run["warnings"] == plain["warnings"] == []
    assert run["counts"]["frames"] == FRAMES
    assert run["counts"] == plain["counts"]
    ours, expected = (
        pq.read_table(tmp_path / name / "detections.parquet")["center"].to_pylist()
        for name in names
    )
    assert ours == expected
    assert len(ours) > FRAMES


def test_calibrations_of_zeros_are_reported(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mcap", range(FRAMES))

    with pytest.raises(NoStreamError, match=r"6 CameraInfo without intrinsics \(focal length 0\)"):
        process(Job(path, tmp_path / "out", mcap=False, rrd=False))
