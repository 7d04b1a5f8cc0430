"""Identify a recording by its content, and a run folder by a random id.

A run has two ids. ``id`` is random and marks one folder as made by shapecat. ``work`` identifies
the recording and how it was processed: runs with the same ``work`` have the same frames,
detections, planes and tracks, but other masks if their colour topics differ. Each line of
tracks.csv holds ``work``.
"""

import json
import os
import secrets
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from threading import Event
from typing import Any, Self

import xxhash

from shapecat.errors import RecordingError, explained
from shapecat.recordings.files import input_files
from shapecat.runs.run_info import InputInfo, RunInfo

__all__ = [
    "ContentDigest",
    "content_digest",
    "file_stats",
    "new_id",
    "same_content",
    "unchanged",
    "work_id",
]

_BLOCK = 1 << 20
_OUTPUTS = ("color", "mcap", "rrd")

Stats = list[list[Any]]
"""For each file: name, size in bytes, and the times (ns) when content and inode changed last."""


def new_id() -> str:
    """Return a random id."""
    return secrets.token_hex(8)


def work_id(run: RunInfo) -> str:
    """Return the ``work`` id of a run; ``run`` must have the digest of the input.

    The id is a hash of the recording's content, settings, options, model and version, without the
    settings and options that affect only masks and outputs. It begins with a letter, so that no
    spreadsheet reads it as a number.
    """
    settings = {name: value for name, value in run["settings"].items() if name != "outputs"}
    options = {name: value for name, value in run["options"].items() if name not in _OUTPUTS}
    version = run["versions"]["shapecat"]
    parts = [run["input"]["digest"], settings, options, run["model"], version]
    return f"w{xxhash.xxh3_64_hexdigest(json.dumps(parts, sort_keys=True).encode())}"


def file_stats(path: Path) -> Stats:
    """Return name, size and times of each file of a recording, without reading the files.

    Raises
    ------
    OSError : a file is missing or not accessible.
    """
    stats = [(file.name, file.stat()) for file in input_files(path)]
    return [[name, s.st_size, s.st_mtime_ns, s.st_ctime_ns] for name, s in stats]


def unchanged(before: Sequence[Sequence[Any]], path: Path) -> bool:
    """Return whether the files of a recording have the same names, sizes and modification times.

    ``before`` is from `file_stats`. The result is False if a file is missing or not accessible.
    """
    try:
        return [list(s[:3]) for s in before] == [s[:3] for s in file_stats(path)]
    except OSError:
        return False


def content_digest(path: Path, *, cancelled: Event | None = None) -> str:
    """Return a digest of the whole content of a recording: a file, or the files of a bag.

    XXH3 with 128 bits (Collet 2019) runs at memory bandwidth and detects damage, but not forgery.

    Raises
    ------
    OSError : a file cannot be read.
    InterruptedError : ``cancelled`` was set.
    """
    total = xxhash.xxh3_128()
    block = memoryview(bytearray(_BLOCK))
    for file in input_files(path):
        if path.is_dir():
            total.update(os.fsencode(file.name) + f"\0{file.stat().st_size}\0".encode())
        with file.open("rb", buffering=0) as stream:
            while count := stream.readinto(block):
                if cancelled is not None and cancelled.is_set():
                    raise InterruptedError
                total.update(block[:count])
    return f"xxh3-128:{total.hexdigest()}"


class ContentDigest:
    """The digest of a recording, computed in a thread while the recording is processed.

    Use it as a context manager, which stops the thread. The thread also brings the files into the
    page cache, from which frames are read.
    """

    def __init__(self, path: Path) -> None:
        """Prepare the digest of a file or folder."""
        self._path = path
        self._cancelled = Event()
        self._pool = ThreadPoolExecutor(1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Stop reading."""
        self._cancelled.set()
        self._pool.shutdown()

    @cached_property
    def _digest(self) -> Future[str]:
        return self._pool.submit(content_digest, self._path, cancelled=self._cancelled)

    def start(self) -> None:
        """Start reading."""
        _ = self._digest

    def result(self) -> str:
        """Wait for the digest and return it; start reading if need be.

        Raises
        ------
        RecordingError : the recording cannot be read.
        """
        with explained(f"{self._path}: cannot be read", RecordingError):
            return self._digest.result()


def same_content(recorded: InputInfo, path: Path, digest: Callable[[], str]) -> bool:
    """Return whether the content of a recording is that of the entry ``input`` of a run.json.

    ``digest`` is called only if the names, sizes or times of the files differ.

    Raises
    ------
    OSError : a file is missing or not accessible.
    """
    if recorded["files"] == file_stats(path):
        return True
    return bool(recorded["digest"]) and recorded["digest"] == digest()
