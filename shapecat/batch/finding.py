"""Find the recordings that a user names: files, folders, URLs."""

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from itertools import pairwise
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import Any

from shapecat.batch.storage import Location, content_key, is_url
from shapecat.errors import RecordingError
from shapecat.recordings import open_recording
from shapecat.recordings.files import is_of_bag

__all__ = ["SearchResult", "Source", "find_recordings", "stat_url"]

_log = logging.getLogger(__name__)

SUFFIXES = {".mcap", ".bag", ".db3"}
_GAP_NS = 10**10
"""The longest time between the parts of a bag; takes are farther apart, or overlap."""
_PACKED = {".zst", ".zstd", ".gz", ".bz2", ".xz", ".lz4", ".zip"}
_UNPACK = "skipped: a compressed file, unpack it first"
_MAGIC = (b"\x89MCAP", b"#ROSBAG", b"SQLite format 3")
_BAG_KEY = b"rosbag2_bagfile_information:"
"""The first line of a bag's metadata.yaml; data sets have files of this name, too."""


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
    remote = {found.url: found for source in sources if is_url(source) for found in _at(source)}
    paths, skipped = _find_paths([Path(source) for source in sources if not is_url(source)])
    found = [_of_path(path) for path in paths] + list(remote.values())
    if not found:
        named = " ".join(sources[:3])
        msg = f"{named}: no recording found; expected .mcap, .bag or .db3 files, or a ROS 2 bag"
        raise RecordingError(msg)
    return SearchResult(found, skipped)


def _of_path(path: Path) -> Source:
    whole = _whole(path)
    return Source(str(path), "", whole.name if path.is_dir() else path.stem, whole.parent.name)


def _of_url(url: str, key: str = "", size: int = 0) -> Source:
    pure = PurePosixPath(url.partition("://")[2].partition("?")[0])
    stem = pure.stem if _named_like_one(pure.name) else pure.name
    return Source("", url, stem, pure.parent.name, key, size)


def _at(url: str) -> list[Source]:
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
            if _named_like_one(name)
        ]
        if found or location.info() is None:  # otherwise a name with brackets
            return sorted(found, key=attrgetter("url"))
    if url.endswith("/"):
        return sorted(_search_remote(location), key=attrgetter("url"))
    return [_of_url(url)]


def stat_url(url: str) -> tuple[str, int]:
    """Return a key of the content at a URL and its size in bytes; empty and 0 if unknown."""
    location = Location(url)
    with suppress(RecordingError):  # reported when it is downloaded
        info = location.info()
        if info is not None and info.get("type") == "directory":
            files = [(content_key(known), _size(known)) for _, known in location.walk()]
            return _key_of_all(key for key, _ in files), sum(size for _, size in files)
        if info is not None:
            return content_key(info), _size(info)
    return "", 0


def _key_of_all(keys: Iterable[str]) -> str:
    return sha256("".join(sorted(keys)).encode()).hexdigest()[:16]


def _size(info: Mapping[str, Any]) -> int:
    return int(info.get("size") or 0)


def _search_remote(location: Location) -> Iterator[Source]:
    """Yield the recordings and ROS 2 bag folders below a folder."""
    files: list[Source] = []
    bags, runs = set(), set()
    for url, info in location.walk():
        parent, _, name = url.rpartition("/")
        if name == "metadata.yaml":
            bags.add(parent)
        elif name in {"run.json", "frames.parquet"}:
            runs.add(parent)
        elif (_named_like_one(name) or _is_packed(name)) and "/." not in url:
            files.append(_of_url(url, content_key(info), _size(info)))
    parts: dict[str, list[Source]] = {bag: [] for bag in bags}
    for file in files:
        parent = file.url.rpartition("/")[0]
        if parent in bags:
            parts[parent].append(file)
        elif parent not in runs and _is_packed(file.url):
            _log.error("%s: %s", file.url, _UNPACK)
        elif parent not in runs:
            yield file
    for bag, found in parts.items():
        if found:
            yield _of_url(bag, _key_of_all(f.key for f in found), sum(f.bytes for f in found))


def _find_paths(sources: Sequence[Path]) -> tuple[list[Path], int]:
    if len(sources) == 1 and not _searchable(sources[0]):
        return list(sources), 0
    found: dict[Path, Path] = {}
    left: set[Path] = set()
    for source in sources:
        for path in _search(source, set()) if _searchable(source) else [source]:
            if path.is_file() and not _looks_like_one(path):
                left.add(_whole(path))
            else:
                found.setdefault(_whole(path), path)
    bags = {whole for whole, path in found.items() if path.is_dir()}
    kept = [path for whole, path in found.items() if whole.parent not in bags]
    return kept, sum(path.parent not in bags for path in left)


def _searchable(path: Path) -> bool:
    return path.is_dir() and not _is_bag(path)


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
    names = {path.name.removesuffix(".zstd") for path in paths if path.is_file()}
    parts = {name for name in names if PurePosixPath(name).suffix in SUFFIXES}
    first = PurePosixPath(min(parts, default=""))
    if len(parts) == 1 and first.suffix == ".db3":
        return True
    base = first.stem.rpartition("_")[0]
    in_sequence = [f"{base}_{k}{first.suffix}" for k in range(len(parts))]
    if not is_of_bag(first.name) or parts != set(in_sequence):
        return False
    compressed = any(path.suffix == ".zstd" for path in paths)
    return (
        base == _whole(folder).name
        or compressed
        or _adjoin([folder / name for name in in_sequence])
    )


def _has_bag_metadata(folder: Path) -> bool:
    try:
        with (folder / "metadata.yaml").open("rb") as file:
            return _BAG_KEY in file.read(1 << 12)
    except FileNotFoundError:
        return False


def _adjoin(paths: Sequence[Path]) -> bool:
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
    whole = _whole(folder)
    if whole in searched:
        return
    searched.add(whole)
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
        elif is_folder or _named_like_one(path.name):
            yield path
        elif _is_packed(path.name):
            _log.error("%s: %s", path, _UNPACK)


def _is_packed(name: str) -> bool:
    """Return whether a path or URL ends like a compressed recording."""
    path = PurePosixPath(name)
    return path.suffix.lower() in _PACKED and _named_like_one(path.stem)


def _whole(path: Path) -> Path:
    """Return the absolute path without links; a link to itself, which `resolve` refuses, stays."""
    return Path(os.path.realpath(path))


def _named_like_one(name: str) -> bool:
    """Return whether a file has the suffix of a recording, or of one whose recorder was killed."""
    return name.endswith(".bag.active") or PurePosixPath(name).suffix.lower() in SUFFIXES


def _looks_like_one(path: Path) -> bool:
    if _named_like_one(path.name):
        return True
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_MAGIC)
    except OSError:
        return True  # reported when it is opened
