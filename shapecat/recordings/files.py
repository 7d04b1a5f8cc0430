"""The files of a recording: a single file, or those of a ROS 2 bag in a folder."""

import os
from pathlib import Path

__all__ = ["input_files", "input_size", "is_of_bag", "write_ahead_log"]

_PARTS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_LOG = "-wal"
"""End of the name of the write-ahead log that a killed recorder leaves beside its database."""


def is_of_bag(name: str) -> bool:
    """Return whether a file with this name, in the folder of a ROS 2 bag, is part of the bag."""
    return name == "metadata.yaml" or name.removesuffix(_LOG).endswith(_PARTS)


def write_ahead_log(database: Path) -> Path | None:
    """Return the path of a database's write-ahead log; None if it is missing or empty."""
    log = database.with_name(f"{database.name}{_LOG}")
    there = os.path.isfile(log)  # noqa: PTH113  Path.is_file raises if the name is too long
    return log if there and log.stat().st_size else None


def input_files(path: Path) -> list[Path]:
    """Return the files of a recording.

    For a file, these are the file and its write-ahead log, if any; for the folder of a ROS 2 bag,
    its data and metadata, sorted. Empty logs are left out.
    """
    if not path.is_dir():
        log = write_ahead_log(path)
        return [path] if log is None else [path, log]
    files = [file for file in sorted(path.iterdir()) if is_of_bag(file.name) and file.is_file()]
    return [file for file in files if not file.name.endswith(_LOG) or file.stat().st_size]


def input_size(path: Path) -> int:
    """Return the size of a file, or of the ROS 2 bag in a folder, bytes."""
    return sum(file.stat().st_size for file in input_files(path))
