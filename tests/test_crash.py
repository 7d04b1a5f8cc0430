"""Tests that a killed run leaves no partial results and can be resumed."""

import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from shapecat.config import Settings
from shapecat.errors import OutputError, RecordingError
from shapecat.pipeline import annotate_again, process
from shapecat.recordings import FrameRange
from shapecat.runs.folder import read_run, writing_outputs
from shapecat.runs.jobs import Job
from tests.mcap_files import read_ros
from tests.scenes import record
from tests.test_exports import relabel
from tests.track_tables import untimed_table

FRAMES = 50
TABLES = ("frames", "detections", "planes", "tracks")


def command(recording: Path, out: Path, *options: str) -> list[str]:
    return [
        *(sys.executable, "-m", "shapecat", "process", str(recording), "--out", str(out)),
        *("--no-rrd", *options),
    ]


def assert_same_tables(a: Path, b: Path) -> None:
    for name in TABLES:
        one, other = (untimed_table(folder, name) for folder in (a, b))
        excluded = [column for column in one.column_names if column == "height_m"]
        assert one.drop_columns(excluded).equals(other.drop_columns(excluded)), name
        for column in excluded:  # to Arrow, NaN differs from itself
            np.testing.assert_array_equal(one[column], other[column])
    assert (a / "tracks.csv").read_bytes() == (b / "tracks.csv").read_bytes()
    assert counts(a) == counts(b)


def counts(folder: Path) -> dict[str, Any]:
    """Return a run's counts without that of resumed frames."""
    return {name: n for name, n in read_run(folder)["counts"].items() if name != "resumed"}


def contents(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("crash") / "table.mcap", FRAMES)


def start(arguments: list[str], begun: Path) -> "subprocess.Popen[bytes]":
    """Start a run, and wait until a file or folder appears.

    The run has a lower priority than this process, which otherwise might be too late to kill it.
    """
    running = subprocess.Popen(
        arguments,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=partial(os.nice, 10),  # noqa: PLW1509  there is no other way
    )
    while running.poll() is None and not begun.exists():
        time.sleep(0.005)
    return running


def kill_after(arguments: list[str], begun: Path, seconds: float) -> bool:
    """Kill a run some time after a file or folder appears; return whether it was still alive."""
    running = start(arguments, begun)
    try:
        running.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        running.kill()
        running.wait()
        return True
    return False


def survive_kills(recording: Path, out: Path, undisturbed: Path, moments: list[float]) -> int:
    """Kill runs ``moments`` seconds after they begin, check the folder each time, then finish.

    Return the number of kills.
    """
    killed = 0
    for moment in moments:
        killed += kill_after(command(recording, out), out / ".table.partial", moment)
        if (out / "table").exists():
            assert contents(out / "table") == contents(undisturbed / "table")
    process(Job(recording, out / "table", rrd=False))
    assert contents(out) == contents(undisturbed)
    assert_same_tables(out / "table", undisturbed / "table")
    return killed


@pytest.mark.parametrize(
    "kills",
    [
        [("segments/000000", 0.0)],
        pytest.param([("", 0.15), ("segments/000000", 0.0)], marks=pytest.mark.many),
    ],
)
def test_killed_run_resumes(
    recording: Path, undisturbed: Path, tmp_path: Path, kills: list[tuple[str, float]]
) -> None:
    """Only frames of the unfinished segment are processed again, whatever an earlier kill left."""
    for begun, seconds in kills:
        running = command(recording, tmp_path)
        assert kill_after(running, tmp_path / ".table.partial" / begun, seconds)
    assert not (tmp_path / "table").exists()

    process(Job(recording, tmp_path / "table", rrd=False))

    assert contents(tmp_path) == contents(undisturbed)
    assert_same_tables(tmp_path / "table", undisturbed / "table")
    assert read_run(tmp_path / "table")["counts"]["resumed"] > 0


@pytest.mark.many
def test_run_survives_kills_at_random_moments(
    recording: Path, undisturbed: Path, tmp_path: Path
) -> None:
    """The moments are early, so that every kill interrupts work."""
    moments = np.random.default_rng(1).uniform(0, 0.3, 3).tolist()

    assert survive_kills(recording, tmp_path, undisturbed, moments) == len(moments)


