"""Find the recordings that a user names: files, folders, URLs."""

import logging
import os
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from itertools import compress, pairwise
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import Any

from shapecat.batch.storage import Location, content_key, is_url, names_in
from shapecat.errors import RecordingError
from shapecat.recordings import open_recording
from shapecat.recordings.files import is_of_bag

__all__ = ["SearchResult", "Source", "find_recordings", "stat_url"]

_log = logging.getLogger(__name__)

_SUFFIXES = {".mcap", ".bag", ".db3"}
_GAP_NS = 10**10
"""The longest time between the parts of a bag; takes are farther apart, or overlap."""
_COMPRESSED = {".zst", ".zstd", ".gz", ".bz2", ".xz", ".lz4", ".zip"}
_COMPRESSED_HINT = "skipped: a compressed file, unpack it first"
_MAGIC = (b"\x89MCAP", b"#ROSBAG", b"SQLite format 3")
_BAG_KEY = b"rosbag2_bagfile_information:"
"""The first line of a bag's metadata.yaml; data sets have files of this name, too."""
_METADATA_BYTES = 1 << 12
_THREADS = 16
"""Threads that read metadata at URLs: each request is a round trip."""


@dataclass(frozen=True, slots=True)
class Source:
    """A recording at a path or a URL; the field that does not apply is empty.

    ``stem`` is its name without suffix and ``parent`` the name of its folder; both serve to name
    the run folder. ``key`` changes with the content at a URL, and ``bytes`` is its size; they are
    empty and 0 for a path.
    """

    path: str
    url: str
    stem: str
    parent: str
    key: str = ""
    bytes: int = 0


@dataclass(frozen=True)
class SearchResult:
    """The recordings without duplicates, and the number of files skipped."""

    sources: list[Source]
    skipped: int


def find_recordings(sources: Sequence[str]) -> SearchResult:
    """Return the recordings among files, folders and URLs.

    Folders are searched recursively, except hidden files and folders and run folders; a ROS 2 bag
    counts as one recording. A single file is always kept. Among several, files with neither the
    suffix nor the first bytes of a recording are skipped and counted, so that ``folder/*`` works.

    Raises
    ------
    RecordingError : no recording was found.
    """
    search = _search_url if len(sources) == 1 else _search_url_beside_others
    remote = {found.url: found for source in sources if is_url(source) for found in search(source)}
    local, skipped = _search_paths([Path(source) for source in sources if not is_url(source)])
    found = [_of_path(path, real) for real, path in local.items()] + list(remote.values())
    if not found:
        named = " ".join(sources[:3])
        msg = f"{named}: no recording found; expected .mcap, .bag or .db3 files, or a ROS 2 bag"
        raise RecordingError(msg)
    return SearchResult(found, skipped)


def _of_path(path: Path, real: Path) -> Source:
    return Source(str(path), "", real.name if path.is_dir() else path.stem, real.parent.name)


def _of_url(url: str, key: str = "", size: int = 0) -> Source:
    parent, name = names_in(url)
    stem = PurePosixPath(name).stem if _has_recording_suffix(name) else name
    return Source("", url, stem, parent, key, size)


def _search_url(url: str) -> list[Source]:
    """Return the recordings that match a URL pattern or are below a folder, or the URL itself.

    Raises
    ------
    RecordingError : the storage cannot be reached.
    """
    location = Location(url)
    if any(character in url.partition("?")[0] for character in "*["):  # signed URLs have queries
        found = [
            _of_url(name, content_key(info), _size(info))
            for name, info in location.matches()
            if _has_recording_suffix(name)
        ]
        if found or location.info() is None:  # otherwise a name with brackets
            return sorted(found, key=attrgetter("url"))
    if url.endswith("/") or _is_remote_folder(location):
        return sorted(_search_remote_folder(location), key=attrgetter("url"))
    return [_of_url(url)]


def _search_url_beside_others(url: str) -> list[Source]:
    """Search a URL; a missing one is a recording, which fails as a missing file does."""
    found = _search_url(url)
    if found or next(Location(url).walk(deep=False), None) is None:
        return found or [_of_url(url)]
    _log.error("%s: no recording found", url)
    return []


def _is_remote_folder(location: Location) -> bool:
    """Return whether a URL is that of a folder; one with the suffix of a recording is not asked."""
    if _has_recording_suffix(location.url.partition("?")[0]):
        return False
    with suppress(RecordingError):  # reported when it is downloaded
        return (location.info() or {}).get("type") == "directory"
    return False


def stat_url(url: str) -> tuple[str, int]:
    """Return a key of the content at a URL and its size in bytes; empty and 0 if unknown."""
    location = Location(url)
    with suppress(RecordingError):  # reported when it is downloaded
        info = location.info()
        if info is not None and info.get("type") == "directory":
            files = [(content_key(file), _size(file)) for _, file in location.walk()]
            return _combined_key(key for key, _ in files), sum(size for _, size in files)
        if info is not None:
            return content_key(info), _size(info)
    return "", 0


def _combined_key(keys: Iterable[str]) -> str:
    ordered = sorted(keys)
    return sha256("".join(ordered).encode()).hexdigest()[:16] if all(ordered) else ""


def _size(info: Mapping[str, Any]) -> int:
    return int(info.get("size") or 0)


