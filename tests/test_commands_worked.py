"""Tests of outputs of the commands, with numbers worked out by hand."""

import json
import re
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import Result

from shapecat.batch.ledger import Outcome
from shapecat.errors import OutputError
from shapecat.executors import WorkerExecutor
from shapecat.learning import load_model, save_model
from shapecat.outputs.counts import count_words
from shapecat.outputs.exports.dataset_frames import ImageSelection
from shapecat.outputs.exports.formats import Exported
from shapecat.runs.jobs import Job, Summary
from shapecat.runs.labels.transfer import TABLE_ALONE
from shapecat.system.stopping import Stopped
from tests.scenes import record

Run = Callable[..., Result]

OUTCOMES: Any = import_module("shapecat.cli.outcomes")
PROCESS: Any = import_module("shapecat.cli.process")
PROGRESS: Any = import_module("shapecat.cli.progress")
RENDER: Any = import_module("shapecat.cli.render")


def task(name: str, status: str = "new", size: int = 0) -> Any:
    return SimpleNamespace(name=name, status=status, source=SimpleNamespace(bytes=size))


def ended(name: str, *, processed: bool | None, warnings: tuple[str, ...] = ()) -> Any:
    """Return the outcome of a recording, which failed if ``processed`` is None."""
    known = SimpleNamespace(processed=processed, warnings=warnings)
    summary = None if processed is None else known
    job = SimpleNamespace(folder=Path("out", name), place=f"out/{name}")
    return SimpleNamespace(job=job, summary=summary, message="")


def test_time_left_follows_remaining_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings that were already complete took no time; failed ones were still read."""
    now = 100.0
    monkeypatch.setattr("shapecat.cli.progress.time.monotonic", lambda: now)
    tasks = [task("a", size=100), task("b", size=300), task("c", "complete", 7000), task("d")]
    progress = PROGRESS.Progress([*tasks, task("e", size=200)])
    assert progress.remaining_s() is None
    now = 120.0
    progress.ended(ended("c", processed=False))
    assert progress.remaining_s() is None
    progress.ended(ended("a", processed=True))
    assert progress.remaining_s() == pytest.approx(500 / 5)
    progress.ended(ended("b", processed=None))
    assert progress.remaining_s() == pytest.approx(200 / 20)
    assert (progress.complete, progress.failed) == (2, 1)


def test_time_left_falls_during_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimated from finished recordings alone, it would grow; compiling must not count."""
    now = 0.0
    monkeypatch.setattr("shapecat.cli.progress.time.monotonic", lambda: now)
    progress = PROGRESS.Progress([task("a", size=100), task("b", size=300)])
    now = 90.0
    progress.progress("b", "compile", 0, None)
    progress.progress("b", "perceive", 1, 7)  # a tenth of the work, 30 bytes
    assert progress.remaining_s() is None
    now = 96.0
    progress.progress("b", "perceive", 2, 7)  # 60 bytes
    assert progress.remaining_s() == pytest.approx(6 * 340 / 30)
    now = 98.0
    progress.ended(ended("a", processed=True))
    assert progress.remaining_s() == pytest.approx(8 * 240 / 130)
    now = 100.0
    progress.progress("b", "review", 5, 10)  # 85 %, 255 bytes
    assert progress.remaining_s() == pytest.approx(10 * 45 / 325)
    progress.ended(ended("b", processed=True))
    assert progress.remaining_s() == 0


def test_time_left_has_hours_minutes_and_seconds() -> None:
    """An hour and five minutes must not be printed as 1.5 hours."""
    words = [PROGRESS._duration(seconds) for seconds in (3903.4, 36_000, 125, 59.6, -2)]

    assert words == ["1:05:03", "10:00:00", "2:05", "1:00", "0:00"]


@pytest.mark.parametrize(
    ("error", "ended"),
    [(None, "shutdown"), (Stopped(2), "stop"), (KeyError("bug"), "terminate")],
)
def test_workers_save_their_frames_after_a_signal_only(error: Any, ended: str) -> None:
    """Workers killed by Ctrl+C would lose frames, and leave claims and temporary folders."""
    calls: list[str] = []
    endings = {
        name: lambda *_, n=name: calls.append(n) for name in ("shutdown", "stop", "terminate")
    }
    executor = type("Ending", (WorkerExecutor,), endings)()
    leave = nullcontext() if error is None else pytest.raises(type(error))
    with leave, executor:
        if error is not None:
            raise error

    assert calls == [ended]


