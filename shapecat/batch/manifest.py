"""manifest.jsonl: the state of each recording of a batch, one line per change.

Only the last line of each recording counts. In a folder, complete lines are appended under a lock,
so that several shards can write to one file; a line truncated by a crash or a full disk is skipped.
At a URL nothing can be appended: each writer writes files of its own, called parts.
"""

import json
import logging
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Lock, Thread
from types import UnionType
from typing import Any, Literal, Self, get_args
from uuid import uuid4

from shapecat.batch.storage import Location, content_key, is_url
from shapecat.errors import OutputError, ShapecatError, explained
from shapecat.system.files import append_lines

__all__ = [
    "MANIFEST",
    "Entry",
    "FileManifest",
    "Manifest",
    "RemoteManifest",
    "State",
    "entries_at",
    "open_manifest",
]

MANIFEST = "manifest.jsonl"

_log = logging.getLogger(__name__)

_BEGIN = b'{"folder": "'
"""The first bytes of each line."""
_PART_FOLDER = ".manifest"
_PART_BYTES = 2**20
"""A writer begins a new part when the last one holds this much."""
_MOST_WAITING_BYTES = 8 * 2**20
"""Lines are sent immediately when more bytes than this are waiting."""
_SEND_S = 5.0
"""Time between two transmissions of lines."""

State = Literal["planned", "running", "complete", "failed"]


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the manifest: a recording and its state.

    ``folder`` is the name of the run folder. ``input`` is a key that changes with the content of
    the recording, ``work`` one that changes with the options, settings and model. ``command``
    identifies a command that overwrites. ``tries`` counts the attempts so far, ``seconds`` is the
    processing time, and ``tracks`` counts the tracks of each category. ``time`` is when the line
    was written, in UTC and ISO 8601.
    """

    folder: str
    recording: str
    state: State
    input: str = ""
    work: str = ""
    command: str = ""
    tries: int = 0
    seconds: float | None = None
    frames: int | None = None
    tracks: dict[str, int] | None = None
    exit_code: int = 0
    message: str = ""
    time: str = ""

    def same_work(self, other: "Entry") -> bool:
        """Return whether two entries have the same input and work."""
        return (self.input, self.work) == (other.input, other.work)

    def same_command(self, other: "Entry") -> bool:
        """Return whether two entries have the same input and work, from the same command."""
        return self.same_work(other) and self.command == other.command


_NAMES = tuple(field.name for field in fields(Entry))
_TYPES: dict[str, type | UnionType] = {
    **dict.fromkeys(_NAMES, str),
    **dict.fromkeys(("tries", "frames", "exit_code"), int),
    "seconds": int | float,
    "tracks": dict,
}
"""Types of the values in a line."""


class Manifest:
    """The last entry of each run folder, in memory; subclasses write the entries, too."""

    def __init__(self) -> None:
        """Begin without entries."""
        self.entries: dict[str, Entry] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Do nothing: each line is written at once."""

    def record(self, entries: Iterable[Entry]) -> None:
        """Add entries, stamped with the current time.

        Raises
        ------
        OutputError : they cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        stamped = [replace(entry, time=now) for entry in entries]
        self.entries.update((entry.folder, entry) for entry in stamped)
        if stamped:
            self._append(b"".join(map(_line, stamped)))

    def _append(self, lines: bytes) -> None:
        """Write lines, in subclasses."""


class FileManifest(Manifest):
    """A manifest in a file, to which each line is appended at once."""

    def __init__(self, path: Path) -> None:
        """Read the file, if it exists and is readable."""
        super().__init__()
        self.path, self.name = path, str(path)
        with suppress(OSError), path.open("rb") as file:  # reported when it is written to
            self.entries.update((entry.folder, entry) for entry in _entries(file))

    def begin(self) -> bytes:
        """Return the first megabyte of the file; empty if there is no readable file."""
        with suppress(OSError), self.path.open("rb") as file:
            return file.read(_PART_BYTES)
        return b""

    def _append(self, lines: bytes) -> None:
        with explained(f"{self.path}: cannot be written", OutputError):
            append_lines(self.path, lines)


class RemoteManifest(Manifest):
    """A manifest at a URL, in parts: ``.manifest/SHARD/PART.jsonl``.

    Each part has one writer. Every few seconds the writer replaces its last part by a longer one,
    until the part holds a megabyte. At the end, ``manifest.jsonl`` or ``manifest-SHARD.jsonl`` gets
    the last line of each recording. Lines that a killed writer had not sent are recovered from the
    run folders.
    """

    def __init__(self, url: str, shard: str = "") -> None:
        """Read the parts that exist.

        Parameters
        ----------
        url : the folder of results.
        shard : ``I-of-N``; each shard has parts of its own. Empty without shards.

        Raises
        ------
        OutputError : the storage cannot be read.
        """
        super().__init__()
        place = Location(url, OutputError)
        self._summary = place / (f"manifest-{shard}.jsonl" if shard else MANIFEST)
        self.name = self._summary.url
        self._parts = place / _PART_FOLDER / (shard or "all")
        self._writer = f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{uuid4().hex[:8]}"
        self._part_number = self._sent_bytes = 0
        self._part = bytearray()
        self._lock, self._sending, self._ended = Lock(), Lock(), Event()
        self._part_keys: dict[str, str] = {}
        self._read_parts()
        self._thread = Thread(target=self._send_periodically, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Send the remaining lines; after sending any, write all entries of all writers as a file.

        Errors are logged.
        """
        self._ended.set()
        self._thread.join()
        try:
            self.send()
            if self._part_number or self._part:
                self._read_parts()
                self._summary.write(b"".join(map(_line, self.entries.values())))
        except ShapecatError as failure:
            _log.error("%s", failure)

    def _read_parts(self) -> None:
        """Read parts of other writers that are new or have changed."""
        for url, info in self._parts.walk(deep=False):
            name, key = url.rpartition("/")[2], content_key(info)
            if not name.startswith(self._writer) and self._part_keys.get(name) != key:
                self._part_keys[name] = key
                self._keep_latest(((self._parts / name).read() or b"").splitlines())

    def begin(self) -> bytes:
        """Return the content of the existing summary; empty if there is none."""
        return self._summary.read() or b""

    def _keep_latest(self, lines: Iterable[bytes]) -> None:
        """Keep the latest entry of each run folder: several writers may work at the same time."""
        for entry in _entries(lines):
            last = self.entries.get(entry.folder)
            if last is None or last.time <= entry.time:
                self.entries[entry.folder] = entry

    def _append(self, lines: bytes) -> None:
        with self._lock:
            self._part += lines
            is_large = len(self._part) > _MOST_WAITING_BYTES
        if is_large:
            self.send()

    def send(self) -> None:
        """Send the lines recorded since the previous call.

        Raises
        ------
        OutputError : the storage is not writable; the next call sends the lines again.
        """
        with self._sending:
            with self._lock:
                content = bytes(self._part)
            if len(content) == self._sent_bytes:
                return
            (self._parts / f"{self._writer}-{self._part_number:06}.jsonl").write(content)
            self._sent_bytes = len(content)
            if self._sent_bytes >= _PART_BYTES:
                with self._lock:
                    del self._part[: self._sent_bytes]
                self._part_number += 1
                self._sent_bytes = 0

    def _send_periodically(self) -> None:
        while not self._ended.wait(_SEND_S):
            with suppress(ShapecatError):  # reported at the end if it persists
                self.send()


