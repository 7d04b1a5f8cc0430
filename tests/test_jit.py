"""Tests of the cache of kernels: compiled code must not outlive its sources."""

import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

import shapecat
from shapecat.jit import _stage_of, code_folder

Run = Callable[[], str]

CALLER = """
from shapecat.jit import kernel
from callee import twice

@kernel
def outer(x):
    return twice(x) + 1

print(outer(3), sum(outer.stats.cache_hits.values()))
"""
CALLEE = """
from shapecat.jit import kernel

@kernel
def twice(x):
    return 2 * x
"""


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    folder = tmp_path / "stage"
    folder.mkdir()
    (folder / "caller.py").write_text(CALLER)
    (folder / "callee.py").write_text(CALLEE)
    return folder


@pytest.fixture
def run(stage: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs the script, as a new process would, and returns its output."""
    monkeypatch.syspath_prepend(stage)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")

    def run_once() -> str:
        code_folder.cache_clear()
        sys.modules.pop("callee", None)
        runpy.run_path(str(stage / "caller.py"))
        return capsys.readouterr().out.strip()

    return run_once


@pytest.mark.parametrize("decorator", ["@kernel", "@kernel(inner=True)", "@kernel(inline=True)"])
def test_edit_of_callee_recompiles_the_caller(stage: Path, run: Run, decorator: str) -> None:
    """Numba's own cache would keep the old code, since the caller's file is unchanged."""
    callee = CALLEE.replace("@kernel", decorator)
    (stage / "callee.py").write_text(callee)
    assert run() == "7 0"
    assert run() == "7 1", "nothing was cached"
    (stage / "callee.py").write_text(callee.replace("2 * x", "20 * x"))
    assert run() == "61 0"
    assert len([*stage.glob("__pycache__/kernels-*")]) == 1, "code of earlier files is left"


def test_folder_that_another_process_removes_is_not_an_error(
    stage: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After an update, several processes that start at once remove the old kernels."""
    assert run() == "7 0"
    scan = os.scandir

    def vanished(path: Any) -> Any:
        if Path(path).name.startswith("kernels-"):
            raise FileNotFoundError(path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", vanished)
    assert code_folder(stage) is not None
    assert run() == "7 1"


def test_folder_that_another_process_has_just_made_is_used(
    stage: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process fell back to the user's cache, where everything was compiled again."""
    code_folder.cache_clear()
    folder = code_folder(stage)
    assert folder is not None
    code_folder.cache_clear()
    answers = iter([False])  # as it was before the other process made it
    monkeypatch.setattr(Path, "is_dir", lambda path: next(answers, path.exists()))
    assert code_folder(stage) == folder


def test_process_with_older_sources_does_not_spoil_the_cache(stage: Path, run: Run) -> None:
    """A process may compile and save code that it loaded before the files were changed."""
    newer = CALLEE.replace("2 * x", "20 * x")
    update = f"__import__('pathlib').Path(__file__).write_text({newer!r})"  # before any compiling
    (stage / "callee.py").write_text(f"{CALLEE}\n{update}")

    assert run() == "7 0"
    assert run() == "61 0"


def test_cache_folder_is_writable_or_configured(
    stage: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """System packages are read-only for users; container images set their own folder."""
    stage.joinpath("__pycache__").write_text("a file, so that not even root can write in it")
    own, configured = tmp_path / "own", tmp_path / "named"
    monkeypatch.setenv("XDG_CACHE_HOME", str(own))

    assert run() == "7 0"
    assert run() == "7 1"
    assert [*own.glob("shapecat/stage-*/kernels-*")]

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(configured))
    numba.config.reload_config()  # as Numba does when it loads
    assert run() == "7 0"
    assert [*configured.glob("stage-*/kernels-*/**/*.nbc")]


@pytest.fixture
def temporary_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Make the user's cache unwritable; return the temporary folder, the last resort."""
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    return temporary


def test_user_without_writable_folder_uses_compiled_kernels(
    stage: Path, run: Run, temporary_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A container run as an arbitrary user compiled for a minute at each start."""
    assert run() == "7 0"
    assert not [*temporary_cache.iterdir()], "nothing was needed there"
    for folder, *_ in os.walk(stage / "__pycache__", topdown=False):
        Path(folder).chmod(0o555)
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: str(temporary_cache) in str(path) and access(path, mode)
    )
    assert run() == "7 1"
    (own,) = temporary_cache.iterdir()
    assert {Path(folder).stat().st_mode & 0o700 for folder, *_ in os.walk(own)} == {0o700}
    assert own.stat().st_mode & 0o077 == 0
    assert [*own.glob("stage-*/kernels-*")]
    assert not [*own.glob("stage-*/copy-*")]


@pytest.mark.usefixtures("temporary_cache")
def test_kernels_are_cached_for_the_next_start_without_home(stage: Path, run: Run) -> None:
    stage.joinpath("__pycache__").write_text("")
    assert run() == "7 0"
    assert run() == "7 1"


def test_machine_code_of_others_is_not_loaded(stage: Path, run: Run, temporary_cache: Path) -> None:
    """Any user can make another user's folder in /tmp first, and put code into it."""
    stage.joinpath("__pycache__").write_text("")
    (temporary_cache / f"shapecat-{os.getuid()}").mkdir()
    (temporary_cache / f"shapecat-{os.getuid()}").chmod(0o777)
    assert run() == "7 0"
    assert run() == "7 0"


def test_kernel_is_compiled_without_any_cache_folder(
    stage: Path, run: Run, temporary_cache: Path
) -> None:
    """Slow is better than an error."""
    stage.joinpath("__pycache__").write_text("")
    temporary_cache.rmdir()
    assert run() == "7 0"


@pytest.mark.parametrize("place", ["beside", "cache"])
def test_user_without_home_can_cache_kernels_elsewhere(
    stage: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """Containers may run as a user without HOME or an entry in /etc/passwd."""

    def fail() -> Path:
        msg = "Could not determine home directory."
        raise RuntimeError(msg)

    monkeypatch.setattr(Path, "home", fail)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if place == "cache":
        stage.joinpath("__pycache__").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))

    assert run() == "7 0"
    assert run() == "7 1"


def test_stage_includes_its_subpackages() -> None:
    """Kernels call kernels of other subpackages of their stage, so any edit counts."""
    here = Path(shapecat.__file__).parent

    assert _stage_of(here / "detection" / "planes" / "ransac.py") == here / "detection"
    assert _stage_of(here / "detection" / "pipeline.py") == here / "detection"
    assert _stage_of(here / "geometry.py") == here
