"""Find the recordings at a URL: in folders, by patterns, and by name."""

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from hashlib import sha256
from itertools import accumulate, compress
from operator import attrgetter
from pathlib import PurePosixPath
from typing import Any

from shapecat.batch.sources import (
    BAG_KEY,
    COMPRESSED_HINT,
    METADATA_BYTES,
    Source,
    has_recording_suffix,
    is_compressed,
    is_named_as_bag,
)
from shapecat.batch.storage import Location, content_key, names_in, without_query
from shapecat.errors import RecordingError

__all__ = ["search_url", "search_url_beside_others", "stat_url"]

_log = logging.getLogger(__name__)

_THREADS = 16
"""Threads that read metadata, since each request waits for an answer over the network."""


def _of_url(url: str, key: str = "", size: int = 0) -> Source:
    parent, name = names_in(url)
    stem = PurePosixPath(name).stem if has_recording_suffix(name) else name
    return Source("", url, stem, parent, key, size)


def search_url(url: str) -> list[Source]:
    """Return the matches of a URL pattern, the recordings below a URL folder, or the URL itself.

    Raises
    ------
    RecordingError : the storage cannot be reached.
    ConfigError : a library is not installed.
    """
    location = Location(url)
    if any(character in without_query(url) for character in "*["):  # signed URLs have queries
        found = list(_search_matches(location))
        if found or location.info() is None:  # otherwise a name with brackets
            return sorted(found, key=attrgetter("url"))
    if url.endswith("/") or _is_remote_folder(location):
        return sorted(_search_remote_folder(location), key=attrgetter("url"))
    return [_of_url(url)]


def _search_matches(pattern: Location) -> Iterator[Source]:
    """Yield the recordings that match a pattern, and those below folders that match it."""
    matches = dict(pattern.matches())
    folders = {url for url, info in matches.items() if info.get("type") == "directory"}
    for url, info in matches.items():
        if not folders.isdisjoint(accumulate(url.split("/")[:-1], "{}/{}".format)):
            continue  # the search of that folder finds it
        if url not in folders and has_recording_suffix(url):
            yield _of_url(url, content_key(info), _size(info))
        elif url in folders and not PurePosixPath(url).name.startswith("."):
            yield from _search_remote_folder(Location(url))


def search_url_beside_others(url: str) -> list[Source]:
    """Return the recordings at a URL that is one of several sources.

    A URL where nothing exists is returned as a recording, and fails when it is opened, like a
    missing file. A folder without recordings is logged.

    Raises
    ------
    RecordingError : the storage cannot be reached.
    ConfigError : a library is not installed.
    """
    found = search_url(url)
    if found or next(Location(url).walk(deep=False), None) is None:
        return found or [_of_url(url)]
    _log.error("%s: no recording found", url)
    return []


def _is_remote_folder(location: Location) -> bool:
    """Return whether a URL is a folder; no request is made if it has the suffix of a recording."""
    if has_recording_suffix(without_query(location.url)):
        return False
    with suppress(RecordingError):  # reported when it is downloaded
        return (location.info() or {}).get("type") == "directory"
    return False


def stat_url(url: str) -> tuple[str, int]:
    """Return a key of the content at a URL, and its size in bytes; empty and 0 if unknown."""
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
    """Yield the recordings and ROS 2 bag folders below a folder.

    Hidden files, hidden folders and run folders are left out; compressed files are logged.
    """
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
        elif has_recording_suffix(name) or is_compressed(name):
            files.append(_of_url(url, content_key(info), _size(info)))
    names = defaultdict[str, list[str]](list)
    for parent, _, name in (file.url.rpartition("/") for file in files):
        names[parent].append(name)
    bags = {url for url, held in names.items() if is_named_as_bag(PurePosixPath(url).name, held)}
    bags |= set(_bags_among((described & names.keys()) - bags))
    parts: dict[str, list[Source]] = {bag: [] for bag in bags}
    for file in files:
        parent = file.url.rpartition("/")[0]
        if parent in parts:
            parts[parent].append(file)
        elif parent not in runs and is_compressed(file.url):
            _log.error("%s: %s", file.url, COMPRESSED_HINT)
        elif parent not in runs:
            yield file
    for bag, found in parts.items():
        yield _of_url(bag, _combined_key(f.key for f in found), sum(f.bytes for f in found))


def _bags_among(folders: Iterable[str]) -> list[str]:
    """Return the folders (URLs) that hold the metadata.yaml of a ROS 2 bag, sorted."""

    def is_bag(folder: str) -> bool:
        return BAG_KEY in ((Location(folder) / "metadata.yaml").read() or b"")[:METADATA_BYTES]

    ordered = sorted(folders)
    with ThreadPoolExecutor(_THREADS) as pool:
        return list(compress(ordered, pool.map(is_bag, ordered)))