@pytest.mark.many
def test_run_survives_fifty_kills(recording: Path, undisturbed: Path, tmp_path: Path) -> None:
    running = start(command(recording, tmp_path / "timed"), tmp_path / "timed/.table.partial")
    begun = time.perf_counter()  # the start-up takes longer than the work
    running.wait()
    whole = time.perf_counter() - begun
    rng = np.random.default_rng(2)
    killed = rounds = 0
    while killed < 50:
        rounds += 1
        moments = rng.uniform(0, 0.8 * whole, rng.integers(1, 5)).tolist()
        kills = survive_kills(recording, tmp_path / str(rounds), undisturbed, moments)
        killed, whole = killed + kills, whole if kills else 0.8 * whole  # less load than before


def test_work_under_other_settings_is_discarded_only_if_asked(
    recording: Path, undisturbed: Path, tmp_path: Path
) -> None:
    """A typo in an option must not cost the night's work."""

    def stop(_phase: str, done: int, _total: int | None) -> None:
        if done == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process(Job(recording, tmp_path / "table", settings=Settings(seed=5), rrd=False), stop)
    assert (tmp_path / ".table.partial" / "segments" / "000000").exists()

    with pytest.raises(
        OutputError, match=r"finished work .* \(seed: 5 in the old run, 0 requested\)"
    ):
        process(Job(recording, tmp_path / "table", rrd=False))
    assert (tmp_path / ".table.partial" / "segments" / "000000").exists()

    process(Job(recording, tmp_path / "table", rrd=False, overwrite=True))

    assert "resumed" not in read_run(tmp_path / "table")["counts"]
    assert contents(tmp_path) == contents(undisturbed)
    assert_same_tables(tmp_path / "table", undisturbed / "table")


@pytest.mark.parametrize("phase", ["track", "annotated.mcap"])
def test_finished_phases_are_not_repeated(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: str
) -> None:
    """After an interrupt, the next run begins with the interrupted phase."""
    job = Job(recording, tmp_path / "table", frame_range=FrameRange(end_s=0.3), rrd=False)
    target = {
        "track": "shapecat.runs.tracks.track_run",
        "annotated.mcap": "shapecat.outputs.annotation.annotated_mcap.write_annotated",
    }[phase]
    with monkeypatch.context() as patch:
        patch.setattr(target, interrupt)
        with pytest.raises(KeyboardInterrupt):
            process(job)
    assert [path.name for path in tmp_path.iterdir()] == [".table.partial"]
    monkeypatch.setattr("shapecat.perception._perceive", None)

    process(job)

    assert [path.name for path in tmp_path.iterdir()] == ["table"]


def interrupt(*_args: object, **_options: object) -> None:
    raise KeyboardInterrupt