def test_closing_table_follows_order_of_plan(capsys: pytest.CaptureFixture[str]) -> None:
    """Recordings finish in any order; users compare the table with their list."""
    tally = OUTCOMES.Outcomes(keep_all=False)
    for name, frames in (("b", 20), ("c", None), ("a", 3)):
        counts = {"frames": frames, "tracks": {"cup": 2}}
        summary = SimpleNamespace(
            counts=counts, seconds=1.26, processed=name == "b", corrections=None, folder=name
        )
        job = Job(Path("x", name), Path("out", name))
        done = None if frames is None else summary
        tally.add(SimpleNamespace(job=job, summary=done, code=0 if done else 3))
    OUTCOMES.print_closing([task("a"), task("b"), task("c")], tally)
    _, *rows, closing = capsys.readouterr().out.splitlines()

    assert [row.split()[:2] for row in rows] == [["a", "3"], ["b", "20"]]
    assert ["already complete" in row for row in rows] == [True, False]
    assert "1.3" in rows[1]
    assert closing == "2 complete, 1 failed, 23 frames"

    tally = OUTCOMES.Outcomes(keep_all=False)
    tally.failed, tally.frames = 2, 1
    OUTCOMES.print_closing([task("a"), task("b")], tally)
    assert capsys.readouterr().out == "0 complete, 2 failed, 1 frame\n"


