"""Tests of stopping a command by a signal: finished frames are kept."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from shapecat import perception
from shapecat.config import Settings
from shapecat.executors.ordered_pool import _MOST_PENDING
from shapecat.pipeline import process
from shapecat.recordings import FrameRange
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.runs.tables.segments import list_segments, read_segment
from shapecat.system import stopping
from tests.processes import obey_interrupts, obey_interrupts_at_low_priority
from tests.scenes import record
from tests.test_crash import assert_same_tables, contents

FRAMES = 60
BEGUN = 8
"""Frames after which a command is stopped: even on a busy machine, it must not end before."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("stopping") / "table.mcap", FRAMES)


class Command:
    """The real command, in its own process group, as a shell starts it."""

    def __init__(self, recording: Path, out: Path, *options: str) -> None:
        arguments = ["process", str(recording), "--out", str(out), "--no-rrd", *options]
        self.running = subprocess.Popen(
            [sys.executable, "-m", "shapecat", *arguments, "--progress", "jsonl"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=obey_interrupts_at_low_priority,  # noqa: PLW1509  there is no other way
        )

    def wait_for_frames(self, count: int) -> None:
        """Read the progress until a number of frames are processed."""
        assert self.running.stderr is not None
        for line in self.running.stderr:
            event = json.loads(line)
            if event.get("phase") == "perceive" and event["done"] >= count:
                return
        pytest.fail("ended before it could be interrupted")

    def signal_group(self, *signums: int) -> None:
        """Send signals as a terminal does: to the command and its workers.

        All arrive at once: between two of them, a command on a busy machine might end.
        """
        for signum in (signal.SIGSTOP, *signums, signal.SIGCONT):
            os.killpg(self.running.pid, signum)

    def end(self) -> tuple[int, str]:
        """Return the exit code, and the output after the signal."""
        _, errors = self.running.communicate(timeout=60)
        return self.running.returncode, errors


@pytest.mark.parametrize(
    ("signum", "code", "jobs"),
    [
        (signal.SIGINT, 130, "2"),
        pytest.param(signal.SIGTERM, 143, "1", marks=pytest.mark.many),
        pytest.param(signal.SIGINT, 130, "1", marks=pytest.mark.many),
        pytest.param(signal.SIGTERM, 143, "2", marks=pytest.mark.many),
    ],
)
def test_signal_keeps_finished_frames(
    recording: Path, undisturbed: Path, tmp_path: Path, signum: int, code: int, jobs: str
) -> None:
    """The signal also reaches the workers, which must neither die nor print a traceback."""
    command = Command(recording, tmp_path, "--jobs", jobs)
    command.wait_for_frames(BEGUN)
    command.signal_group(signum)
    returned, errors = command.end()

    assert returned == code
    assert "Traceback" not in errors
    assert "run the same command again to continue" in errors
    assert not (tmp_path / "table").exists()

    process(Job(recording, tmp_path / "table", rrd=False))

    assert read_run(tmp_path / "table")["counts"]["resumed"] >= BEGUN
    assert contents(tmp_path) == contents(undisturbed)
    assert_same_tables(tmp_path / "table", undisturbed / "table")


def test_termination_keeps_finished_frames(
    shapecat: Callable[..., Result],
    recording: Path,
    undisturbed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Job schedulers send SIGTERM, also to a command without worker processes."""
    calls = count()

    def perceive(*given: Any) -> Any:
        if next(calls) == 40:
            os.kill(os.getpid(), signal.SIGTERM)
        return real(*given)

    with monkeypatch.context() as patch:
        real = perception._perceive
        patch.setattr(perception, "_perceive", perceive)
        done = shapecat("process", recording, "--out", tmp_path, "--no-rrd", "--jobs", 1)
    assert done.exit_code == 143
    assert "run the same command again to continue" in done.stderr
    assert next(calls) < 50  # at the next opportunity, not at the end

    process(Job(recording, tmp_path / "table", rrd=False))

    assert read_run(tmp_path / "table")["counts"]["resumed"] >= 40
    assert contents(tmp_path) == contents(undisturbed)
    assert_same_tables(tmp_path / "table", undisturbed / "table")


@pytest.mark.parametrize(
    ("stopped_in", "seconds", "least"),
    [
        ("track", {"perceive": 1000.0}, 1000),
        # The total is written before the folder is renamed; it is not another phase.
        ("annotate", {"perceive": 1000.0, "compile": 7.0, "total": 1100.0}, 1100),
    ],
)
def test_time_before_interruption_counts_once(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stopped_in: str,
    seconds: dict[str, float],
    least: int,
) -> None:
    """The total would lack the earlier time, or have it twice; all frames count as resumed."""

    def fail(*_: object) -> None:
        raise stopping.Stopped(signal.SIGTERM)

    job = Job(recording, tmp_path / "table", rrd=False, frame_range=FrameRange(end_s=0.5))
    with monkeypatch.context() as broken, pytest.raises(stopping.Stopped):
        broken.setattr(f"shapecat.pipeline.{stopped_in}", fail)
        process(job)
    info_file = tmp_path / ".table.partial" / "run.json"
    info = json.loads(info_file.read_text())
    info["seconds"] |= seconds
    info_file.write_text(json.dumps(info))
    process(job)

    run = read_run(tmp_path / "table")
    assert run["counts"]["resumed"] == run["counts"]["frames"] > 10
    assert least < run["seconds"]["total"] < least + 100


@pytest.mark.many  # `test_command_line` leaves in the same way, but in one process
def test_run_completes_if_progress_reader_leaves(recording: Path, tmp_path: Path) -> None:
    """`--progress jsonl 2>&1 >table | head` would silently end a batch in the middle."""
    words = [sys.executable, "-m", "shapecat", "process", str(recording), "--out", str(tmp_path)]
    options = ["--progress", "jsonl", "--no-rrd", "--no-mcap", "--end", "0.5", "--jobs", "1"]
    with subprocess.Popen(
        [*words, *options], stderr=subprocess.PIPE, stdout=subprocess.PIPE
    ) as run:
        assert run.stderr is not None
        assert b'"event": "plan"' in run.stderr.readline()
        run.stderr.close()
        run.stderr = None
        run.communicate(timeout=300)

    assert run.returncode == 0
    assert (tmp_path / recording.stem / "tracks.csv").exists()


def test_second_signal_ends_process_at_once(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """It must not wait for the frames in progress, or say again that it waits for them."""
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    with stopping.handling_signals():
        signal.raise_signal(signal.SIGINT)
        assert ended == []
        assert "interrupt again to stop immediately" in capfd.readouterr().err
        monkeypatch.setattr(stopping, "request", None)
        with suppress(TypeError):  # here, `os._exit` returns
            signal.raise_signal(signal.SIGTERM)

    assert ended == [143]
    assert capfd.readouterr().err == ""


@pytest.mark.many
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_second_signal_ends_command(
    recording: Path, undisturbed: Path, tmp_path: Path, jobs: str
) -> None:
    """It must end at once, not finish the frames in progress and then say how to continue."""
    command = Command(recording, tmp_path, "--jobs", jobs)
    command.wait_for_frames(BEGUN)
    command.signal_group(signal.SIGINT, signal.SIGTERM)
    returned, errors = command.end()

    assert returned in {130, 143}
    assert "Traceback" not in errors
    assert "run the same command again" not in errors

    process(Job(recording, tmp_path / "table", rrd=False))

    assert_same_tables(tmp_path / "table", undisturbed / "table")


def test_signal_during_imports_ends_command_without_traceback() -> None:
    code = (
        "import os, signal, sys, shapecat.__main__ as entry;"
        "sys.modules['shapecat.cli.main'] = None;"
        "entry.import_module = lambda name: os.kill(os.getpid(), signal.SIGINT);"
        "entry.run()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        capture_output=True,
        preexec_fn=obey_interrupts,
    )

    assert (done.returncode, done.stderr) == (130, b"")


def test_message_of_a_failed_part_does_not_outlive_it(capfd: pytest.CaptureFixture[str]) -> None:
    """A later stop would be announced as "stopping the server", or a later command stop at once."""
    with pytest.raises(OSError, match="no disk"), stopping.stop_message("stopping the server"):
        with suppress(ValueError), stopping.stop_message("stopping the page"):
            raise ValueError
        with stopping.handling_signals():
            signal.raise_signal(signal.SIGTERM)
            assert stopping.asked()
        raise OSError("no disk")  # noqa: EM101, TRY003  any error
    assert capfd.readouterr().err == "stopping the server\n"
    assert not stopping.asked()
    with stopping.handling_signals():
        signal.raise_signal(signal.SIGINT)
    assert "interrupt again to stop immediately" in capfd.readouterr().err


def test_ignored_signal_stays_ignored() -> None:
    """In a background job, Ctrl+C is for the command in the foreground."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopping.handling_signals():
            signal.raise_signal(signal.SIGINT)
            assert not stopping.asked()
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_command_in_another_thread_keeps_a_stop_request() -> None:
    """If the command forgot the request at its end, the main thread would go on for hours."""

    def command() -> None:
        with stopping.handling_signals():
            pass

    with stopping.handling_signals():
        stopping.request()
        other = threading.Thread(target=command)
        other.start()
        other.join()
        assert stopping.asked()


@pytest.fixture
def request_stop() -> Iterator[Callable[[], None]]:
    """Provide a function that pretends a signal has arrived; reset it afterwards."""
    with stopping.handling_signals():
        yield stopping.request


@pytest.mark.usefixtures("late_answers")
def test_frames_in_progress_are_finished(
    recording: Path, tmp_path: Path, request_stop: Callable[[], None]
) -> None:
    """Results that other processes hold when the signal arrives are kept."""

    def stop(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == ("perceive", 3):
            request_stop()

    one_by_one = Settings(reuse_frames=1)
    with pytest.raises(stopping.Stopped):
        process(Job(recording, tmp_path / "table", settings=one_by_one), stop, cores=2)

    partial = tmp_path / ".table.partial" / "segments"
    kept = [read_segment(segment, "frames").num_rows for segment in list_segments(partial)]
    assert sum(kept) == 3 + _MOST_PENDING


def test_recording_changed_during_processing_gives_no_results(tmp_path: Path) -> None:
    """Otherwise half of the tables would be from another recording."""
    source = record(tmp_path / "table.mcap", 16)
    process(Job(source, tmp_path / "before" / "table", rrd=False))

    def write(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == ("perceive", 12):
            source.write_bytes(source.read_bytes())

    from shapecat.errors import RecordingError  # noqa: PLC0415  beside its only use

    job = Job(source, tmp_path / "out" / "table", rrd=False)
    with pytest.raises(RecordingError, match="changed while"):
        process(job, write)
    assert not (tmp_path / "out").exists()

    process(job)

    assert_same_tables(job.folder, tmp_path / "before" / "table")
