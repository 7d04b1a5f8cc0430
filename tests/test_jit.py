"""Kernels on disk: code must not outlive what it was made of."""

import subprocess
import sys
from pathlib import Path

import shapecat
from shapecat.jit import _stage_of

CALLER = """
from shapecat.jit import kernel
from callee import twice

@kernel
def outer(x):
    return twice(x) + 1

print(outer(3), len(outer.stats.cache_hits))
"""
CALLEE = """
from shapecat.jit import kernel

@kernel
def twice(x):
    return 2 * x
"""


def _run(folder: Path) -> str:
    command = [sys.executable, str(folder / "caller.py")]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_an_edit_of_a_called_kernel_counts(tmp_path: Path) -> None:
    """Numba's own cache would go on with the old code: the file of the caller is the same."""
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE)
    assert _run(tmp_path) == "7 0"
    assert _run(tmp_path) == "7 1", "nothing was kept"
    (tmp_path / "callee.py").write_text(CALLEE.replace("2 * x", "20 * x"))
    assert _run(tmp_path) == "61 0"


def test_a_kernel_from_the_cache_is_compiled_into_another(tmp_path: Path) -> None:
    """The cache gives machine code at once, but the code to inline only when it is asked for."""
    stages = [tmp_path / name for name in ("callees", "callers")]
    for stage in stages:
        stage.mkdir()
    (stages[0] / "callee.py").write_text(CALLEE)
    (stages[0] / "caller.py").write_text(CALLER)
    _run(stages[0])
    path = f"import sys; sys.path.insert(0, {str(stages[0])!r})\n"
    again = path + CALLER + "from callee import twice\nprint(len(twice.stats.cache_hits), twice(5))"
    (stages[1] / "caller.py").write_text(again)

    assert _run(stages[1]).split() == ["7", "0", "1", "10"]
    assert _run(stages[1]).split() == ["7", "1", "0", "10"]


def test_a_stage_is_one_with_its_sub_packages() -> None:
    """Kernels call kernels of other sub-packages of their stage: an edit of any counts."""
    here = Path(shapecat.__file__).parent

    assert _stage_of(here / "detection" / "planes" / "ransac.py") == here / "detection"
    assert _stage_of(here / "detection" / "pipeline.py") == here / "detection"
    assert _stage_of(here / "geometry.py") == here
