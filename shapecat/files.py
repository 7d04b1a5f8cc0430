"""Files and folders that appear complete or not at all, and locks that end with their process."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from shapecat.errors import OutputError

__all__ = ["complete_folder", "input_size", "lock", "partial_folder", "replacing"]


def partial_folder(folder: Path) -> Path:
    """Return the hidden folder that a run works in before it takes its name."""
    return folder.with_name(f".{folder.name}.partial")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a hidden path beside ``path`` that takes its name when the block succeeds."""
    hidden = path.with_name(f".{path.name}.partial")
    try:
        yield hidden
        hidden.replace(path)
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror or error}"
        raise OutputError(msg) from error
    finally:
        hidden.unlink(missing_ok=True)


@contextmanager
def complete_folder(folder: Path) -> Iterator[Path]:
    """Give a hidden folder that takes the name ``folder`` when the block succeeds.

    Whatever a kill left half-made of it is discarded first.
    """
    hidden = partial_folder(folder)
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir(parents=True)
    yield hidden
    hidden.rename(folder)


def lock(folder: Path) -> int | None:
    """Lock a folder for as long as this process lives, or until the number given is closed.

    Returns
    -------
    None if another process holds it. A file system without locks never says so.
    """
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(held)
        return None
    except OSError:
        pass
    return held


def input_size(path: Path) -> int:
    """Return the bytes of a file, or of the files of a folder."""
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
