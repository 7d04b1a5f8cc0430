"""Test that memory does not grow with the length of a recording."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from shapecat.types import Detection
from tests.scenes import record

PAGE = 4096


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def test_memory_does_not_grow_with_number_of_frames(tmp_path: Path) -> None:
    """A depth image kept per frame exceeds the limit; detections, which are small, are counted."""
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
    assert alive[257] < alive[97] + 400  # a segment that is not written yet has 200 detections


@pytest.mark.parametrize("chosen", [None, "mimalloc"])
def test_arrow_uses_the_allocator_of_the_system_unless_the_user_chose_one(
    chosen: str | None,
) -> None:
    """The command started with the allocator that the user chose, but then replaced it."""
    name = "ARROW_DEFAULT_MEMORY_POOL"
    variables = {key: value for key, value in os.environ.items() if key != name}
    variables |= {} if chosen is None else {name: chosen}
    code = (
        "from shapecat.runs.tables import reading; import pyarrow; "
        "print(pyarrow.default_memory_pool().backend_name)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=variables
    )

    assert done.stdout.strip() == (chosen or "system")