def test_json_follows_order_of_plan(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same command must print the same array, whichever recording ends first.

    It holds all recordings, even if the closing table would be too long.
    """
    names = [f"r{k:03}" for k in range(101)]
    for name in names:
        (tmp_path / f"{name}.mcap").write_bytes(b"\x89MCAP")

    def last_first(tasks: Any, *_: Any, **__: Any) -> Any:
        for task in reversed(tasks):
            counts = {"frames": 3, "tracks": {}}
            yield Outcome(task.job, Summary(counts, 1.0, ()))

    monkeypatch.setattr("shapecat.batch.runs.process_here", last_first)
    done = shapecat("process", tmp_path, "--out", tmp_path / "out", "--json")

    assert [Path(run["folder"]).name for run in json.loads(done.stdout)] == names


@pytest.mark.parametrize(("count", "listed"), [(1, 1), (100, 100), (101, 0)])
def test_closing_table_lists_a_hundred_recordings_or_none(
    capsys: pytest.CaptureFixture[str], count: int, listed: int
) -> None:
    """Users would take an incomplete table for a complete one."""
    names = [f"r{k}" for k in range(count)]
    tally = OUTCOMES.Outcomes(keep_all=False)
    for name in names:
        summary = SimpleNamespace(
            counts={"frames": 30, "tracks": {}}, seconds=1.0, processed=True,
            corrections=None, folder=name,
        )  # fmt: skip
        job = Job(Path(name), Path("out", name))
        tally.add(SimpleNamespace(job=job, summary=summary, code=0))
    OUTCOMES.print_closing([task(name) for name in names], tally)
    out = capsys.readouterr().out

    assert [line.split()[0] for line in out.splitlines() if " 30 " in line] == names[:listed]
    assert count == 1 or f"{count} complete, 0 failed, {30 * count:,} frames" in out


def test_lost_labels_are_reported_in_a_batch_of_any_size(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """After the hundredth recording, nobody would learn which labels were not transferred."""
    tally, names = OUTCOMES.Outcomes(keep_all=False), [f"r{k}" for k in range(102)]
    for name in names:
        lost: Any = {"transferred": [{}], "not_transferred": []} if name == "r101" else None
        summary = SimpleNamespace(
            counts={"frames": 30, "tracks": {}}, seconds=1.0, processed=True,
            corrections=lost, folder=Path(name),
        )  # fmt: skip
        job = Job(Path(name), Path("out", name))
        tally.add(SimpleNamespace(job=job, summary=summary, code=0))
    OUTCOMES.print_closing([task(name) for name in names], tally)

    assert capsys.readouterr().err == "r101: transferred 1 of 1 corrected labels\n"


@pytest.mark.parametrize("name", ["a.mcap", "a.truth.json", "a.labels.npz", "a.color_labels.npz"])
@pytest.mark.parametrize("options", [(), ("--color",)])
def test_simulate_replaces_no_file_without_overwrite(
    shapecat: Run, tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    """The ground truth may have stayed behind when the recording was moved."""
    (tmp_path / name).write_text("mine")
    found = shapecat("simulate", tmp_path / "a.mcap", *options, "--frames", 1)

    assert found.exit_code == 2
    assert f"{name} exists already" in found.stderr
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine")]


def test_simulate_leaves_no_colour_labels_of_another_scene(shapecat: Run, tmp_path: Path) -> None:
    """Old colour labels would be mistaken for the truth of the new recording."""
    (tmp_path / "a.color_labels.npz").write_text("old")
    done = shapecat("simulate", tmp_path / "a.mcap", "--overwrite", "--frames", 1)

    assert done.exit_code == 0, done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.labels.npz", "a.mcap", "a.truth.json"]


@pytest.mark.parametrize(("end", "refused"), [("2.4", True), ("2.5", True), ("2.6", False)])
def test_empty_time_range_is_refused(
    shapecat: Run, tmp_path: Path, end: str, *, refused: bool
) -> None:
    """A run without frames would look like one of an empty scene."""
    missing = tmp_path / "missing.mcap"
    found = shapecat("process", missing, "--out", tmp_path, "--start", "2.5", "--end", end)

    assert (found.exit_code == 2) == refused
    assert ("is not after --start 2.5" in found.stderr) == refused


def test_recording_option_is_refused_for_several_runs(shapecat: Run, tmp_path: Path) -> None:
    """A folder of runs also counts as several runs; an unfinished run does not count."""
    for name in ("a", "b", ".c.partial"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").write_text("{}")
    for kind in ("crops", "coco"):
        words = ("--format", kind, "--out", tmp_path / "out", "--recording", tmp_path / "x.mcap")
        found = shapecat("export", tmp_path / "runs", *words)

        assert found.exit_code == 2
        assert "--recording is for a single run, not for 2" in found.stderr


def test_plan_describes_remaining_work() -> None:
    """Megabytes and processes in the plan are those of the remaining recordings."""
    tasks = [
        task("a", "complete", 9_000_000),
        task("b", "retry", 1_200_000),
        task("c", size=300_000),
    ]
    assert PROGRESS.describe_plan(tasks, 1, 2, 3) == (
        "3 recordings: 1 already complete, 1 to retry, 1 new; 1.5 MB; 6 processes; "
        "skipped 1 file of other formats"
    )
    small = PROGRESS.describe_plan([task("a", size=31_000)], 0, 1, 1)
    assert small == "1 recording: 1 new; 31.0 kB; 1 process"  # not 0.0 MB
    text = PROGRESS.describe_plan(tasks[:1], 0, 2, 3, ["b is a", "c is a"])
    assert text == "1 recording: 1 already complete; b is a, c is a"


def test_cores_are_shared_by_remaining_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last recording of many would have one core, while the other cores are idle."""
    counted: list[tuple[int | None, int]] = []

    def share(jobs: int | None, recordings: int) -> tuple[int, int]:
        counted.append((jobs, recordings))
        raise Stopped

    monkeypatch.setattr("shapecat.executors.share_cores", share)
    tasks = [task("a", "complete"), task("b", "retry"), task("c", "complete")]
    display: Any = None
    with pytest.raises(Stopped):
        next(
            PROCESS._process(
                SimpleNamespace(tasks=tasks, manifest=None, skipped=0), display, 4, "local", None
            )
        )

    assert counted == [(4, 1)]


def test_category_counts_are_sorted_by_frequency() -> None:
    """Equal counts are in alphabetical order."""
    assert count_words({"can": 3, "plate": 12, "ball": 3}) == "plate 12, ball 3, can 3"
    assert count_words({}) == "none"


def test_info_exit_code_distinguishes_some_from_all_unreadable(
    shapecat: Run, tmp_path: Path
) -> None:
    """With exit code 1 a script continues with the readable recordings."""
    good = record(tmp_path / "good.mcap", 1)
    (tmp_path / "bad.mcap").write_bytes(b"no recording")

    assert shapecat("info", good).exit_code == 0
    assert shapecat("info", tmp_path / "bad.mcap").exit_code == 3
    for order in ((good, tmp_path / "bad.mcap"), (tmp_path / "bad.mcap", good)):
        found = shapecat("info", *order)
        assert found.exit_code == 1
        assert "good.mcap: " in found.stdout
        assert "bad.mcap" in found.stderr


def test_info_prints_content_of_recording(capsys: pytest.CaptureFixture[str]) -> None:
    """A megabyte is a million bytes, as in `ls --si` and the other outputs."""
    topics = [
        {"name": "/d", "type": "sensor_msgs/Image", "encoding": "cdr", "count": 61,
         "use": "depth stream"},
        {"name": "/tf", "type": "tf2_msgs/TFMessage", "encoding": "ros1", "count": 1075,
         "use": ""},
    ]  # fmt: skip
    import_module("shapecat.cli.info")._show(
        {"path": "a/lab.mcap", "kind": "MCAP", "bytes": 98_760_000, "start_ns": 5,
         "seconds": 12.34, "topics": topics, "warnings": ["the last chunk is cut"]}
    )  # fmt: skip
    first, *table, last = capsys.readouterr().out.splitlines()

    assert first == "a/lab.mcap: MCAP, 98.8 MB, 12.3 s long"
    assert [re.split(r"\s{2,}", line.strip()) for line in table] == [
        ["topic", "type", "encoding", "messages", "use"],
        ["/d", "sensor_msgs/Image", "cdr", "61", "depth stream"],
        ["/tf", "tf2_msgs/TFMessage", "ros1", "1075"],
    ]
    assert last == "Warning: the last chunk is cut"


def test_json_events_keep_zeros_and_omit_unknown_values(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that waits for ``exit_code`` would miss a success."""
    now = 100.0
    monkeypatch.setattr("shapecat.cli.progress.time.monotonic", lambda: now)
    tasks = [task("a", size=700), task("b", "retry", 40), task("c", "complete", 3), task("d")]
    for item in tasks:
        item.source.recording = f"in/{item.name}.bag"
    progress = PROGRESS.JsonProgress(tasks)
    progress.progress("a", "perceive", 0, None)
    now = 100.3
    progress.progress("a", "perceive", 3, None)  # too early to report
    now = 100.6
    progress.progress("a", "perceive", 5, 61)
    progress.progress("a", "annotate", 0, 61)
    progress.progress("elsewhere", "perceive", 7, 8)
    for name, code, processed in (("c", 0, False), ("b", 3, None)):
        done = ended(name, processed=processed)
        done.code, done.job.name = code, f"in/{name}"
        if done.summary is None:
            done.message = "b.bag: damaged"
        else:
            done.summary.seconds, done.summary.warnings = 1.23456, ("no depth",)
        progress.ended(done)
    progress.note("a note")
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]

    a = {"event": "progress", "recording": "in/a.bag"}
    end = {"event": "ended", "of": 4, "complete": 1}
    assert events == [
        {"event": "plan", "recordings": 4, "bytes": 740,
         "status": {"new": 2, "retry": 1, "complete": 1}},
        {**a, "phase": "perceive", "done": 0},
        {**a, "phase": "perceive", "done": 5, "total": 61},
        {**a, "phase": "annotate", "done": 0, "total": 61},
        {**end, "recording": "in/c", "folder": "out/c", "state": "complete", "seconds": 1.235,
         "processed": False, "exit_code": 0, "warnings": ["no depth"], "failed": 0},
        {**end, "recording": "in/b", "folder": "out/b", "state": "failed", "exit_code": 3,
         "message": "b.bag: damaged", "failed": 1},
        {"event": "note", "text": "a note"},
    ]  # fmt: skip


def test_at_most_three_warnings_per_new_run_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """A thousand damaged recordings may have ten each; earlier runs printed theirs."""
    progress = PROGRESS.Progress([task("a"), task("b"), task("c")])
    progress.ended(ended("a", processed=True, warnings=tuple("stuvw")))
    progress.ended(ended("b", processed=False, warnings=("old",)))
    progress.ended(ended("c", processed=True, warnings=tuple("xyz")))

    assert capsys.readouterr().err.splitlines() == [
        *(f"Warning: a: {text}" for text in ("s", "t", "u", "2 more warnings in run.json")),
        *(f"Warning: c: {text}" for text in "xyz"),
    ]


def test_plain_progress_shows_done_running_and_remaining(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is at most one line in five seconds; the time left is that for the remaining bytes."""
    now = 100.0
    monkeypatch.setattr("shapecat.cli.progress.time.monotonic", lambda: now)
    progress = PROGRESS.PlainProgress([task("a", size=100), task("b", size=300), task("c")])
    now = 104.9
    progress.progress("a", "perceive", 1, 9)
    now = 110.0
    progress.ended(ended("a", processed=None))
    progress.progress("c", "annotate", 2, None)
    progress.progress("b", "perceive", 3, 61)
    now = 115.0
    progress.progress("b", "perceive", 40, 61)

    done, busy = "1/3 recordings, 1 failed, about", "c: writing annotated.mcap 2"
    assert capsys.readouterr().err.splitlines() == [
        f"{done} 0:17 left; {busy}",  # 5.1 s * 300 / 92.2 bytes
        f"{done} 0:07 left; b: finding and categorizing objects 40/61, {busy}",
    ]


NAMED = {name: SimpleNamespace(name=name, folder=Path(name)) for name in "ab"}
"""Stand-ins for finished runs."""

CALLS = {
    "simulate o.mcap --scene shelf --sensor d435 --frames 7 --clouds --color --seed 3": (
        "shapecat.simulation.simulate",
        [Path("o.mcap")],
        {"scene": "shelf", "format": "mcap", "sensor": "d435", "frames": 7, "clouds": True,
         "color": True, "seed": 3},
        Path("done.mcap"),
        "done.mcap\n",
    ),
    "learn default data --out m.npz --seed 5": (
        "shapecat.evaluation.training.learn_on_folder",
        [None, Path("data"), Path("m.npz")],
        {"seed": 5},
        {"added": ["jar", "mug"], "views": 1075, "skipped": 0, "lost": [], "off_support": []},
        "m.npz: learned jar, mug from a data set of 1,075 views\n",
    ),
    "train data --out m.npz --seed 5": (
        "shapecat.evaluation.training.train_on_folder",
        [Path("data"), Path("m.npz")],
        {"seed": 5},
        {"categories": ["cup", "can"], "views": 1, "skipped": 0, "lost": [], "calibrated": True,
         "off_support": [], "held_out": {"n": 0}},
        "m.npz: 1 view of cup, can\n",
    ),
    "export a b --format coco --out o --every 3 --per-track 7 --min-confidence 0.6 "
    "--corrected-only --depth --val 0.4": (
        "shapecat.outputs.exports.formats.export_dataset",
        [[NAMED["a"], NAMED["b"]], "coco", Path("o"), ImageSelection(3, 7, 0.6, True, True, 0.4)],
        {"recording": None},
        Exported(1075, 3, Counter(train=1400, val=20)),
        "2 runs: 1,075 labelled views in o\n1,400 images in train, 20 in val\n",
    ),
    "export a b --format yolo --out o": (
        "shapecat.outputs.exports.formats.export_dataset",
        [[NAMED["a"], NAMED["b"]], "yolo", Path("o"), ImageSelection()],
        {"recording": None},
        Exported(7, 0, Counter(train=1)),
        (
            "2 runs: 7 labelled views in o\n"
            "1 image in train, 0 in val: all frames of a recording go to the same split; export "
            "more recordings, or raise --val if there are several\n"
        ),
    ),
    "export a --format kitti --out o --every 3 --boxes visible --recording r.bag": (
        "shapecat.outputs.exports.formats.export_run",
        [NAMED["a"], "kitti", Path("o")],
        {"every": 3, "visible_boxes": True, "recording": Path("r.bag"), "categories": ["of a"]},
        1,
        "a: 1 labelled view in o\n",
    ),
}  # fmt: skip
"""For each command line, the called function, its arguments, its result, and the printed text."""


@pytest.mark.parametrize(
    ("line", "target"),
    [
        ("evaluate data", "shapecat.evaluation.evaluate_folder"),
        ("process a.mcap --out o", "shapecat.batch.plans.plan_batch"),
    ],
)
@pytest.mark.parametrize(("option", "model"), [("default", None), ("m.npz", Path("m.npz"))])
def test_default_names_the_model_of_shapecat(
    shapecat: Run, monkeypatch: pytest.MonkeyPatch, line: str, target: str, option: str, model: Any
) -> None:
    """`learn default` works; after --model, the same word would be taken for a missing file."""
    calls: list[Any] = []

    def stub(*arguments: Any, **_: Any) -> Any:
        calls.append(arguments)
        raise click.Abort

    monkeypatch.setattr(target, stub)
    shapecat(*line.split(), "--model", option)

    (arguments,) = calls
    assert (arguments[0].model if "process" in line else arguments[1]) == model


@pytest.mark.parametrize("line", CALLS)
def test_options_are_passed_on_and_results_printed(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    """A lost option silently changes a result."""
    target, words, options, answer, printed = CALLS[line]
    calls = []

    def stub(*arguments: Any, observe: Any, **named: Any) -> Any:
        calls.append((list(arguments), named))
        assert isinstance(observe, RENDER.Bars)
        return answer

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(target, stub)
    monkeypatch.setattr("shapecat.runs.finished.find_runs", list)
    monkeypatch.setattr("shapecat.runs.finished.read_finished", lambda run: NAMED[run.name])
    usable = "shapecat.cli.export._usable"
    monkeypatch.setattr(usable, lambda runs, **_: ([NAMED[run.name] for run in runs], False))
    monkeypatch.setattr("shapecat.cli.export._require_distinct_frames", list)
    common = "shapecat.outputs.exports.formats.common_categories"
    monkeypatch.setattr(common, lambda runs: [f"of {run.name}" for run in runs])
    done = shapecat(*line.split())

    assert (done.exit_code, done.stdout) == (0, printed), done.stderr
    assert calls == [(words, options)]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"calibrated": False}, "the confidence is not calibrated: most categories have only one"),
        ({"skipped": 1}, "skipped 1 view with too few points for a surface\n"),
        (
            {"skipped": 9, "lost": ["pen", "key"]},
            "skipped 9 views .*\nWarning: pen, key: no usable views",
        ),
    ],
)
def test_train_names_the_defects_of_its_model(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: Any, said: str
) -> None:
    """Users would trust the confidences, and look for the missing categories in vain."""
    good = {
        "categories": ["cup", "can"], "views": 2, "calibrated": True, "skipped": 0, "lost": [],
        "off_support": [], "held_out": {"n": 0},
    }  # fmt: skip
    target = "shapecat.evaluation.training.train_on_folder"
    monkeypatch.setattr(target, lambda *_, **__: good | answer)
    done = shapecat("train", "data", "--out", tmp_path / "m.npz")

    assert done.exit_code == 0
    assert re.match(said, done.stderr)


