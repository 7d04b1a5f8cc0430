"""manifest.jsonl: the state of each recording of a batch, one line per change.

The last line of a recording holds. Lines are appended whole, under a lock, so that several shards
may write one file; a line that a crash or a full disk cut short is skipped.
"""

import dataclasses
import fcntl
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

from shapecat.errors import OutputError

__all__ = ["MANIFEST", "Entry", "Manifest", "State"]

MANIFEST = "manifest.jsonl"

State = Literal["planned", "running", "complete", "failed"]


@dataclass(frozen=True)
class Entry:
    """A line of the manifest: a recording and its state.

    ``folder`` is the name of its run folder; ``input`` and ``work`` change when the recording, or
    what is to be done with it, does.
    """

    folder: str
    recording: str
    state: State
    input: str = ""
    work: str = ""
    tries: int = 0
    seconds: float | None = None
    frames: int | None = None
    exit_code: int = 0
    message: str = ""
    time: str = ""


class Manifest:
    """The manifest file, with the last entry of each run folder."""

    def __init__(self, path: Path) -> None:
        """Read the file, if there is one that can be read."""
        self.path = path
        self.entries: dict[str, Entry] = {}
        with suppress(OSError):  # reported when it is written to
            self._read()

    def _read(self) -> None:
        with self.path.open("rb") as file:
            for line in file:
                entry = _parse(line)
                if entry is not None:
                    self.entries[entry.folder] = entry

    def record(self, entries: Iterable[Entry]) -> None:
        """Append entries.

        Raises
        ------
        OutputError : the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        stamped = [dataclasses.replace(entry, time=now) for entry in entries]
        self.entries.update((entry.folder, entry) for entry in stamped)
        lines = [json.dumps(_without_nothing(entry), ensure_ascii=False) for entry in stamped]
        if not lines:
            return
        try:
            with _appending(self.path) as file:
                _write(file, "".join(f"{line}\n" for line in lines).encode())
        except OSError as error:
            msg = f"{self.path}: cannot be written: {error.strerror or error}"
            raise OutputError(msg) from error


def _without_nothing(entry: Entry) -> dict[str, Any]:
    return {
        name: value for name, value in dataclasses.asdict(entry).items() if value not in {None, ""}
    }


def _parse(line: bytes) -> Entry | None:
    """Return the entry of a line, or None for an incomplete or foreign line."""
    try:
        values = json.loads(line)
        entry = Entry(**values)
    except (ValueError, TypeError, RecursionError):
        return None
    known = isinstance(values["folder"], str) and entry.state in get_args(State)
    return entry if known else None


@contextmanager
def _appending(path: Path) -> Iterator[int]:
    """Open a file to append to, locked; the lock ends with the process, however it ends."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield file
    finally:
        os.close(file)


def _write(file: int, content: bytes) -> None:
    """Append lines; end an incomplete last line first, and undo a write that fails."""
    size = os.fstat(file).st_size
    if size and os.pread(file, 1, size - 1) != b"\n":
        content = b"\n" + content
    try:
        written = os.write(file, content)
        while written < len(content):
            written += os.write(file, content[written:])
    except OSError:
        os.ftruncate(file, size)
        raise
