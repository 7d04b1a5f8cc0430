"""Tests of batches: same tables on every executor, and no recording lost or repeated."""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from shapecat.batch.finding import find_recordings
from shapecat.batch.ledger import Outcome
from shapecat.batch.manifest import FileManifest
from shapecat.batch.plans import Batch, plan_batch
from shapecat.batch.runs import process_here, process_on
from shapecat.config import Settings
from shapecat.errors import RecordingError, common_exit_code
from shapecat.executors import LocalExecutor, WorkerLostError, open_executor
from shapecat.learning import load_model, save_model
from shapecat.recordings import FrameRange
from shapecat.runs.jobs import Job
from tests.messages import EPOCH, SECOND, make, write
from tests.processes import (
    DaskCluster,
    alive,
    children,
    free_address,
    obey_interrupts_at_low_priority,
    wait_for,
)
from tests.scenes import record
from tests.test_crash import assert_same_tables
from tests.track_tables import untimed_table

Run = Callable[..., Result]
TABLES = ("frames", "detections", "planes", "tracks")
NAMES = ("bag", "folder", "log")
FRAMES = 10


class Watcher:
    """Collects the folders that report progress; calls ``act`` with each folder and phase."""

    def __init__(self, act: Callable[[str, str], None] | None = None) -> None:
        self.reported: set[str] = set()
        self._act = act

    def __call__(self, folder: str, phase: str, done: int, total: int | None) -> None:
        """Receive the progress of a recording."""
        assert total is None or done <= total
        self.reported.add(folder)
        if self._act is not None:
            self._act(folder, phase)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder as found in a lab: three formats, a broken file, sidecars, old results."""
    folder = tmp_path_factory.mktemp("recordings")
    (folder / "monday").mkdir()
    record(folder / "monday" / "log.mcap", FRAMES)
    record(folder / "monday" / "bag.bag", FRAMES, container="ros1")
    record(folder / "folder", FRAMES, container="ros2")
    (folder / "broken.mcap").write_bytes(b"no recording")
    (folder / "monday" / "log.truth.json").write_text("{}")
    (folder / "old" / "log").mkdir(parents=True)
    (folder / "old" / "log" / "run.json").write_text("{}")
    (folder / "old" / "log" / "annotated.mcap").write_bytes(b"")
    return folder


def planned(recordings: Path, out: Path, *, end_s: float | None = None) -> Any:
    job = Job(Path(), Path(), rrd=False, frame_range=FrameRange(end_s=end_s))
    return plan_batch(job, [str(recordings)], str(out))


@pytest.fixture(scope="module")
def one_by_one(shapecat: Run, recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("one") / "out"
    done = shapecat("process", recordings, "--out", out, "--jobs", 1, "--no-rrd")
    assert done.exit_code == 1, done.output
    return out


def assert_same(expected: Path, actual: Path, names: Sequence[str] = NAMES) -> None:
    found = {path.name for path in actual.iterdir()}
    assert found == {*names, "manifest.jsonl"}
    for folder in names:
        for name in TABLES:
            a, b = (untimed_table(out / folder, name) for out in (expected, actual))
            assert a.equals(b), (folder, name)
        tracks = [(out / folder / "tracks.csv").read_bytes() for out in (expected, actual)]
        assert tracks[0] == tracks[1]


def states(out: Path) -> dict[str, str]:
    return {name: e.state for name, e in FileManifest(out / "manifest.jsonl").entries.items()}


ALL_DONE = {**dict.fromkeys(NAMES, "complete"), "broken": "failed"}


def test_bad_recording_is_reported_and_others_complete(recordings: Path, one_by_one: Path) -> None:
    assert states(one_by_one) == ALL_DONE
    entries = FileManifest(one_by_one / "manifest.jsonl").entries
    assert entries["broken"].exit_code == 3
    assert str(recordings / "broken.mcap") in entries["broken"].message
    assert entries["log"].frames == FRAMES
    assert {path.name for path in one_by_one.iterdir()} == {*NAMES, "manifest.jsonl"}


def test_plan_progress_and_closing_table_are_printed(
    shapecat: Run, recordings: Path, tmp_path: Path
) -> None:
    sources = (recordings / "monday" / "log.mcap", recordings / "broken.mcap")
    options = ("--out", tmp_path, "--end", 0.1, "--no-rrd")
    first = shapecat("process", *sources, *options, "--jobs", 1, "--progress", "jsonl")
    again = shapecat("process", *sources, *options, "--jobs", 1, "--progress", "plain")

    events = [json.loads(line) for line in first.stderr.splitlines()]
    assert events[0]["event"] == "plan"
    assert events[0]["recordings"] == 2
    ended = {event["folder"]: event for event in events if event["event"] == "ended"}
    assert {folder: event["state"] for folder, event in ended.items()} == {
        str(tmp_path / "log"): "complete",
        str(tmp_path / "broken"): "failed",
    }
    assert states(tmp_path) == {"log": "complete", "broken": "failed"}
    reported = {event["recording"] for event in events if event["event"] == "progress"}
    assert reported == {str(sources[0])}
    assert "1 complete, 1 failed" in first.stdout
    assert "1 to retry" in again.stderr
    assert "1 already complete" in again.stderr
    assert again.stdout.count("already complete") == 1


def test_complete_recordings_are_not_opened_again(
    shapecat: Run, recordings: Path, one_by_one: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    before = (one_by_one / "log" / "run.json").stat().st_mtime_ns
    monkeypatch.setattr("shapecat.batch.runs.process", refuse)
    done = shapecat(
        *("process", recordings / "monday", recordings / "folder", "--out", one_by_one),
        *("--jobs", 1, "--no-rrd"),
    )

    assert done.exit_code == 0, done.output
    assert done.stdout.count("already complete") == 3
    assert (one_by_one / "log" / "run.json").stat().st_mtime_ns == before


def test_changed_work_is_not_complete(recordings: Path, one_by_one: Path) -> None:
    """Otherwise results of other content or settings are kept, or a missing output is ignored."""

    def status(job: Job) -> str:
        with plan_batch(job, [str(recordings)], str(one_by_one)) as batch:
            return next(task.status for task in batch.tasks if task.job.folder.name == "log")

    same = Job(Path(), Path(), rrd=False)
    assert status(same) == "complete"
    assert status(Job(Path(), Path(), rrd=False, frame_range=FrameRange(every=2))) == "check"
    assert status(replace(same, settings=Settings(seed=7))) == "check"
    assert status(Job(Path(), Path(), rrd=False, overwrite=True)) == "new"
    log = recordings / "monday" / "log.mcap"
    stamp = log.stat()
    os.utime(log, ns=(stamp.st_atime_ns, stamp.st_mtime_ns + 1))
    assert status(same) == "check"
    os.utime(log, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    mcap = one_by_one / "log" / "annotated.mcap"
    mcap.rename(mcap.with_name("aside"))
    assert status(same) == "check"
    mcap.with_name("aside").rename(mcap)


@pytest.mark.many
def test_two_processes_give_same_tables(
    shapecat: Run, recordings: Path, one_by_one: Path, tmp_path: Path
) -> None:
    done = shapecat("process", recordings, "--out", tmp_path, "--jobs", 2, "--no-rrd")

    assert done.exit_code == 1
    assert_same(one_by_one, tmp_path)
    assert states(tmp_path) == ALL_DONE


@pytest.mark.many  # the tests with `late_answers` check the same without starting processes
@pytest.mark.usefixtures("all_awake")
def test_processes_sharing_frames_give_same_tables(recordings: Path, tmp_path: Path) -> None:
    """Processes share blocks of frames; with blocks of two frames, both processes have some."""
    from shapecat.pipeline import process  # noqa: PLC0415  beside its only use

    source, settings = recordings / "monday/log.mcap", Settings(reuse_frames=2)
    for name, cores in (("alone", 1), ("shared", 2)):
        process(Job(source, tmp_path / name, settings=settings, rrd=False), cores=cores)

    assert_same_tables(tmp_path / "alone", tmp_path / "shared")


def test_shards_give_same_tables(
    shapecat: Run, recordings: Path, one_by_one: Path, tmp_path: Path
) -> None:
    """Together, the shards process every recording exactly once."""
    codes, texts = [], []
    for k in range(5):
        options = ("--out", tmp_path, "--shard", f"{k}/5", "--jobs", 1, "--no-rrd")
        result = shapecat("process", recordings, *options)
        codes.append(result.exit_code)
        texts.append(result.stderr)

    assert sorted(codes) == [0, 0, 0, 0, 3]
    empty = ["no recordings in this shard" in text for text in texts]
    assert empty == [False, False, False, False, True]  # there are four recordings
    assert_same(one_by_one, tmp_path)
    assert states(tmp_path) == ALL_DONE
    lines = (tmp_path / "manifest.jsonl").read_text().splitlines()
    assert sum('"complete"' in line for line in lines) == 3
    wrong = shapecat("process", recordings, "--out", tmp_path, "--shard", "5/4")
    assert wrong.exit_code == 2


@pytest.mark.parametrize(("gap_s", "found"), [(-0.5, 2), (0.01, 1), (60, 2)])
def test_takes_are_not_mixed_in_one_run(tmp_path: Path, gap_s: float, found: int) -> None:
    """Only files that follow each other at once are parts of one bag."""
    (tmp_path / "lab").mkdir()
    for k, begin in enumerate((0, SECOND + int(gap_s * SECOND))):
        items = [("/x", EPOCH + begin + at, make("std_msgs/msg/String", "x")) for at in (0, SECOND)]
        write(tmp_path / "lab" / f"take_{k}.mcap", items)

    assert len(find_recordings([str(tmp_path)]).sources) == found


def test_metadata_of_a_data_set_makes_no_bag(tmp_path: Path) -> None:
    """Taken for a bag, the folder would give one run of mixed takes, without its subfolders."""
    takes = {tmp_path / name for name in ("monday.mcap", "tuesday.bag", "more/wednesday.mcap")}
    (tmp_path / "more").mkdir()
    for take in takes:
        take.touch()
    (tmp_path / "metadata.yaml").write_text("robot: stretch\nlicense: CC0\n")
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "x.mcap").touch()
    (bag / "metadata.yaml").write_text(f"# {'note' * 99}\nrosbag2_bagfile_information:\n")

    found = {Path(source.path) for source in find_recordings([str(tmp_path)]).sources}
    assert found == {*takes, bag}


def test_folders_are_searched_and_bags_stay_whole(tmp_path: Path) -> None:
    """A shell expands folder/** to folders, their contents, and files of other programs.

    Each recording must be found once.
    """
    bags = (
        "bag/bag_0.db3",
        "bag/metadata.yaml",
        "old/x_0.db3",
        "two/a_0.mcap",
        "two/a_1.mcap.zstd",
        "cut/cut_0.mcap",
        "cut/cut_1.mcap",
    )
    takes = {
        *("runs/run_1.mcap", "runs/run_2.mcap", "takes/take_0.mcap", "takes/take_1.mcap"),
        *("days/monday.db3", "days/tuesday.db3"),
        *("robot/robot_0.bag", "robot/robot_1.bag"),  # ROS 1 has no bag folders
        *("card/LAB.MCAP", "card/LAB.DB3", "killed/z.bag.active"),
    }
    for name in ("x.mcap", "y.db3", "d/z.bag", *takes, *bags):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    for name in ("x.truth.json", "notes.txt", "d/.z.bag.partial"):
        (tmp_path / name).write_text("{}")
    expected = {"x.mcap", "y.db3", "bag", "old", "two", "cut", "d/z.bag", *takes}

    for sources in ([tmp_path], sorted(tmp_path.rglob("[!.]*")), [tmp_path, *tmp_path.iterdir()]):
        found = find_recordings([str(path) for path in sources])
        kept = [str(Path(s.path).relative_to(tmp_path)) for s in found.sources]
        assert sorted(kept) == sorted(expected)
    alone = find_recordings([str(tmp_path / "notes.txt")])
    assert [source.stem for source in alone.sources] == ["notes"]
    (tmp_path / "none").mkdir()
    with pytest.raises(RecordingError, match="no recording found"):
        find_recordings([str(tmp_path / "none")])


def drain(batch: Batch, executor: Executor, watcher: Watcher) -> list[Outcome]:
    return list(process_on(executor, batch.tasks, watcher, manifest=batch.manifest))


@pytest.mark.many
def test_killed_local_worker_is_replaced(
    recordings: Path, one_by_one: Path, tmp_path: Path
) -> None:
    killed: list[str] = []
    executor = LocalExecutor(1)

    def kill_once(folder: str, phase: str) -> None:
        if phase == "perceive" and not killed:
            killed.append(folder)
            executor._workers[0].process.kill()

    with executor, planned(recordings, tmp_path) as batch:
        drain(batch, executor, Watcher(kill_once))

    assert killed
    assert_same(one_by_one, tmp_path)
    entries = FileManifest(tmp_path / "manifest.jsonl").entries
    assert {entry.folder: entry.tries for entry in entries.values()} == {
        **dict.fromkeys([*NAMES, "broken"], 1),
        killed[0]: 2,
    }


class Fragile(Executor):
    """An executor that loses its worker with every job of one folder, nine times at most."""

    def __init__(self, folder: str) -> None:
        self.begun: list[str] = []
        self._folder = folder

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run the call at once, unless the worker is to be lost."""
        future: Future[Any] = Future()
        name = args[0].folder.name
        self.begun.append(name)
        if name == self._folder and self.begun.count(name) < 10:
            future.set_exception(WorkerLostError("the worker process died"))
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_recording_that_kills_its_workers_is_given_up(recordings: Path, tmp_path: Path) -> None:
    fragile = Fragile("bag")
    with planned(recordings, tmp_path, end_s=0.1) as batch:
        outcomes = drain(batch, fragile, Watcher())

    assert fragile.begun.count("bag") == 2
    (failed,) = [o for o in outcomes if o.job.folder.name == "bag"]
    assert "gave up after 2 tries" in failed.message
    assert states(tmp_path) == {**ALL_DONE, "bag": "failed"}


class OtherVersion(Executor):
    """An executor whose workers have another version of shapecat than the command."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run the call at once, in another version."""
        future: Future[Any] = Future()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("shapecat.batch.runs.__version__", "9.9")
            future.set_result(fn(*args, **kwargs))
        return future


def test_workers_of_another_version_are_refused(tmp_path: Path) -> None:
    """Workers of another version would silently ignore options that they do not know."""
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP")
    with plan_batch(Job(Path(), Path()), [str(tmp_path / "a.mcap")], str(tmp_path)) as batch:
        (outcome,) = process_on(OtherVersion(), batch.tasks, Watcher(), manifest=batch.manifest)

    assert outcome.code == 1
    assert re.search(r"a worker has shapecat 9\.9, this command \d", outcome.message)


def test_model_that_was_replaced_meanwhile_is_refused(tmp_path: Path) -> None:
    """A worker may have another file at this path, and a long batch may outlive the file.

    Some of the recordings would have results of the other model.
    """
    model = tmp_path / "mine.npz"
    for number in range(2):
        shutil.copy("fixtures/foxglove.mcap", tmp_path / f"{number}.mcap")
    save_model(model, load_model())
    with plan_batch(Job(Path(), Path(), model=model), [str(tmp_path)], str(tmp_path)) as batch:
        save_model(model, replace(load_model(), temperature=2.0))
        outcomes = list(process_here(batch.tasks, Watcher(), manifest=batch.manifest))

    assert {outcome.code for outcome in outcomes} == {2}
    assert all("mine.npz: is not the model" in outcome.message for outcome in outcomes)


def test_recording_that_only_waited_has_one_try(recordings: Path, tmp_path: Path) -> None:
    """A scheduler may restart many times and drop queued tasks, which were never tried."""

    class Forgetful(Fragile):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            future: Future[Any] = Future()
            if self.begun.count("bag") < 5 and args[0].folder.name == "bag":
                self.begun.append("bag")
                future.cancel()
                future.set_running_or_notify_cancel()
                return future
            return super().submit(fn, *args, **kwargs)

    with planned(recordings, tmp_path, end_s=0.1) as batch:
        drain(batch, Forgetful(""), Watcher())

    assert states(tmp_path) == ALL_DONE
    assert FileManifest(tmp_path / "manifest.jsonl").entries["bag"].tries == 1


def test_full_disk_fails_only_large_recording(shapecat: Run, tmp_path: Path) -> None:
    """One large recording must not cost the batch. A limit on file sizes simulates a full disk."""
    (tmp_path / "in").mkdir()
    record(tmp_path / "in" / "long.mcap", 8)
    record(tmp_path / "in" / "short.mcap", 2)
    options = ("--jobs", 1, "--no-rrd", "--set", "reuse_frames=1")
    command = ("process", tmp_path / "in", *options, "--out", tmp_path / "out")
    assert shapecat(*command[:-1], tmp_path / "free").exit_code == 0
    largest = [
        max(path.stat().st_size for path in (tmp_path / "free" / name).iterdir())
        for name in ("short", "long")
    ]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (sum(largest) // 2, hard))
    try:
        full = shapecat(*command)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    assert full.exit_code == 1, full.output
    assert "cannot" in full.output
    assert states(tmp_path / "out") == {"long": "failed", "short": "complete"}
    left = {p.name for p in (tmp_path / "out").iterdir()} - {".long.partial"}  # perceived frames
    assert left == {"manifest.jsonl", "short"}
    assert shapecat(*command).exit_code == 0
    assert set(states(tmp_path / "out").values()) == {"complete"}


def test_interrupted_batch_ends_and_can_be_resumed(
    shapecat: Run, recordings: Path, one_by_one: Path, tmp_path: Path
) -> None:
    """Ctrl-C gives exit code 130 and leaves no process; a second run completes the rest.

    Until then, two processes print events at once, which must not be mixed within a line.
    """
    words = ("process", str(recordings), "--out", str(tmp_path), "--no-rrd", "--jobs")
    running = subprocess.Popen(
        [sys.executable, "-m", "shapecat", *words, "2", "--progress", "jsonl"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        preexec_fn=obey_interrupts_at_low_priority,  # noqa: PLW1509  there is no other way
    )
    assert running.stderr is not None
    events, reported = [], set[str]()
    while not reported:
        events.append(json.loads(running.stderr.readline()))
        reported = {event["recording"] for event in events if event["event"] == "progress"}
    assert (events[0]["event"], events[0]["recordings"]) == ("plan", 4)
    assert {Path(name).stem for name in reported} < set(NAMES)
    workers = children(running.pid)

    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=60)

    assert running.returncode == 130, errors
    assert b"Traceback" not in errors
    assert workers
    wait_for(lambda: not any(map(alive, workers)), 30)
    assert shapecat(*words, 1).exit_code == 1
    assert_same(one_by_one, tmp_path)


@pytest.mark.many
def test_dask_gives_same_tables_after_killed_worker(
    recordings: Path, one_by_one: Path, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    killed: list[str] = []
    with open_executor("dask", workers=1) as executor, planned(recordings, tmp_path) as batch:
        cluster: Any = executor
        (pid,) = cluster._client.run(os.getpid).values()

        def kill_once(folder: str, phase: str) -> None:
            if phase == "perceive" and not killed:
                killed.append(folder)
                os.kill(pid, signal.SIGKILL)

        outcomes = drain(batch, executor, Watcher(kill_once))

    assert killed
    assert common_exit_code({outcome.code for outcome in outcomes}) == 1
    assert len(outcomes) == 4
    assert_same(one_by_one, tmp_path)


@pytest.mark.many
def test_dask_batch_survives_restart_of_scheduler(
    recordings: Path, one_by_one: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A dead scheduler loses its state and its workers; both are started again."""
    pytest.importorskip("distributed")
    address = free_address()
    first = DaskCluster(address, tmp_path_factory.mktemp("dask"))
    command = [
        *(sys.executable, "-m", "shapecat", "process", str(recordings), "--out", str(tmp_path)),
        *("--executor", "dask", "--scheduler", address, "--no-rrd"),
    ]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    wait_for(lambda: "running" in states(tmp_path).values(), 60)
    first.kill()
    second = DaskCluster(address, tmp_path_factory.mktemp("dask"))
    try:
        _, errors = running.communicate(timeout=120)
    finally:
        running.kill()
        second.kill()

    assert running.returncode == 1, errors
    assert_same(one_by_one, tmp_path)
    assert states(tmp_path) == ALL_DONE


@pytest.mark.many
def test_ray_gives_same_tables(
    shapecat: Run, recordings: Path, one_by_one: Path, tmp_path: Path
) -> None:
    options = ("--out", tmp_path, "--executor", "ray", "--jobs", 2, "--no-rrd")

    assert shapecat("process", recordings, *options).exit_code == 1
    assert_same(one_by_one, tmp_path)


def test_manifest_survives_damaged_lines(tmp_path: Path, one_by_one: Path) -> None:
    """A truncated or foreign line must not hide or absorb its neighbours."""
    path = tmp_path / "manifest.jsonl"
    shutil.copy(one_by_one / "manifest.jsonl", path)
    before = FileManifest(path).entries
    complete = {"folder": "log", "recording": "a.mcap", "state": "complete"}
    with path.open("ab") as file:
        file.write(b'{"folder": 3}\n[]\n\xff\n')
        for wrong in ({"recording": 3}, {"seconds": "1"}, {"tracks": [1]}, {"tries": 0.5}):
            file.write(json.dumps({**complete, **wrong}).encode() + b"\n")
        file.write(b'{"folder": "log", "recor')

    manifest = FileManifest(path)
    assert manifest.entries == before
    manifest.record([before["log"]])

    assert FileManifest(path).entries["log"].state == "complete"
    assert len(FileManifest(path).entries) == len(before)


def test_batch_continues_if_manifest_cannot_be_written(
    shapecat: Run, recordings: Path, tmp_path: Path
) -> None:
    (tmp_path / "manifest.jsonl").mkdir()
    done = shapecat(
        "process", recordings / "monday", "--out", tmp_path, "--jobs", 1, "--end", 0.1, "--no-rrd"
    )

    assert done.exit_code == 0, done.output
    assert "2 complete" in done.stdout