class _JobCollector(WorkerExecutor):
    """Keeps the jobs it is given, and fails them."""

    def __init__(self) -> None:
        self.jobs: list[Any] = []

    def submit(self, _function: Any, /, *args: Any, **_: Any) -> Future[Any]:
        self.jobs.append(args[0])
        future: Future[Any] = Future()
        future.set_exception(ValueError("not processed"))
        return future

    def terminate(self) -> None:
        """Do nothing: there are no workers."""


def test_workers_of_a_cluster_get_absolute_paths(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers in another current folder would miss the recordings, and write results there."""
    monkeypatch.chdir(tmp_path)
    Path("a.mcap").write_bytes(b"\x89MCAP")
    save_model(Path("m.npz"), load_model())
    workers = _JobCollector()
    monkeypatch.setattr("shapecat.executors.open_executor", lambda *_, **__: workers)
    shapecat("process", "a.mcap", "--out", "out", "--model", "m.npz", "--executor", "dask")

    (job,) = workers.jobs
    assert [job.source, job.folder, job.model] == [
        tmp_path / "a.mcap", tmp_path / "out" / "a", tmp_path / "m.npz"
    ]  # fmt: skip


ODD = ("/cam[left]/depth", "k [/night].mcap", "box :car:")


def test_pipe_is_not_a_terminal_with_forced_colours(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """CI servers set FORCE_COLOR: names would be broken into lines, and bars fill the log."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    topics = [f"/{'left' * 60}/{name}" for name in ("image_raw", "points")]
    RENDER.print_table(("topic", "type"), [[topic, "std_msgs/msg/" * 3] for topic in topics])
    with RENDER.progress_bars() as bars:
        bars("export", 1, 2)
    printed = capsys.readouterr()

    assert [line.split()[0] for line in printed.out.splitlines()] == ["topic", *topics]
    assert printed.err == ""


def test_tables_and_bars_show_names_as_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Topics and files may contain what Rich treats as markup and emoji."""
    RENDER.print_table(("name",), [[name] for name in ODD])
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == ["name", *ODD]

    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")
    with PROGRESS.open_progress("rich", [task(name) for name in ODD]) as progress:
        for name in ODD:
            progress.progress(name, "perceive", 1, 2)
            progress.note(f"note on {name}")
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", capsys.readouterr().err)
    for name in ODD:
        assert f"{name}: finding" in shown
        assert f"note on {name}" in shown


@pytest.mark.parametrize("kind", ["rich", "plain"])
def test_names_cannot_control_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """A topic may hold an escape sequence, which clears the screen or fakes what was printed."""
    monkeypatch.setattr("click._compat.should_strip_ansi", lambda *_: False)  # as a terminal
    evil, shown = "/depth\x1b]0;gone\x07\x9b2J", r"/depth\x1b]0;gone\x07\x9b2J"
    RENDER.print_table(("name",), [[evil]])
    with PROGRESS.open_progress(kind, [task("lab")]) as progress:
        progress.note(f"Warning: {evil}")
    printed = capsys.readouterr()

    assert printed.out.split() == ["name", shown]
    assert f"Warning: {shown}" in printed.err
    assert str(OutputError(f"no {evil}")) == f"no {shown}"


def test_annotate_reports_written_files_and_untransferred_labels(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Users would believe that silently dropped labels were applied."""
    calls = []
    untransferred = [{"old_track": 17, "label": "tea pot", "reason": "no object there"}]
    answer = {"transferred": [{}] * 5, "not_transferred": untransferred, "by": TABLE_ALONE}

    def stub(*arguments: Any, **named: Any) -> Any:
        calls.append(([*arguments[:2]], named))
        return SimpleNamespace(as_dict=lambda: answer)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("shapecat.pipeline.annotate_again", stub)
    monkeypatch.setattr("shapecat.cli.annotate._warn_of_far_merges", lambda _run: None)
    Path("lab").mkdir()
    options = ("--by-place", "--boxes", "visible", "--recording", "r.bag")
    words = ("annotate", "lab", "--labels", "t.csv", *options)
    without_files = shapecat(*words)
    for name in ("review.rrd", "annotated.mcap"):
        Path("lab", name).touch()
    done = shapecat(*words)

    chosen = {"by_place": True, "boxes": "visible", "recording": Path("r.bag")}
    assert calls == [([Path("lab"), Path("t.csv")], chosen)] * 2
    assert without_files.stdout.splitlines()[0] == "lab: wrote only its tables"
    assert done.stdout.splitlines() == [
        "lab: wrote annotated.mcap and review.rrd", "5 of 6 labels transferred"
    ]  # fmt: skip
    warning, reason = done.stderr.splitlines()
    assert warning == (
        "t.csv: this table is not in a run folder, so shapecat assumes the same fixed frame and "
        "unmoved objects; give the run folder to check both"
    )
    assert reason == "  track #17, tea pot: no object there"


def test_process_reports_where_untransferred_labels_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    missed = [{"old_track": 17, "label": "tea pot", "reason": "no object there"}]
    for target, left in (("", missed), ("s3://b/lab", missed), ("", [])):
        corrections = {"transferred": [{}] * 5, "not_transferred": left}
        summary = SimpleNamespace(corrections=corrections)
        job = Job(Path("in/lab"), Path("out/lab"), target=target)
        OUTCOMES._print_corrections(job, summary)

    message = "lab: transferred 5 of 6 corrected labels; the others are in"
    assert capsys.readouterr().err.splitlines() == [
        f"{message} out/lab/tracks.previous.csv",
        "  track #17, tea pot: no object there",
        f"{message} s3://b/lab/tracks.previous.csv",
        "  track #17, tea pot: no object there",
        "lab: transferred 5 of 5 corrected labels",
    ]


@pytest.mark.parametrize(
    ("name", "container", "said"),
    [
        ("a.bag", "mcap", "--format mcap writes a file: name it a.mcap, not a.bag"),
        ("a.mcap", "ros2", "--format ros2 writes a folder: name it a, not a.mcap"),
        ("a.zip", "ros1", "a.zip: name it a.mcap, a.bag, or a for a ROS 2 folder"),
    ],
)
def test_simulate_suggests_name_that_fits_format(
    shapecat: Run, tmp_path: Path, name: str, container: str, said: str
) -> None:
    """No program would open a file with the wrong suffix."""
    found = shapecat("simulate", tmp_path / name, "--format", container)

    assert found.exit_code == 2
    assert found.stderr.splitlines()[-1] == f"Error: {said}"
    assert not list(tmp_path.iterdir())
