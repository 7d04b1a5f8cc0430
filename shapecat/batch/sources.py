"""Names of files and folders: which are recordings, and which are the parts of a bag."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

from shapecat.recordings.files import is_of_bag

__all__ = [
    "BAG_KEY",
    "COMPRESSED_HINT",
    "METADATA_BYTES",
    "Source",
    "has_recording_suffix",
    "is_compressed",
    "is_named_as_bag",
    "parts_among",
    "recordings_among",
]

_SUFFIXES = {".mcap", ".bag", ".db3"}
_COMPRESSED = {".zst", ".zstd", ".gz", ".bz2", ".xz", ".lz4", ".zip"}
COMPRESSED_HINT = "skipped: a compressed file, unpack it first"
BAG_KEY = b"rosbag2_bagfile_information:"
"""The first line of a bag's metadata.yaml; other data sets have files of this name, too."""
METADATA_BYTES = 1 << 12
"""Number of bytes of a metadata.yaml that are searched for this line."""


@dataclass(frozen=True, slots=True)
class Source:
    """A recording at a path or a URL; the field that does not apply is empty.

    ``stem`` is its name without suffix and ``parent`` the name of its folder; both serve to name
    the run folder. ``key`` changes with the content, and ``bytes`` is the size; they are empty and
    0 if they are unknown, and for a path until it is planned.
    """

    path: str
    url: str
    stem: str
    parent: str
    key: str = ""
    bytes: int = 0

    @property
    def recording(self) -> str:
        """The path or URL of the recording."""
        return self.url or self.path


def has_recording_suffix(name: str) -> bool:
    """Return whether a file ends in .mcap, .bag, .db3, or .bag.active (its recorder was killed)."""
    return name.endswith(".bag.active") or PurePosixPath(name).suffix.lower() in _SUFFIXES


def is_compressed(name: str) -> bool:
    """Return whether a path or URL ends like a compressed recording."""
    path = PurePosixPath(name)
    return path.suffix.lower() in _COMPRESSED and has_recording_suffix(path.stem)


def is_named_as_bag(folder: str, names: Collection[str]) -> bool:
    """Return whether the names of a folder and of its files suffice to call it a ROS 2 bag.

    The files must be numbered parts, and have the name of the folder unless one is compressed.
    """
    parts = parts_among(names)
    any_compressed = any(name.endswith(".zstd") for name in names)
    return bool(parts) and (any_compressed or parts[0].rpartition("_")[0] == folder)


def recordings_among(names: Iterable[str]) -> set[str]:
    """Return the names that are recordings; the suffix .zstd of compressed ones is removed."""
    uncompressed = {name.removesuffix(".zstd") for name in names}
    return {name for name in uncompressed if PurePosixPath(name).suffix in _SUFFIXES}


def parts_among(names: Iterable[str]) -> list[str]:
    """Return the recordings in order if they are named a_0.mcap, a_1.mcap, ...; else none."""
    recordings = recordings_among(names)
    first = PurePosixPath(min(recordings, default=""))
    base = first.stem.rpartition("_")[0]
    parts = [f"{base}_{k}{first.suffix}" for k in range(len(recordings))]
    return parts if is_of_bag(first.name) and recordings == set(parts) else []