def open_manifest(out: str, *, shard: str | None = None) -> FileManifest | RemoteManifest:
    """Open the manifest in a folder or at a URL.

    Parameters
    ----------
    shard : ``I/N``. At a URL, each shard has its own manifest, since there are no locks.

    Raises
    ------
    OutputError : shapecat did not make the existing file, or the URL cannot be read.
    """
    part = shard.replace("/", "-of-") if shard else ""
    manifest = RemoteManifest(out, part) if is_url(out) else FileManifest(Path(out) / MANIFEST)
    lines = () if manifest.entries else manifest.begin().splitlines()
    begins = [line.strip(b"\0 ")[: len(_BEGIN)] for line in lines]  # a power cut may leave zeros
    if any(begins) and not any(map(_BEGIN.startswith, filter(None, begins))):
        msg = f"{manifest.name}: shapecat did not make this; choose another --out, or move it away"
        raise OutputError(msg)
    return manifest


def entries_at(url: str) -> dict[str, Entry]:
    """Return the entries of the manifests of all shards at a URL.

    Raises
    ------
    OutputError : the storage cannot be read.
    """
    entries: dict[str, Entry] = {}
    for shard in sorted((Location(url, OutputError) / _PART_FOLDER).names()):
        entries |= RemoteManifest(url, shard).entries
    return entries


def _line(entry: Entry) -> bytes:
    values = ((name, getattr(entry, name)) for name in _NAMES)
    present = {name: value for name, value in values if value is not None and value != ""}
    try:
        return json.dumps(present, ensure_ascii=False).encode() + b"\n"
    except UnicodeEncodeError:  # a path that is not UTF-8; other programs could not read the file
        return json.dumps(present).encode() + b"\n"


def _entries(lines: Iterable[bytes]) -> Iterator[Entry]:
    """Yield the entries of the lines that are complete."""
    return filter(None, map(_parse, lines))


def _parse(line: bytes) -> Entry | None:
    """Return the entry of a line, or None if the line is incomplete or not an entry."""
    try:
        values = json.loads(line)
        entry = Entry(**{name: _interned(name, value) for name, value in values.items()})
        is_valid = entry.state in get_args(State) and all(
            isinstance(value, _TYPES[name]) for name, value in values.items()
        )
    except (ValueError, TypeError, AttributeError, RecursionError):
        return None
    return entry if is_valid else None


def _interned(name: str, value: Any) -> Any:
    """Intern a value that many entries have in common, to save memory."""
    is_shared = name in {"state", "work", "command"} and isinstance(value, str)
    return sys.intern(value) if is_shared else value
