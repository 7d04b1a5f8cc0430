"""Find the recordings that a user names: files, folders, URLs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from shapecat.batch.remote import is_url, list_urls
from shapecat.errors import RecordingError

__all__ = ["Found", "Source", "find_recordings"]

SUFFIXES = {".mcap", ".bag", ".db3"}
_OTHERS = (".mcap", ".bag")
_MAGIC = (b"\x89MCAP", b"#ROSBAG", b"SQLite format 3")


@dataclass(frozen=True)
class Source:
    """A recording: a path, or a URL; ``stem`` and ``parent`` name its run folder."""

    path: str
    url: str
    stem: str
    parent: str


@dataclass(frozen=True)
class Found:
    """The recordings, each once, and how many files were left out."""

    kept: list[Source]
    left_out: int


def find_recordings(sources: Sequence[str]) -> Found:
    """Return the recordings among files, folders and URLs.

    Folders are searched, other than ROS 2 bags; run folders and hidden ones are not. A file given
    by itself is always kept; among several, one that neither is named nor begins like a recording
    is left out, so that ``folder/*`` does what is meant.

    Raises
    ------
    RecordingError : there is none.
    """
    urls = [url for source in sources if is_url(source) for url in list_urls(source, SUFFIXES)]
    paths, left_out = _find_paths([Path(source) for source in sources if not is_url(source)])
    kept = [_of_path(path) for path in paths] + [_of_url(url) for url in dict.fromkeys(urls)]
    if not kept:
        msg = f"{' '.join(sources[:3])}: no recording there: no .mcap, .bag or .db3, no ROS 2 bag"
        raise RecordingError(msg)
    return Found(kept, left_out)


def _of_path(path: Path) -> Source:
    whole = path.resolve()
    return Source(str(path), "", whole.name if path.is_dir() else path.stem, whole.parent.name)


def _of_url(url: str) -> Source:
    pure = PurePosixPath(url.partition("://")[2].partition("?")[0])
    return Source("", url, pure.stem, pure.parent.name)


def _find_paths(sources: Sequence[Path]) -> tuple[list[Path], int]:
    if len(sources) == 1 and not _searchable(sources[0]):
        return list(sources), 0
    found: dict[Path, Path] = {}
    left: set[Path] = set()
    for source in sources:
        for path in _search(source) if _searchable(source) else [source]:
            if path.is_file() and not _looks_like_one(path):
                left.add(path.resolve())
            else:
                found.setdefault(path.resolve(), path)
    bags = {whole for whole, path in found.items() if path.is_dir()}
    kept = [path for whole, path in found.items() if whole.parent not in bags]
    return kept, sum(path.parent not in bags for path in left)


def _searchable(path: Path) -> bool:
    return path.is_dir() and not _is_bag(path)


def _is_bag(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag: with metadata, or with nothing but its parts."""
    if (folder / "metadata.yaml").exists():
        return True
    paths = list(folder.iterdir())
    names = {path.name.removesuffix(".zstd") for path in paths if path.is_file()}
    if any(path.is_dir() for path in paths):
        return False
    others = {name for name in names if name.endswith(_OTHERS)}
    return _are_splits(others) or (any(n.endswith(".db3") for n in names) and not others)


def _are_splits(names: set[str]) -> bool:
    """Return whether files are the numbered parts of one recording: a_0.mcap, a_1.mcap, ..."""
    base = min(names, default="").rpartition("_")[0]
    return len(names) > 1 and names == {f"{base}_{k}.mcap" for k in range(len(names))}


def _search(folder: Path) -> Iterator[Path]:
    """Yield the recordings below a folder, by name."""
    if (folder / "run.json").exists():
        return
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if _searchable(path):
            yield from _search(path)
        elif path.is_dir() or path.suffix in SUFFIXES:
            yield path


def _looks_like_one(path: Path) -> bool:
    if path.suffix in SUFFIXES:
        return True
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_MAGIC)
    except OSError:
        return True  # reported when it is opened
