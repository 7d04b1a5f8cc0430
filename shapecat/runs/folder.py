"""The folder of one run: built under a hidden name, renamed when complete."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from shapecat.errors import OutputError
from shapecat.files import lock, partial_folder, replacing

__all__ = [
    "digest",
    "empty",
    "read_run",
    "staged",
    "sweep",
    "write_run",
]

_SAMPLE = 1 << 20


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Give a hidden folder beside ``folder`` that takes its name when the block succeeds.

    An older ``folder`` is replaced only then. On an error nothing is left behind; after an
    interruption or a kill the hidden folder stays, and the next run finds in it what was done.

    Raises
    ------
    OutputError : the disk is full, the place is not writable, or another run is writing there.
    """
    hidden = partial_folder(folder)
    created = _missing_parents(folder)
    try:
        hidden.mkdir(parents=True, exist_ok=True)
        with _locked(hidden):
            yield hidden
            _swap(hidden, folder)
    except OSError as error:
        _discard(hidden, created)
        msg = f"{folder}: cannot write the results: {error.strerror or error}"
        raise OutputError(msg) from error
    except _BusyError as error:
        msg = f"{folder}: another run is writing there"
        raise OutputError(msg) from error
    except Exception:
        _discard(hidden, created)
        raise


def empty(folder: Path) -> None:
    """Remove everything in a folder."""
    for item in folder.iterdir():
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item)
        else:
            item.unlink()


def sweep(folder: Path) -> None:
    """Remove what killed runs left in and beside a complete folder."""
    with suppress(OSError, _BusyError):
        shutil.rmtree(_old(folder), ignore_errors=True)
        for file in folder.glob(".*.partial"):
            file.unlink()
        if partial_folder(folder).exists():
            with _locked(partial_folder(folder)):
                shutil.rmtree(partial_folder(folder), ignore_errors=True)


class _BusyError(Exception):
    """Another process holds the folder."""


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    held = lock(folder)
    if held is None:
        raise _BusyError
    try:
        yield
    finally:
        os.close(held)


def _old(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")


def _discard(hidden: Path, created: list[Path]) -> None:
    shutil.rmtree(hidden, ignore_errors=True)
    for parent in created:
        with suppress(OSError):  # not empty: something was written there
            parent.rmdir()


def _missing_parents(folder: Path) -> list[Path]:
    return [parent for parent in folder.parents if not parent.exists()]


def _swap(new: Path, folder: Path) -> None:
    old = _old(folder)
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def digest(path: Path) -> str:
    """Return a hash that tells one recording from another without reading all of it.

    SHA-256 over size, first and last MiB of the file, or of each file of a folder in name order.
    """
    total = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_file():
            continue
        size = file.stat().st_size
        total.update(f"{size}".encode())
        with file.open("rb") as stream:
            total.update(stream.read(_SAMPLE))
            stream.seek(max(0, size - _SAMPLE))
            total.update(stream.read(_SAMPLE))
    return total.hexdigest()


def write_run(folder: Path, run: Mapping[str, Any]) -> None:
    """Write run.json."""
    with replacing(folder / "run.json") as path:
        path.write_text(json.dumps(run, indent=1) + "\n", "utf-8")


def read_run(folder: Path) -> dict[str, Any]:
    """Read run.json.

    Raises
    ------
    OutputError : the folder is not the result of a run.
    """
    try:
        run = json.loads((folder / "run.json").read_text("utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        msg = f"{folder}: no run.json there; expected a folder made by `shapecat process`"
        raise OutputError(msg) from error
    if not isinstance(run, dict):
        msg = f"{folder / 'run.json'}: not a description of a run"
        raise OutputError(msg)
    return run
