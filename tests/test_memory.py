"""Test that memory does not grow with the length of a recording."""

import gc
from pathlib import Path

from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from shapecat.types import Detection
from tests.scenes import record

PAGE = 4096


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def test_memory_does_not_grow_with_number_of_frames(tmp_path: Path) -> None:
    """A depth image kept by mistake exceeds the limit; detections are too small, but counted."""
    recording = record(tmp_path / "a.mcap", 260)
    resident: dict[int, int] = {}
    alive: dict[int, int] = {}

    def watch(phase: str, done: int, _total: int | None) -> None:
        if phase == "perceive" and done in {97, 257}:
            # isinstance would ask a weak proxy for the class of an object that may be gone
            alive[done] = sum(type(item) is Detection for item in gc.get_objects())
            resident[done] = resident_bytes()  # afterwards: that list may take 20 MB

    process(Job(recording, tmp_path / "out", rrd=False), watch)

    assert resident[257] - resident[97] < 8 << 20
    assert alive[257] < alive[97] + 400  # a segment that is not written yet has 200
