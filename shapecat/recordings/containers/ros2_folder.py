"""Read ROS 2 bags in a folder: one or more SQLite or MCAP files, possibly compressed."""

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from heapq import merge
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import zstandard

from shapecat.errors import RecordingError
from shapecat.recordings.containers.mcap_file import McapRecording
from shapecat.recordings.containers.ros2_database import DatabaseRecording
from shapecat.recordings.messages import Channel, Message, Selection, sum_topics
from shapecat.recordings.recording import Recording
from shapecat.system.files import scratch_folder

__all__ = ["FolderRecording"]

_PARTS: dict[str, Callable[[Path], Recording]] = {
    ".mcap": McapRecording,
    ".db3": DatabaseRecording,
}


class FolderRecording(Recording):
    """A bag folder as ``ros2 bag record`` writes it, with or without metadata.yaml.

    The metadata is read only for the list of files. Topics, times and definitions come from the
    files themselves.
    """

    kind: ClassVar[str] = "ros2"

    def __init__(self, path: Path) -> None:
        """Open all files of the bag.

        Raises
        ------
        RecordingError : the folder holds no .mcap or .db3 file, or none of them can be read.
        """
        super().__init__(path)
        self._scratch: Path | None = None
        self._cleanup = ExitStack()
        self._parts: list[Recording] = []
        try:
            self._open_parts(self._list_files())
        except BaseException:
            self.close()
            raise
        # A file without messages has no times.
        self._parts.sort(key=lambda part: (part.end_ns == 0, part.start_ns, part.path.name))
        filled = [part for part in self._parts if part.end_ns]
        if filled:
            self.start_ns = min(part.start_ns for part in filled)
            self.end_ns = max(part.end_ns for part in filled)
        self._overlap = any(a.end_ns > b.start_ns for a, b in pairwise(filled))
        self.topics = sum_topics(topic for part in self._parts for topic in part.topics)
        self.indexed = all(part.indexed for part in self._parts)
        self._note()

    def _release(self) -> None:
        for part in self._parts:
            part.close()
        self._cleanup.close()

    def parts(self) -> list[Recording]:
        """Return one recording per file, sorted by start time."""
        return list(self._parts)

    def channels(self) -> tuple[Channel, ...]:
        """Return the channels of all files, without duplicates."""
        return tuple(dict.fromkeys(c for part in self._parts for c in part.channels()))

    def _read(self, selection: Selection) -> Iterator[Message]:
        streams = [part.messages(*selection) for part in self._parts]
        if self._overlap:
            yield from merge(*streams, key=lambda message: message.log_time_ns)
        else:
            for stream in streams:
                yield from stream
        self._note()

    def _list_files(self) -> list[Path]:
        """Return the files of the bag; warn about missing ones, and those not in metadata.yaml.

        Raises
        ------
        RecordingError : there is none.
        """
        files = [file for file in sorted(self.path.iterdir()) if file.is_file()]
        present = [file for file in files if _suffix(file) in _PARTS]
        in_metadata = self._listed_names()
        names = {file.name for file in present}
        missing = sorted(in_metadata - names)
        if missing:
            self.warn(f"parts named in metadata.yaml are missing: {', '.join(missing)}")
        originals = [f for f in present if f.suffix != ".zstd" or f.stem not in names]  # no copies
        chosen = [file for file in present if file.name in in_metadata] or originals
        used = {file.name.removesuffix(".zstd") for file in chosen}
        unnamed = [file.name for file in present if file.name.removesuffix(".zstd") not in used]
        if unnamed:
            self.warn(f"files that metadata.yaml does not name are not read: {', '.join(unnamed)}")
        if not chosen:
            msg = "a folder without .mcap or .db3 files"
            raise RecordingError(msg)
        if not in_metadata:
            self.warn("no metadata.yaml that names the parts: all files of the folder are read")
        return chosen

    def _listed_names(self) -> set[str]:
        """Return the file names under ``relative_file_paths`` of metadata.yaml, if it is readable.

        A regular expression is enough, since rosbag2 always writes the file in block style.
        """
        file = self.path / "metadata.yaml"
        try:
            text = file.read_text("utf-8") if file.stat().st_size < 1 << 24 else ""
        except (OSError, UnicodeDecodeError):
            return set()
        block = re.search(r"^ *relative_file_paths: *\n((?: *- .*\n?)+)", text, re.MULTILINE)
        lines = block[1].splitlines() if block else []
        return {Path(line.strip()[2:].strip().strip("'\"")).name for line in lines}

    def _open_parts(self, files: list[Path]) -> None:
        reasons = []
        for file in files:
            try:
                if not file.stat().st_size:  # a recorder leaves such a file on a full disk
                    msg = "is empty"
                    raise RecordingError(msg)  # noqa: TRY301  a reason like that of other parts
                plain = self._decompressed(file) if file.suffix == ".zstd" else file
                self._parts.append(_PARTS[_suffix(file)](plain))
            except RecordingError as error:
                reasons.append(f"{file.name}: {error}")
        if not self._parts:
            raise RecordingError("; ".join(reasons))
        for reason in reasons:
            self.warn(f"skipped {reason}")

    def _decompressed(self, file: Path) -> Path:
        """Decompress a file into a temporary folder; return its path there.

        Raises
        ------
        RecordingError : the file is damaged, or needs more than half of the free space.
        """
        if self._scratch is None:
            self._scratch = self._cleanup.enter_context(scratch_folder())
        plain = self._scratch / file.stem
        room = shutil.disk_usage(self._scratch).free // 2
        reader = zstandard.ZstdDecompressor()
        try:
            with file.open("rb") as source, plain.open("wb") as target:
                for block in reader.read_to_iter(source):
                    room -= target.write(block)
                    if room < 0:
                        msg = "not enough space in the temporary folder to decompress it"
                        raise RecordingError(msg)
        except zstandard.ZstdError as error:
            msg = f"damaged: {error}"
            raise RecordingError(msg) from error
        return plain

    def _note(self) -> None:
        for part in self._parts:
            for text in part.warnings:
                self.warn(f"{part.path.name}: {text}")


def _suffix(file: Path) -> str:
    """Return the suffix of a file, without ``.zstd``."""
    return Path(file.stem).suffix if file.suffix == ".zstd" else file.suffix
