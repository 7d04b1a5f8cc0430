"""The one place where kernels are compiled.

``@kernel`` is numba's ``njit`` with fixed options: machine code is cached on disk until a source
file of its stage (its subpackage, such as `detection`) changes, the interpreter lock is released,
and division by zero follows IEEE 754, as in numpy.
"""

import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numba import config, njit
from numba.extending import register_jitable

__all__ = ["code_folder", "kernel", "unset"]

_F = TypeVar("_F", bound=Callable[..., Any])

_FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""Fast-math flags without ``ninf``: sums and minima vectorise, and infinities stay valid."""
_HERE = Path(__file__).parent
_LARGE_BYTES = 2**24
"""Size of a block that raises the thresholds of glibc enough, see `_keep_freed_memory`."""
_SHARED = (_HERE / "geometry.py", _HERE / "jit.py", *(_HERE / "trees").glob("*.py"))
"""Files whose kernels every stage may call."""


def kernel(
    function: _F | None = None, *, fast: bool = False, inner: bool = False, inline: bool = False
) -> Any:
    """Compile a function of numbers and arrays on its first call.

    Parameters
    ----------
    fast : let the compiler reorder sums. Only for kernels that never meet NaN.
    inner : the function is called by kernels only, so that it needs no wrapper for Python, no file
        in the cache, and no version for each literal argument. Python calls it uncompiled.
        Callers that differ in ``fast`` or ``inner`` compile versions of their own.
    inline : compile the function as part of its caller, which must have the same ``fast``. Use it
        for kernels that are called in a single place: each saves 0.08 s of compilation.
    """
    options = {"nogil": True, "error_model": "numpy", "fastmath": _FAST if fast else False}

    def compile_later(target: _F) -> Any:
        """Return the function as a kernel, which its first call compiles."""
        if inner:
            return register_jitable(**options)(target)
        folder = code_folder(_stage_of(Path(target.__code__.co_filename)))
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder or "")
        try:
            return njit(
                cache=folder is not None, inline="always" if inline else "never", **options
            )(target)
        finally:
            config.CACHE_DIR = before

    return compile_later if function is None else compile_later(function)


@cache
def code_folder(stage: Path) -> Path | None:
    """Return the cache folder for the kernels of a stage; None if no folder is writable.

    Its name holds a digest of all source files that the machine code can come from: numba checks
    only the file of the outermost kernel, not those of the kernels it calls. Folders of older
    sources are removed; a process that still uses one creates it again. A new folder begins as a
    copy of a read-only one, such as in a container image or on a shared disk.

    Parameters
    ----------
    stage : the folder with the source files of the stage.
    """
    name, readable = f"kernels-{_digest(stage)}", None
    for place in _places(stage):
        folder = place / name
        known = folder.is_dir()
        if readable is not None and not known:
            _copy(readable, folder)
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)  # or another process has just made it
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            readable = folder if known else readable
            continue
        for other in () if known else place.glob("kernels-*"):
            if other.name != name:
                shutil.rmtree(other, ignore_errors=True)
        return folder
    return None


def _copy(source: Path, target: Path) -> None:
    """Copy a folder so that it appears complete, or not at all; ignore errors."""
    with suppress(OSError):
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="copy-", dir=target.parent) as hidden:
            copied = shutil.copytree(source, Path(hidden, target.name))
            for folder, *_ in os.walk(copied):
                Path(folder).chmod(0o700)  # installations may be read-only for their owner, too
            copied.rename(target)  # fails if another process has made it


def _stage_of(file: Path) -> Path:
    """Return the subpackage of shapecat that contains a file, or else the file's own folder."""
    inside = (folder for folder in file.parents if folder.parent == _HERE)
    return next(inside, file.parent)


def _digest(stage: Path) -> str:
    """Return a digest of the Python files of a stage and of the shared ones, 16 hex digits.

    If the package itself is the stage, only the shared files count.
    """
    files = set(_SHARED)
    if stage != _HERE:  # os.walk, since another process may be removing folders of kernels
        found = (Path(folder, name) for folder, _, names in os.walk(stage) for name in names)
        files.update(file for file in found if file.suffix == ".py")
    digest = hashlib.sha256()
    for file in sorted(files):
        name = file.relative_to(_HERE if file in _SHARED else stage)
        digest.update(f"{name}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def _places(stage: Path) -> Iterator[Path]:
    """Yield the folders to try, in order; only numba's cache folder if the user has set one.

    Otherwise ``__pycache__`` beside the files, the user's cache, and a temporary folder of the
    user, which is made only if it is needed.
    """
    mine = f"{stage.name}-{hashlib.sha256(str(stage).encode()).hexdigest()[:16]}"
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR, mine)
        return
    yield stage / "__pycache__"
    cache: str | Path | None = os.environ.get("XDG_CACHE_HOME")
    if not cache:
        with suppress(RuntimeError):  # the user has no home
            cache = Path.home() / ".cache"
    if cache:
        yield Path(cache, "shapecat", mine)
    if (own := _temporary_folder()) is not None:
        yield own / mine


def _temporary_folder() -> Path | None:
    """Make a temporary folder that only this user can write to; return None if that is impossible.

    Others must not write to it, because machine code is loaded from it.
    """
    with suppress(OSError):
        folder = Path(tempfile.gettempdir(), f"shapecat-{os.getuid()}")
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o22:
            return folder
    return None


def _keep_freed_memory() -> None:
    """Keep freed memory in the process: mapping it again costs 0.5 ms per frame.

    glibc maps blocks above M_MMAP_THRESHOLD separately, and returns free memory at the top of the
    heap above M_TRIM_THRESHOLD. Freeing a large block raises both (mallopt(3)).
    """
    np.empty(_LARGE_BYTES, np.uint8)  # noqa: TID251  nothing is read


_keep_freed_memory()


@kernel
def unset(shape: Any, dtype: Any) -> Any:
    """Return an uninitialised array, for kernels that write each element before they read it.

    Clearing an image would take 0.03 ms.
    """
    return np.empty(shape, dtype)  # noqa: TID251  the only one
