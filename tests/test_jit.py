"""Kernels on disk: code must not outlive what it was made of."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import shapecat
from shapecat.jit import _stage_of

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


def run(stage: Path, **environment: str) -> str:
    command = [sys.executable, str(stage / "caller.py")]
    variables = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    variables |= {"PYTHONDONTWRITEBYTECODE": "1", **environment}
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=variables, stdin=subprocess.DEVNULL
    )
    return done.stdout.strip()


def test_an_edit_of_a_called_kernel_counts(stage: Path) -> None:
    """Numba's own cache would go on with the old code: the file of the caller is the same."""
    assert run(stage) == "7 0"
    assert run(stage) == "7 1", "nothing was kept"
    (stage / "callee.py").write_text(CALLEE.replace("2 * x", "20 * x"))
    assert run(stage) == "61 0"
    assert len([*stage.glob("__pycache__/kernels-*")]) == 1, "code of earlier files is left"


def test_a_process_with_the_files_of_before_spoils_nothing(stage: Path) -> None:
    """It may compile and save what it was started with after the files have changed."""
    (stage / "caller.py").write_text(CALLER.replace("print", "import sys; sys.stdin.read()\nprint"))
    command = [sys.executable, str(stage / "caller.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as late:
        while not [*stage.glob("**/stage_*")]:  # it has read its files by then
            assert late.poll() is None
        (stage / "callee.py").write_text(CALLEE.replace("2 * x", "20 * x"))
        assert late.communicate(b"")[0] == b"7 0\n"
    assert run(stage) == "61 0"


def test_code_goes_where_it_can_be_written(stage: Path, tmp_path: Path) -> None:
    """Packages of the system are read-only for their users; images name a folder of their own."""
    stage.joinpath("__pycache__").write_text("a file, so that not even root can write in it")
    own, named = tmp_path / "own", tmp_path / "named"

    assert run(stage, XDG_CACHE_HOME=str(own)) == "7 0"
    assert run(stage, XDG_CACHE_HOME=str(own)) == "7 1"
    assert [*own.glob("shapecat/stage-*/kernels-*")]

    assert run(stage, NUMBA_CACHE_DIR=str(named)) == "7 0"
    assert [*named.glob("stage-*/kernels-*/**/*.nbc")]


def test_a_kernel_is_compiled_where_nothing_can_be_kept(stage: Path) -> None:
    """Slow is better than an error."""
    stage.joinpath("__pycache__").write_text("")
    assert run(stage, XDG_CACHE_HOME="/dev/null") == "7 0"


def test_a_stage_is_one_with_its_sub_packages() -> None:
    """Kernels call kernels of other sub-packages of their stage: an edit of any counts."""
    here = Path(shapecat.__file__).parent

    assert _stage_of(here / "detection" / "planes" / "ransac.py") == here / "detection"
    assert _stage_of(here / "detection" / "pipeline.py") == here / "detection"
    assert _stage_of(here / "geometry.py") == here
