"""The one place where kernels are compiled.

``@kernel`` is numba's ``njit`` with the settings of the house: the machine code is cached on disk
as long as the files of the stage stay as they are, the interpreter lock is released, and division
by zero follows IEEE 754 as in numpy.
"""

import hashlib
import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numba import config, njit

__all__ = ["code_folder", "kernel", "unset"]

_F = TypeVar("_F", bound=Callable[..., Any])

_FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""Fast-math flags that keep infinities: sums and minima may be vectorised."""
_HERE = Path(__file__).parent
_LARGE_BYTES = 2**24
_SHARED = (_HERE / "geometry.py", _HERE / "jit.py", *(_HERE / "trees").glob("*.py"))
"""Files whose kernels stages call."""


def kernel(function: _F | None = None, *, fast: bool = False) -> Any:
    """Compile a function of numbers and arrays on its first call.

    Parameters
    ----------
    fast : let the compiler reorder sums. Only for kernels that never meet NaN.
    """

    def compile_later(target: _F) -> Any:
        folder = code_folder(_stage_of(Path(target.__code__.co_filename)))
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder or "")
        try:
            return njit(
                nogil=True,
                cache=folder is not None,
                error_model="numpy",
                fastmath=_FAST if fast else False,
            )(target)
        finally:
            config.CACHE_DIR = before

    return compile_later if function is None else compile_later(function)


@cache
def code_folder(stage: Path) -> Path | None:
    """Return where the machine code of the kernels of a folder is kept: None if nothing can be.

    Its name changes with any file that a kernel of the stage may be made of. Numba looks at the
    file of the outermost kernel alone, but its machine code holds that of all it calls. Folders
    of earlier files are removed; a process that still uses one makes it anew.
    """
    name = f"kernels-{_digest(stage)}"
    for place in _places(stage):
        folder = place / name
        if folder.is_dir() and os.access(folder, os.W_OK):
            return folder
        try:
            folder.mkdir(parents=True)
        except OSError:
            continue
        for other in place.glob("kernels-*"):
            if other.name != name:
                shutil.rmtree(other, ignore_errors=True)
        return folder
    return None


def _stage_of(file: Path) -> Path:
    """Return the folder of the stage that a file is of: one here, also for files further down."""
    inside = (folder for folder in file.parents if folder.parent == _HERE)
    return next(inside, file.parent)


def _digest(stage: Path) -> str:
    """Return a digest of the files of a stage, and of those that every stage may call."""
    files = set(_SHARED) if stage == _HERE else {*stage.rglob("*.py"), *_SHARED}
    digest = hashlib.sha256()
    for file in sorted(files):
        name = file.relative_to(_HERE if file in _SHARED else stage)
        digest.update(f"{name}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def _places(stage: Path) -> tuple[Path, ...]:
    """Return folders to try: the one the user names; else beside the files, or the user's own."""
    mine = f"{stage.name}-{hashlib.sha256(str(stage).encode()).hexdigest()[:16]}"
    if config.CACHE_DIR:
        return (Path(config.CACHE_DIR, mine),)
    own = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "shapecat", mine)
    return stage / "__pycache__", own


def _keep_freed_memory() -> None:
    """Let memory that is freed stay with the process: to map it anew costs 0.5 ms a frame.

    The allocator of glibc maps what is larger than a threshold apart, and gives the top of the rest
    back; freeing a large block raises both bounds (mallopt(3), M_MMAP_THRESHOLD).
    """
    np.empty(_LARGE_BYTES, np.uint8)  # noqa: TID251  nothing is read


_keep_freed_memory()


@kernel
def unset(shape: Any, dtype: Any) -> Any:
    """Return an array for kernels that write what they read: to clear an image takes 0.03 ms."""
    return np.empty(shape, dtype)  # noqa: TID251  the only one
