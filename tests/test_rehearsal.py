"""Tests of compiling ahead of time: all kernels, only once, without leftover processes."""

import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from shapecat import geometry, rehearsal
from shapecat.detection.planes import horizontal, strips, supporting
from shapecat.rehearsal import compile_all, find_ball, find_mask, recognize_ball
from shapecat.reuse import agreement
from shapecat.system.files import lock

KERNELS = [
    (geometry, "_mean"),
    (horizontal, "_refit_parallel"),
    (strips, "_level_strips"),
    (supporting, "_is_enclosed"),
    (supporting, "_count_below_edge"),
    (agreement, "_compare"),
]


def test_rehearsals_call_rarely_used_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel that no rehearsal calls delays the first run or, in a container, every run."""
    called = set()

    def watch(module: ModuleType, name: str) -> None:
        kernel = getattr(module, name)

        def call(*arguments: Any) -> Any:
            called.add(name)
            return kernel(*arguments)

        monkeypatch.setattr(module, name, call)

    for module, name in KERNELS:
        watch(module, name)

    assert find_ball() == 2
    assert recognize_ball() == "ball"
    assert 1500 < find_mask() / 2 < 1700
    assert called == {name for _, name in KERNELS}


def mark(path: Path) -> None:
    """Append an x to a file."""
    with path.open("a") as file:
        file.write("x")


@pytest.fixture
def trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Replace each compilation by an x in the returned file."""
    path = tmp_path / "trace"
    monkeypatch.setattr(rehearsal, "_completion_marker", lambda **_: tmp_path / "complete")
    monkeypatch.setattr(rehearsal, "_rehearse", lambda *_: mark(path))
    return path


def test_kernels_are_compiled_only_once(trace: Path) -> None:
    """A run announces the compilation and waits for it; the next run must not."""
    announced: list[tuple[str, int, int | None]] = []

    assert compile_all(lambda *report: announced.append(report)) > 0
    assert compile_all(lambda *report: announced.append(report)) == 0
    assert announced == [("compile", 0, None)]
    assert trace.read_text() == "x"


def test_kernels_for_colour_are_compiled_when_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the first colour image takes ten seconds, in a container in every run."""
    calls: list[int] = []
    monkeypatch.setattr(
        rehearsal,
        "_completion_marker",
        lambda *, colour: tmp_path / ("colour" if colour else "depth"),
    )
    monkeypatch.setattr(
        rehearsal, "_rehearse", lambda _, called, _report: calls.append(len(called))
    )

    for colour, expected in ((False, [2]), (True, [2, 3]), (False, [2, 3]), (True, [2, 3])):
        compile_all(colour=colour)
        assert calls == expected
    (tmp_path / "depth").unlink()
    (tmp_path / "colour").unlink()
    compile_all(colour=True)
    compile_all()
    assert calls == [2, 3, 3]


def test_compiling_survives_removal_of_its_folder(
    trace: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An update during a batch removes the folder; the remaining recordings must not fail."""
    monkeypatch.setattr(
        rehearsal, "_completion_marker", lambda **_: tmp_path / "removed" / "complete"
    )

    with monkeypatch.context() as patch:
        patch.setattr(rehearsal, "_rehearse", lambda *_: shutil.rmtree(tmp_path / "removed"))
        assert compile_all() > 0
    assert compile_all() > 0
    assert compile_all() == 0
    assert trace.read_text() == "x"


def test_interrupted_compiling_is_repeated(trace: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(rehearsal, "_rehearse", interrupt)
        compile_all()
    compile_all()
    assert trace.read_text() == "x"


def test_compiling_reports_its_progress(
    trace: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Minutes of silence look like a hang; compiled kernels need no announcement."""

    def compile_slowly(_cores: int, _called: object, report: Callable[[str], None]) -> None:
        for _ in range(2):
            time.sleep(0.002)
            report("compile")

    monkeypatch.setattr(rehearsal, "_TELL_S", 0.001)
    monkeypatch.setattr(rehearsal, "_count", lambda: 7)
    monkeypatch.setattr(rehearsal, "_rehearse", compile_slowly)

    rehearsal.main([])
    first, *counts, last = capfd.readouterr().out.splitlines()
    assert first == "compiling kernels, once per installation: about a minute"
    assert counts == ["7 kernels compiled"] * 2
    assert last.startswith("all 7 kernels")
    rehearsal.main([])
    assert not capfd.readouterr().out
    assert not trace.exists()


def test_kernels_are_counted_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line for each tenth of a second would bury all other output."""
    now, reports = 100.0, list[tuple[str, int, int | None]]()
    monkeypatch.setattr("shapecat.rehearsal.time.monotonic", lambda: now)
    monkeypatch.setattr(rehearsal, "_count", lambda: int(now))
    report = rehearsal._reporter(lambda *each: reports.append(each))
    for now in (100.1, 109.9, 110.0, 110.1, 119.9, 120.1):  # noqa: B007  read by the functions
        report("compile")

    assert reports == [("compile", 110, None), ("compile", 120, None)]


def test_waiting_for_another_process_is_reported(
    trace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second command was silent until the first had compiled, for minutes on a busy machine."""
    reports: list[tuple[str, int, int | None]] = []
    monkeypatch.setattr(rehearsal, "_TELL_S", 0.001)
    monkeypatch.setattr(rehearsal, "_POLL_S", 0.002)
    monkeypatch.setattr(rehearsal, "_count", lambda: 7)
    held = lock(trace.parent)
    assert held is not None

    def observe(*report: object) -> None:
        reports.append(report)  # type: ignore[arg-type]
        if len(reports) == 2:
            (trace.parent / "complete").touch()
            os.close(held)

    assert compile_all(observe) > 0
    assert reports == [("wait for kernels", 7, None)] * 2
    assert not trace.exists()


@pytest.mark.parametrize(("word", "code"), [("--help", 0), ("now", 2)])
def test_help_and_wrong_usage_do_not_compile(
    trace: Path, capsys: pytest.CaptureFixture[str], word: str, code: int
) -> None:
    with pytest.raises(SystemExit) as ended:
        rehearsal.main([word])

    assert ended.value.code == code
    output = capsys.readouterr()
    assert "python -m shapecat.rehearsal [-h]" in output.out + output.err
    assert not trace.exists()


def test_compiling_processes_end() -> None:
    before = set(multiprocessing.active_children())
    reports: list[str] = []
    rehearsal._rehearse(1, (multiprocessing.active_children,) * 2, reports.append)
    assert set(reports) == {"compile"}
    left = set(multiprocessing.active_children()) - before
    for process in left:
        process.join(timeout=10)
    assert not any(process.is_alive() for process in left)


UNGUARDED = """{says}
from pathlib import Path
from shapecat import rehearsal
rehearsal._completion_marker = lambda **_: Path({marker!r})
rehearsal._REHEARSALS = (int, int)
assert rehearsal.compile_all(cores=1) > 0
print("processed")
"""


@pytest.mark.parametrize("says", ["", pytest.param("# no __main__", marks=pytest.mark.many)])
def test_script_without_main_guard_does_not_deadlock(tmp_path: Path, says: str) -> None:
    """A compiling process would run the script again and wait for its parent's lock."""
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED.format(says=says, marker=str(tmp_path / "complete")))
    ended = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=300, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == "processed\n"
    assert bool(says) == ('needs `if __name__ == "__main__":`' in ended.stderr), ended.stderr
    assert bool(says) == ("Traceback" in ended.stderr)