def _search_remote_folder(location: Location) -> Iterator[Source]:
    """Yield the recordings and ROS 2 bag folders below a folder."""
    files: list[Source] = []
    described, runs = set(), set()
    for url, info in location.walk():
        parent, _, name = url.rpartition("/")
        if name == "metadata.yaml":
            described.add(parent)
        elif name in {"run.json", "frames.parquet"}:
            runs.add(parent)
        elif "/." in url.removeprefix(location.root):
            continue
        elif _has_recording_suffix(name) or _is_compressed(name):
            files.append(_of_url(url, content_key(info), _size(info)))
    names = defaultdict[str, list[str]](list)
    for parent, _, name in (file.url.rpartition("/") for file in files):
        names[parent].append(name)
    bags = {url for url, held in names.items() if _is_named_as_bag(PurePosixPath(url).name, held)}
    bags |= set(_bags_among((described & names.keys()) - bags))
    parts: dict[str, list[Source]] = {bag: [] for bag in bags}
    for file in files:
        parent = file.url.rpartition("/")[0]
        if parent in parts:
            parts[parent].append(file)
        elif parent not in runs and _is_compressed(file.url):
            _log.error("%s: %s", file.url, _COMPRESSED_HINT)
        elif parent not in runs:
            yield file
    for bag, found in parts.items():
        yield _of_url(bag, _combined_key(f.key for f in found), sum(f.bytes for f in found))


def _bags_among(folders: Iterable[str]) -> list[str]:
    """Return the folders, by URL, whose metadata.yaml is that of a bag."""

    def is_bag(folder: str) -> bool:
        return _BAG_KEY in ((Location(folder) / "metadata.yaml").read() or b"")[:_METADATA_BYTES]

    ordered = sorted(folders)
    with ThreadPoolExecutor(_THREADS) as pool:
        return list(compress(ordered, pool.map(is_bag, ordered)))


def _search_paths(sources: Sequence[Path]) -> tuple[dict[Path, Path], int]:
    """Return the recordings, by path without links, and the number of files skipped."""
    folders = {source for source in sources if source.is_dir() and not _is_bag(source)}
    if len(sources) == 1 and not folders:
        return {_real_path(sources[0]): sources[0]}, 0
    found: dict[Path, Path] = {}
    skipped: set[Path] = set()
    for source in sources:
        for path in _search(source, set()) if source in folders else [source]:
            if path.is_file() and not _may_be_recording(path):
                skipped.add(_real_path(path))
            else:
                found.setdefault(_real_path(path), path)
    bags = {real for real, path in found.items() if path.is_dir()}
    kept = {real: path for real, path in found.items() if real.parent not in bags}
    return kept, sum(real.parent not in bags for real in skipped)


def _is_bag(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag: it has metadata, or its files are parts of one.

    ROS 2 names the parts of a bag a/a_0.mcap, a/a_1.mcap, ... In a folder of another name, such
    files may be different takes, unless they follow each other in time, or one is compressed.
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
    recordings, parts = _recordings_among(names), _parts_among(names)
    if len(recordings) == 1 and recordings.pop().endswith(".db3"):
        return True
    return _is_named_as_bag(_real_path(folder).name, names) or _follow_in_time(
        [folder / name for name in parts]
    )


def _is_named_as_bag(folder: str, names: Collection[str]) -> bool:
    """Return whether a folder with files of these names is a bag, whenever they were recorded."""
    parts = _parts_among(names)
    is_compressed = any(name.endswith(".zstd") for name in names)
    return bool(parts) and (is_compressed or parts[0].rpartition("_")[0] == folder)


def _recordings_among(names: Iterable[str]) -> set[str]:
    """Return the names of recordings, uncompressed."""
    uncompressed = {name.removesuffix(".zstd") for name in names}
    return {name for name in uncompressed if PurePosixPath(name).suffix in _SUFFIXES}


def _parts_among(names: Iterable[str]) -> list[str]:
    """Return the names of recordings if they are a_0.mcap, a_1.mcap, ..., in this order."""
    recordings = _recordings_among(names)
    first = PurePosixPath(min(recordings, default=""))
    base = first.stem.rpartition("_")[0]
    parts = [f"{base}_{k}{first.suffix}" for k in range(len(recordings))]
    return parts if is_of_bag(first.name) and recordings == set(parts) else []


def _has_bag_metadata(folder: Path) -> bool:
    try:
        with (folder / "metadata.yaml").open("rb") as file:
            return _BAG_KEY in file.read(_METADATA_BYTES)
    except FileNotFoundError:
        return False


def _follow_in_time(paths: Sequence[Path]) -> bool:
    """Return whether recordings follow each other in time without a gap."""
    spans = []
    for path in paths:
        with suppress(RecordingError), open_recording(path) as recording:
            if recording.end_ns:
                spans.append((recording.start_ns, recording.end_ns))
    return all(0 <= b - a <= _GAP_NS for (_, a), (b, _) in pairwise(spans)) and len(spans) > 1


def _search(folder: Path, searched: set[Path]) -> Iterator[Path]:
    """Yield the recordings below a folder, sorted by name in each folder, links last.

    No folder is searched twice, so links may form loops. A folder that may not be read, such as
    ``lost+found``, is skipped, and reported.
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
        elif is_folder or _has_recording_suffix(path.name):
            yield path
        elif _is_compressed(path.name):
            _log.error("%s: %s", path, _COMPRESSED_HINT)


def _is_compressed(name: str) -> bool:
    """Return whether a path or URL ends like a compressed recording."""
    path = PurePosixPath(name)
    return path.suffix.lower() in _COMPRESSED and _has_recording_suffix(path.stem)


def _real_path(path: Path) -> Path:
    """Return the absolute path without links; a link to itself, which `resolve` refuses, stays."""
    return Path(os.path.realpath(path))


def _has_recording_suffix(name: str) -> bool:
    """Return whether a file has the suffix of a recording, or of one whose recorder was killed."""
    return name.endswith(".bag.active") or PurePosixPath(name).suffix.lower() in _SUFFIXES


def _may_be_recording(path: Path) -> bool:
    if _has_recording_suffix(path.name):
        return True
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_MAGIC)
    except OSError:
        return True  # reported when it is opened
