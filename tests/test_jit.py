"""Kernels on disk: code must not outlive what it was made of."""

import subprocess
import sys
from pathlib import Path

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
