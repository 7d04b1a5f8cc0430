"""Recordings and results at URLs: downloaded to scratch, uploaded, then renamed.

fsspec, the extra ``remote``, knows the protocols; each storage has a package of its own (s3fs,
gcsfs, ...). Without a URL nothing here is used.
"""

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from threading import Event, Thread
from typing import Any

from shapecat.errors import ConfigError, OutputError, RecordingError, ShapecatError
from shapecat.runs.folder import RUN_FILES
from shapecat.system.files import lock

__all__ = [
    "Place",
    "download",
    "fetch",
    "finish_upload",
    "is_url",
    "list_urls",
    "look_at",
    "output_place",
    "scratch",
    "upload",
]

_SCRATCH = "shapecat-scratch-"
_MANIFEST = "manifest.jsonl"
_UPLOAD_S = 10.0


def is_url(text: str) -> bool:
    """Return whether a source or an output is a URL rather than a path.

    Examples
    --------
    >>> is_url("s3://lab/x.mcap"), is_url("/data/x.mcap")
    (True, False)
    """
    return "://" in text


def _storage(url: str, error: type[ShapecatError] = RecordingError) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it."""
    try:
        from fsspec.core import url_to_fs  # noqa: PLC0415  an extra
    except ImportError as missing:
        msg = f"{url}: URLs need fsspec: pip install 'shapecat[remote]'"
        raise ConfigError(msg) from missing
    try:
        system, path = url_to_fs(url)
    except ImportError as missing:
        msg = f"{url}: {missing}"
        raise ConfigError(msg) from missing
    except (OSError, ValueError) as reason:
        msg = f"{url}: cannot be reached: {reason}"
        raise error(msg) from reason
    return system, path


def _failures() -> tuple[type[Exception], ...]:
    """Return what storages raise when they fail: not all of it is an OSError."""
    with suppress(ImportError):
        from aiohttp import ClientError  # noqa: PLC0415  an extra

        return (OSError, ValueError, NotImplementedError, ClientError)
    return (OSError, ValueError, NotImplementedError)


def list_urls(url: str, suffixes: Collection[str]) -> list[str]:
    """Return the recordings that a URL names: those of a pattern or a folder, or itself.

    Raises
    ------
    RecordingError : the storage cannot be reached.
    """
    system, path = _storage(url)
    try:
        if any(c in path for c in "*["):
            names = system.glob(path)
        elif url.endswith("/"):
            names = system.find(path)
        else:
            return [url]
    except _failures() as error:
        msg = f"{url}: cannot be listed: {error}"
        raise RecordingError(msg) from error
    kept = [name for name in sorted(names) if Path(name).suffix in suffixes]
    return [str(system.unstrip_protocol(name)) for name in kept]


def look_at(url: str) -> tuple[str, int]:
    """Return what changes when a file at a URL does, and its bytes; empty where there is none."""
    system, path = _storage(url)
    try:
        known = system.info(path)
    except _failures():
        return "", 0
    marks = {name: str(value) for name, value in sorted(known.items()) if name in _MARKS}
    return sha256(repr(marks).encode()).hexdigest()[:16], int(known.get("size") or 0)


_MARKS = {"size", "ETag", "etag", "mtime", "created", "LastModified", "last_modified", "md5Hash"}


@contextmanager
def scratch() -> Iterator[Path]:
    """Give a folder that is removed in the end; what killed processes have left goes as well."""
    parent = Path(tempfile.gettempdir())
    for left in parent.glob(f"{_SCRATCH}*"):
        with suppress(OSError):
            _remove_unless_used(left)
    with tempfile.TemporaryDirectory(prefix=_SCRATCH, ignore_cleanup_errors=True) as folder:
        held = lock(Path(folder))
        try:
            yield Path(folder)
        finally:
            _release(held)


def _remove_unless_used(folder: Path) -> None:
    held = lock(folder)
    if held is not None:
        shutil.rmtree(folder, ignore_errors=True)
        _release(held)


def _release(held: int | None) -> None:
    if held is not None:
        os.close(held)


def download(url: str, folder: Path) -> Path:
    """Fetch a recording into a folder.

    Raises
    ------
    RecordingError : it is not there, or the connection broke.
    """
    system, path = _storage(url)
    target = folder / Path(path.partition("?")[0]).name
    try:
        system.get(path, str(target), recursive=system.isdir(path))
    except _failures() as error:
        msg = f"{url}: cannot be downloaded: {str(error) or type(error).__name__}"
        raise RecordingError(msg) from error
    if not target.exists():
        msg = f"{url}: does not exist"
        raise RecordingError(msg)
    return target


def fetch(url: str) -> bytes:
    """Return the content of a small file.

    Raises
    ------
    OutputError : it cannot be read.
    """
    system, path = _storage(url, OutputError)
    try:
        return bytes(system.cat_file(path))
    except _failures() as error:
        msg = f"{url}: cannot be read: {str(error) or type(error).__name__}"
        raise OutputError(msg) from error


def upload(folder: Path, url: str) -> None:
    """Send a run folder under a hidden name, then rename it; run.json comes last.

    Object stores have no rename: theirs is a copy, file by file, and what has no run.json is not
    complete.

    Raises
    ------
    OutputError : the storage cannot be written to, or the place is a stranger's.
    """
    system, path = _storage(url, OutputError)
    hidden = _hidden(path)
    try:
        _require_ours(system, path, url)
        _remove(system, hidden, RUN_FILES)
        system.makedirs(hidden, exist_ok=True)
        for file in sorted(folder.iterdir(), key=lambda file: file.name == "run.json"):
            system.put_file(str(file), f"{hidden}/{file.name}")
    except _failures() as error:
        raise _cannot_upload(url, error) from error
    finish_upload(url)


def finish_upload(url: str) -> None:
    """Rename what was sent as a whole, also by a process that was killed before it had.

    Raises
    ------
    OutputError : the storage cannot be written to.
    """
    system, path = _storage(url, OutputError)
    hidden = _hidden(path)
    try:
        sent = [PurePosixPath(name).name for name in _list(system, hidden)]
        if "run.json" not in sent:
            return
        _remove(system, path, ("run.json",))
        system.makedirs(path, exist_ok=True)
        for name in sorted(sent, key=lambda name: name == "run.json"):
            system.mv(f"{hidden}/{name}", f"{path}/{name}")
        _remove(system, path, set(RUN_FILES) - set(sent))
        with suppress(*_failures()):
            system.rmdir(hidden)  # object stores have no folders
    except _failures() as error:
        raise _cannot_upload(url, error) from error


def _hidden(path: str) -> str:
    parent, _, name = path.rstrip("/").rpartition("/")
    return f"{parent}/.{name}.partial"


def _cannot_upload(url: str, error: Exception) -> OutputError:
    return OutputError(f"{url}: cannot be uploaded: {str(error) or type(error).__name__}")


def _require_ours(system: Any, path: str, url: str) -> None:
    """Refuse to touch a place that holds files but no run's marker.

    Raises
    ------
    OutputError : it is a stranger's.
    """
    names = {PurePosixPath(name).name for name in _list(system, path)}
    if "run.json" not in names and names - set(RUN_FILES):
        msg = f"{url}: shapecat did not make this; choose another --out, or move it away"
        raise OutputError(msg)


def _list(system: Any, path: str) -> list[str]:
    """Return the paths of what lies in a folder; none where there is no folder."""
    with suppress(FileNotFoundError):
        return [str(name) for name in system.ls(path, detail=False)]
    return []


def _remove(system: Any, path: str, names: Collection[str]) -> None:
    """Remove files from a folder."""
    for name in _list(system, path):
        if PurePosixPath(name).name in names:
            system.rm(name)


@dataclass(frozen=True)
class Place:
    """Where results go: a folder, or a URL with a local folder that stands in for it."""

    root: Path
    url: str
    manifest: Path

    def folder(self, name: str) -> Path:
        """Return the run folder of a recording; with a URL only its name is of use."""
        return self.root / name

    def target(self, name: str) -> str:
        """Return the URL of a run folder; empty without one."""
        return f"{self.url}/{name}" if self.url else ""


@contextmanager
def output_place(out: str, *, part_of: str | None = None) -> Iterator[Place]:
    """Give the place of ``out``; the manifest of one at a URL is sent there as it grows.

    Parameters
    ----------
    part_of : the shard, which keeps a manifest of its own at a URL: nothing locks it there.
    """
    if not is_url(out):
        yield Place(Path(out), "", Path(out) / _MANIFEST)
        return
    url = out.rstrip("/")
    name = _MANIFEST if part_of is None else f"manifest-{part_of.replace('/', '-of-')}.jsonl"
    system, path = _storage(f"{url}/{name}", OutputError)
    with scratch() as folder:
        file = folder / name
        with suppress(*_failures()):
            system.get_file(path, str(file))
        with _sent(file, system, path):
            yield Place(folder, url, file)


@contextmanager
def _sent(file: Path, system: Any, path: str) -> Iterator[None]:
    """Send a file every few seconds if it has grown, and once more in the end."""
    ended, sent = Event(), [file.stat().st_size if file.exists() else 0]

    def send() -> None:
        with suppress(*_failures()):
            size = file.stat().st_size
            if size != sent[0]:
                system.makedirs(path.rpartition("/")[0], exist_ok=True)
                system.put_file(str(file), path)
                sent[0] = size

    def send_now_and_then() -> None:
        while not ended.wait(_UPLOAD_S):
            send()

    thread = Thread(target=send_now_and_then, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        send()
