"""Files and folders that appear complete or not at all, and locks that end with their process.

A file is flushed to disk before it is renamed to its final name, and its folder after that, so a
power cut leaves no incomplete content under a final name. ``SHAPECAT_FSYNC=0`` in the environment
skips flushing, for temporary data.
"""

import errno
import fcntl
import glob
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from shapecat.errors import OutputError, ShapecatError, explained

__all__ = [
    "FSYNC",
    "BusyError",
    "append_lines",
    "complete_folder",
    "flush",
    "holding",
    "lock",
    "partial_path",
    "replacing",
    "require_utf8",
    "require_writable",
    "scratch_folder",
]

FSYNC = "SHAPECAT_FSYNC"
"""The environment variable that disables flushing; worker processes inherit it."""
_SCRATCH = "shapecat-scratch-"
_UNLOCKED_S = 60
"""A temporary folder younger than this may not be locked yet."""


def partial_path(path: Path) -> Path:
    """Return the hidden path that a file or folder has until it is complete.

    Raises
    ------
    OutputError : the path has no name, as for the current folder or the root.
    """
    if not path.name:
        msg = f"{path}: name a file or folder in it"
        raise OutputError(msg)
    return path.with_name(f".{path.name}.partial")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Provide a hidden path; rename it to ``path`` if the block succeeds, else delete it.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    hidden = partial_path(path)
    with explained(f"{path}: cannot be written", OutputError):
        try:
            yield hidden
            flush(hidden)
            hidden.replace(path)
            flush(path.parent)
        finally:
            with suppress(OSError):
                hidden.unlink(missing_ok=True)


def require_writable(path: Path) -> None:
    """Make the parent folders of an output file, and check in advance that it can be written.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    hidden = partial_path(path)
    with explained(f"{path}: cannot be written", OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        hidden.touch()
        hidden.unlink()
    if path.is_dir():
        msg = f"{path}: cannot be written: is a folder"
        raise OutputError(msg)


def require_utf8(path: Path, kind: type[ShapecatError] = OutputError) -> None:
    """Check that a path is valid UTF-8, as Arrow and Rerun require.

    Raises
    ------
    ShapecatError : it is not; ``kind`` is the type of this error.
    """
    absolute = path.absolute()
    try:
        str(absolute).encode()
    except UnicodeEncodeError as error:
        printable = os.fsencode(absolute).decode(errors="replace")
        msg = f"{printable}: the path is not valid UTF-8; rename it"
        raise kind(msg) from error


@contextmanager
def complete_folder(folder: Path) -> Iterator[Path]:
    """Provide a hidden folder; rename it to ``folder`` if the block succeeds.

    If not, the hidden folder is left behind, and the next call deletes it first.

    Raises
    ------
    OSError : the folder cannot be written, or exists and is not empty.
    OutputError : as for `partial_path`.
    """
    hidden = partial_path(folder)
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir(parents=True)
    yield hidden
    for file in hidden.iterdir():
        flush(file)
    flush(hidden)
    hidden.rename(folder)
    flush(folder.parent)


def flush(path: Path) -> None:
    """Wait until a file, or the names in a folder, are stored on disk.

    Raises
    ------
    OSError : the disk is full or failing. A file system that cannot flush raises nothing.
    """
    if os.environ.get(FSYNC) == "0":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:
            raise
    finally:
        os.close(descriptor)


class BusyError(Exception):
    """Another thread or process holds a lock."""


def lock(path: Path, *, wait: bool = False) -> int | None:
    """Lock a file or folder until this process ends or the returned file descriptor is closed.

    Returns
    -------
    The file descriptor; None if another thread or process holds the lock and ``wait`` is False. On
    a file system without locks, every call succeeds.

    Raises
    ------
    OSError : the path does not exist or cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(descriptor)
        return None
    except OSError:
        pass
    return descriptor


@contextmanager
def holding(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a file or folder during the block.

    Parameters
    ----------
    wait : whether to wait while another thread or process holds it.

    Raises
    ------
    OutputError : the path does not exist or cannot be opened.
    BusyError : another thread or process holds the lock; only without ``wait``.
    """
    with explained(str(path), OutputError):
        descriptor = lock(path, wait=wait)
    if descriptor is None:
        raise BusyError
    try:
        yield
    finally:
        os.close(descriptor)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Provide a temporary folder for the block; also remove the folders of killed processes.

    A folder is removed only if this machine made it, since NFS does not show the locks of folders
    to other machines, and only if the file system has locks; otherwise it may be in use.
    """
    prefix = f"{_SCRATCH}{socket.gethostname()}+"  # "+" never occurs in a host name, unlike "-"
    for earlier in Path(gettempdir()).glob(f"{glob.escape(prefix)}*"):
        with suppress(OSError):
            if time.time() - earlier.stat().st_mtime > _UNLOCKED_S:
                _remove_unused(earlier)
    temporary = TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True)
    with temporary as folder, holding(Path(folder)):
        yield Path(folder)


def _remove_unused(folder: Path) -> None:
    """Remove a folder that no process uses.

    Raises
    ------
    OSError : another process holds its lock, or the file system has no locks.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(descriptor)


def append_lines(path: Path, lines: bytes) -> None:
    """Append lines to a file under a lock; create the file and its folder if they are missing.

    An incomplete last line of the file is ended first, and a write that fails is undone.

    Raises
    ------
    OSError : the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        size = os.fstat(file).st_size
        if size and os.pread(file, 1, size - 1) != b"\n":
            lines = b"\n" + lines
        try:
            written = os.write(file, lines)
            while written < len(lines):
                written += os.write(file, lines[written:])
        except OSError:
            os.ftruncate(file, size)
            raise
    finally:
        os.close(file)