def test_interrupted_annotation_is_finished(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the outputs would show labels that the table no longer has."""
    folder = tmp_path / "table"
    job = Job(recording, folder, frame_range=FrameRange(end_s=0.3), rrd=False)
    process(job)
    before = contents(folder)
    with monkeypatch.context() as patch:
        patch.setattr("shapecat.outputs.annotation.annotated_mcap.write_annotated", interrupt)
        with pytest.raises(KeyboardInterrupt):
            annotate_again(folder, None)
    (folder / "annotated.mcap").unlink()
    (folder / ".annotated.mcap.partial").write_bytes(b"half")

    process(job)

    assert contents(folder) == before


def test_outputs_show_new_labels_after_an_interrupted_annotation(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next command would take the old outputs for complete."""
    folder = tmp_path / "table"
    job = Job(recording, folder, frame_range=FrameRange(end_s=0.3), rrd=False)
    process(job)
    relabel(folder, {1: "wine glass"})
    with monkeypatch.context() as patch:
        patch.setattr("shapecat.outputs.annotation.annotated_mcap.write_annotated", interrupt)
        with pytest.raises(KeyboardInterrupt):
            annotate_again(folder, None)

    process(job)

    arrays = [m for _, m in read_ros(folder / "annotated.mcap", "/shapecat/detections")]
    shown = {(d.id, d.results[0].hypothesis.class_id) for a in arrays for d in a.detections}
    assert ("1", "wine glass") in shown


def test_two_commands_cannot_write_same_outputs(recording: Path, tmp_path: Path) -> None:
    """Two commands share hidden names: one would remove the other's file, or undo its labels."""
    job = Job(recording, tmp_path / "table", frame_range=FrameRange(end_s=0.3), rrd=False)
    process(job)
    (job.folder / "annotated.mcap").unlink()
    (job.folder / ".annotated.mcap.partial").write_bytes(b"half")
    with writing_outputs(job.folder):
        for command in (partial(annotate_again, job.folder, None), partial(process, job)):
            with pytest.raises(OutputError, match="another command is writing its outputs"):
                command()
        assert (job.folder / ".annotated.mcap.partial").exists()

    annotate_again(job.folder, None)
    assert (job.folder / "annotated.mcap").exists()


def test_two_runs_cannot_write_same_folder(recording: Path, tmp_path: Path) -> None:
    job = Job(recording, tmp_path / "table", frame_range=FrameRange(end_s=0.3), rrd=False)

    def start_second_run(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == ("perceive", 1):
            with pytest.raises(OutputError, match="another process is writing to this folder"):
                process(job)

    process(job, start_second_run)

    assert [path.name for path in tmp_path.iterdir()] == ["table"]


def test_run_completed_by_another_process_before_the_lock_is_kept(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two commands started at once must not repeat work, nor replace a run without --overwrite."""
    job = Job(recording, tmp_path / "table", frame_range=FrameRange(end_s=0.1), rrd=False)

    def complete_by_another(*_: object) -> None:
        monkeypatch.undo()
        process(replace(job, frame_range=FrameRange(end_s=0.2)))

    monkeypatch.setattr("shapecat.pipeline.require_resumable", complete_by_another)
    with pytest.raises(OutputError, match="another process has just completed it"):
        process(job)

    assert read_run(job.folder)["options"]["end_s"] == 0.2
    assert [path.name for path in tmp_path.iterdir()] == ["table"]


@pytest.mark.parametrize("when", ["perceive", "annotate"])
def test_recording_still_being_written_gives_no_results(
    recording: Path, tmp_path: Path, when: str
) -> None:
    """The tables would describe an earlier state of the recording than the outputs of the run."""
    source, out = tmp_path / "live.mcap", tmp_path / "out"
    shutil.copy(recording, source)

    def write(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == (when, 2):
            os.utime(source, ns=(1, 1))

    with pytest.raises(RecordingError, match="changed while it was processed"):
        process(Job(source, out / "live", frame_range=FrameRange(end_s=0.1), rrd=False), write)

    assert not out.exists()


def test_frames_of_changed_recording_are_not_kept(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once the recording is restored, the same command would resume frames of both contents."""
    source, out = tmp_path / "live.mcap", tmp_path / "out"
    shutil.copy(recording, source)

    def change(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == ("perceive", 2):
            os.utime(source, ns=(1, 1))

    def refuse(*_: object) -> None:
        msg = "disk full"
        raise OutputError(msg)

    monkeypatch.setattr("shapecat.pipeline.annotate", refuse)
    with pytest.raises(RecordingError, match="changed while it was processed"):
        process(Job(source, out / "live", frame_range=FrameRange(end_s=0.1)), change)

    assert not out.exists()


def test_unwritable_folder_is_reported_in_one_line(
    shapecat: Callable[..., Result], recording: Path, tmp_path: Path
) -> None:
    """Even root cannot write inside a file."""
    (tmp_path / "file").write_text("")
    result = shapecat("process", recording, "--out", tmp_path / "file")

    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "cannot write the results" in result.stderr


@pytest.mark.parametrize("limit", [20_000, 400_000])
def test_full_disk_is_reported_and_leaves_nothing(
    shapecat: Callable[..., Result], recording: Path, tmp_path: Path, limit: int
) -> None:
    """A limit on the file size simulates a full disk, for tables or for the MCAP."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        done = shapecat("process", recording, "--out", tmp_path / "out", "--no-rrd", "--end", 1.2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    assert done.exit_code == 1, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert "cannot" in done.stderr
    assert not (tmp_path / "out").exists()
