"""Open a recording with the reader for its format."""

from collections.abc import Callable
from pathlib import Path

from shapecat.errors import RecordingError, explained
from shapecat.recordings.containers.mcap_file import McapRecording
from shapecat.recordings.containers.ros1_bag import BagRecording
from shapecat.recordings.recording import Recording

__all__ = ["open_recording"]


def open_recording(path: Path) -> Recording:
    """Open an MCAP file, a ROS 1 bag, or a ROS 2 bag (a .db3 file or a folder).

    The first bytes of a file, not its name, determine its format.

    Raises
    ------
    RecordingError : the path does not exist or is not a readable recording.
    """
    path = Path(path)
    with explained(f"{path}: cannot be read", RecordingError):
        try:
            reader = _ros2 if path.is_dir() else _READERS[_sniff(path)]
            return reader(path)
        except RecordingError as error:
            msg = f"{path}: {error}"
            raise RecordingError(msg) from error


def _ros2(path: Path) -> Recording:
    # These load rosbags.
    from shapecat.recordings.containers.ros2_database import DatabaseRecording  # noqa: PLC0415
    from shapecat.recordings.containers.ros2_folder import FolderRecording  # noqa: PLC0415

    return FolderRecording(path) if path.is_dir() else DatabaseRecording(path)


_READERS: dict[str, Callable[[Path], Recording]] = {
    "\x89MCAP": McapRecording,
    "#ROSBAG": BagRecording,
    "SQLite format 3": _ros2,
}
"""Readers by the first bytes of a file."""

_PACKED = ("(\xb5/\xfd", "\x1f\x8b", "BZh", "\xfd7zXZ", "\x04\x22\x4d\x18", "PK\x03\x04")
"""First bytes of files compressed with zstd, gzip, bzip2, xz and lz4, and of zip archives."""
_EXPECTED = "expected an .mcap, .bag or .db3 file, or a ROS 2 bag folder"


def _sniff(path: Path) -> str:
    if not path.exists():
        msg = f"does not exist; {_EXPECTED}"
        raise RecordingError(msg)
    if not path.is_file():  # a named pipe: opening it would wait for its writer
        msg = f"is a pipe or a device; {_EXPECTED}"
        raise RecordingError(msg)
    with path.open("rb") as file:
        begin = file.read(16).decode("latin-1")
    for magic in _READERS:
        if begin.startswith(magic):
            return magic
    if begin.startswith(_PACKED):
        msg = f"a compressed file: unpack it first; {_EXPECTED}"
        raise RecordingError(msg)
    description = f"begins with {begin[:8]!r}" if begin else "is empty"
    msg = f"not a recording: {description}; {_EXPECTED}"
    raise RecordingError(msg)
