"""Find the recordings that a user names: files, folders, URLs."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from glob import glob
from itertools import pairwise
from pathlib import Path

from shapecat.batch.finding_urls import search_url, search_url_beside_others
from shapecat.batch.sources import (
    BAG_KEY,
    COMPRESSED_HINT,
    METADATA_BYTES,
    Source,
    has_recording_suffix,
    is_compressed,
    is_named_as_bag,
    parts_among,
    recordings_among,
)
from shapecat.batch.storage import is_url
from shapecat.errors import RecordingError
from shapecat.recordings import open_recording

__all__ = ["SearchResult", "find_recordings"]

_log = logging.getLogger(__name__)

_GAP_NS = 10**10
"""Longest time between the parts of a bag; separate recordings are farther apart, or overlap."""
_MAGIC = (b"\x89MCAP", b"#ROSBAG", b"SQLite format 3")


@dataclass(frozen=True)
class SearchResult:
    """The recordings that a search found, without duplicates.

    ``skipped`` counts the files that are not recordings. ``notes`` report each path that leads to
    the same recording as an earlier path, and each folder without a recording, such as a disk that
    is not mounted.
    """

    sources: list[Source]
    skipped: int
    notes: list[str]


def find_recordings(sources: Sequence[str]) -> SearchResult:
    """Return the recordings among files, folders and URLs.

    A pattern such as ``*.mcap`` is expanded here too, as programs may call the command without a
    shell; a file with this very name takes precedence. Folders are searched recursively; hidden
    files, hidden folders and run folders are left out, and a ROS 2 bag counts as one recording. A
    file that is the only source is always kept. Of several files, those with neither the suffix nor
    the first bytes of a recording are skipped and counted, so that ``folder/*`` works.

    Raises
    ------
    RecordingError : no recording was found, or a URL cannot be reached.
    ConfigError : a URL needs a library that is not installed.
    """
    search = search_url if len(sources) == 1 else search_url_beside_others
    remote = {found.url: found for source in sources if is_url(source) for found in search(source)}
    paths = [path for source in sources if not is_url(source) for path in _expanded(source)]
    local, skipped, notes = _search_paths(paths)
    found = [_of_path(path, real) for real, path in local.items()] + list(remote.values())
    if not found:
        named = " ".join(sources[:3])
        msg = f"{named}: no recording found; expected .mcap, .bag or .db3 files, or a ROS 2 bag"
        raise RecordingError(msg)
    return SearchResult(found, skipped, notes)


def _expanded(source: str) -> list[Path]:
    """Expand a pattern, unless a file has this name or nothing matches.

    A match inside a matching folder is left out: the search of the folder finds it.
    """
    if os.path.lexists(source):
        return [Path(source)]
    names = glob(source, recursive=True)  # noqa: PTH207  Path.glob finds hidden files, too
    matches = [Path(name) for name in sorted(names)]
    folders = {path for path in matches if path.is_dir()}
    return [path for path in matches if folders.isdisjoint(path.parents)] or [Path(source)]


def _of_path(path: Path, real: Path) -> Source:
    if path.is_dir():  # "." has no name
        return Source(str(path), "", real.name, real.parent.name)
    return Source(str(path), "", path.stem, path.absolute().parent.name)


def _search_paths(sources: Sequence[Path]) -> tuple[dict[Path, Path], int, list[str]]:
    """Return the recordings at paths and below folders, the number of files skipped, and notes.

    The recordings are a mapping from each resolved path to the path as it was found.
    """
    folders = {source for source in sources if source.is_dir() and not _is_bag(source)}
    if len(sources) == 1 and not folders:
        return {_real_path(sources[0]): sources[0]}, 0, []
    found: dict[Path, Path] = {}
    others: dict[Path, Path] = {}  # other paths of recordings, with their resolved paths
    skipped: set[Path] = set()
    empty = []
    for source in sources:
        paths = list(_search(source, set())) if source in folders else [source]
        recordings = [path for path in paths if not path.is_file() or _may_be_recording(path)]
        skipped.update(_real_path(path) for path in set(paths).difference(recordings))
        for path in recordings:
            if found.setdefault(real := _real_path(path), path) != path:
                others[path] = real
        if source in folders and not recordings:
            empty.append(f"no recording in {source}")
    bags = {real for real, path in found.items() if path.is_dir()}
    kept = {real: path for real, path in found.items() if real.parent not in bags}
    repeated = [f"{path} is {kept[real]}" for path, real in others.items() if real in kept]
    return kept, sum(real.parent not in bags for real in skipped), [*repeated, *empty]


def _is_bag(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag: it has metadata, or its files are parts of one.

    ROS 2 names the parts of a bag a/a_0.mcap, a/a_1.mcap, ... In a folder with another name, such
    files may be separate recordings, unless they follow each other in time, or one is compressed.
    A folder with a single .db3 file is a bag; without metadata, one with subfolders is not.
    """
    try:
        if _has_bag_metadata(folder):
            return True
        paths = list(folder.iterdir())
        if any(path.is_dir() for path in paths):
            return False
    except OSError:  # reported by the search
        return False
    names = {path.name for path in paths if path.is_file()}
    recordings, parts = recordings_among(names), parts_among(names)
    if len(recordings) == 1 and recordings.pop().endswith(".db3"):
        return True
    return is_named_as_bag(_real_path(folder).name, names) or _follow_in_time(
        [folder / name for name in parts]
    )


def _has_bag_metadata(folder: Path) -> bool:
    try:
        with (folder / "metadata.yaml").open("rb") as file:
            return BAG_KEY in file.read(METADATA_BYTES)
    except FileNotFoundError:
        return False


def _follow_in_time(paths: Sequence[Path]) -> bool:
    """Return whether each recording begins 0 to 10 s after the end of the one before it.

    Unreadable recordings, and those without messages, are ignored; at least two must be left.
    """
    spans = []
    for path in paths:
        with suppress(RecordingError), open_recording(path) as recording:
            if recording.end_ns:
                spans.append((recording.start_ns, recording.end_ns))
    return all(0 <= b - a <= _GAP_NS for (_, a), (b, _) in pairwise(spans)) and len(spans) > 1


def _search(folder: Path, searched: set[Path]) -> Iterator[Path]:
    """Yield the recordings below a folder; each folder is sorted by name, symbolic links last.

    Runs and hidden entries are left out, and so are folders in ``searched`` (resolved paths;
    updated in place), which makes loops of links harmless. A folder that may not be read, such as
    ``lost+found``, is skipped, and the log says so.
    """
    real = _real_path(folder)
    if real in searched:
        return
    searched.add(real)
    try:
        paths = [] if (folder / "run.json").exists() else list(folder.iterdir())
        paths.sort(key=lambda path: (path.is_symlink(), path))
        found = [(path, path.is_dir()) for path in paths if not path.name.startswith(".")]
    except OSError as error:
        _log.error("%s: skipped: %s", folder, error.strerror or error)
        return
    for path, is_folder in found:
        if is_folder and not _is_bag(path):
            yield from _search(path, searched)
        elif is_folder or has_recording_suffix(path.name):
            yield path
        elif is_compressed(path.name):
            _log.error("%s: %s", path, COMPRESSED_HINT)


def _real_path(path: Path) -> Path:
    """Resolve all symbolic links except one to itself, which `Path.resolve` refuses."""
    return Path(os.path.realpath(path))


def _may_be_recording(path: Path) -> bool:
    if has_recording_suffix(path.name):
        return True
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_MAGIC)
    except OSError:
        return True  # reported when it is opened
