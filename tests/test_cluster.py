"""Tests of batches in object storage, on workers without a shared disk."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

from tests.object_batch import IN, OUT, Report, fill, made, run, wait_until
from tests.object_storage import object_storage
from tests.processes import descendants
from tests.track_tables import untimed_table

TABLES = ("frames", "detections", "planes", "tracks")
PROCESS = [sys.executable, "-m", "shapecat", "process", f"{IN}/", "--out", OUT, "--no-rrd"]

pytestmark = pytest.mark.many


@pytest.fixture
def bucket(tmp_path: Path) -> Iterator[Path]:
    """Serve a bucket that refuses some requests; provide the log of all requests."""
    with object_storage(tmp_path / "log", refused=0.03) as log:
        yield log


def assert_complete(report: Report, count: int) -> None:
    assert report.code == 0, report.errors
    assert report.states == {"complete": count}
    assert len(report.made) == count
    assert set(report.made.values()) == {1}
    assert report.left == []
    assert report.refused > 0
    assert "bug" not in report.errors


def test_dask_batch_survives_killed_worker_and_scheduler(tmp_path: Path) -> None:
    """The storage is throttled; one worker is killed, then the scheduler and all workers."""
    report = run(18, tmp_path, refused=0.05)

    assert_complete(report, 18)


def ray_workers(driver: int) -> list[int]:
    """Return Ray's processes that work on a recording, below the process that started Ray."""
    names = {pid: Path(f"/proc/{pid}/cmdline").read_bytes() for pid in descendants(driver)}
    return [pid for pid, name in names.items() if name.startswith(b"ray::_attempt_on_worker")]


def test_ray_batch_survives_killed_worker(bucket: Path, tmp_path: Path) -> None:
    fill(10, tmp_path)
    options = ("--executor", "ray", "--jobs", "2")
    with (tmp_path / "errors").open("wb") as errors:
        driver = subprocess.Popen([*PROCESS, *options], stderr=errors, stdout=subprocess.DEVNULL)
        wait_until(lambda: len(made(bucket)) >= 3, driver)
        wait_until(lambda: bool(ray_workers(driver.pid)), driver)
        os.kill(ray_workers(driver.pid)[0], signal.SIGKILL)
        code = driver.wait(timeout=300)

    assert code == 0, (tmp_path / "errors").read_text()
    assert sorted(made(bucket)) == [f"run_{k:04}" for k in range(10)]
    assert_same_tables(tmp_path)


def assert_same_tables(folder: Path) -> None:
    """Compare the results in the bucket with those of one local process."""
    from shapecat.pipeline import process  # noqa: PLC0415  only where it is needed
    from shapecat.runs.jobs import Job  # noqa: PLC0415  the same

    system: Any = fsspec.filesystem("s3")
    for k in range(2):
        here = folder / "here" / f"run_{k:04}"
        process(Job(folder / f"{k}.mcap", here, rrd=False))
        there = folder / "there" / f"run_{k:04}"
        system.get(f"{OUT}/run_{k:04}/", f"{there}/", recursive=True)
        for name in TABLES:
            assert untimed_table(here, name).equals(untimed_table(there, name)), name


def test_killed_batch_resumes_when_started_twice_at_once(bucket: Path, tmp_path: Path) -> None:
    fill(8, tmp_path)
    command = [*PROCESS, "--jobs", "2"]
    quiet: Any = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_until(lambda: len(made(bucket)) >= 2, first)
    first.kill()
    first.wait()

    both = [subprocess.Popen(command, **quiet) for _ in range(2)]
    errors = [process.communicate(timeout=300)[1] for process in both]
    last = subprocess.run(command, check=False, **quiet)

    for text in errors:
        reported = [line for line in text.splitlines() if line.startswith("Error")]
        # If the machine stalls for long, one command may take over from the other.
        known = ("another process is writing to this folder", "another process has taken over")
        assert all(any(words in line for words in known) for line in reported), text
    assert last.returncode == 0, last.stderr
    assert sorted(made(bucket)) == [f"run_{k:04}" for k in range(8)]
    assert_same_tables(tmp_path)
    lines = fsspec.filesystem("s3").cat_file(f"{OUT}/manifest.jsonl").splitlines()
    assert len(lines) == 8
    assert all(b'"state": "complete"' in line for line in lines)
