"""Read and write segments: finished parts of the tables, which survive a kill of the run.

A segment is a folder that appears when it is complete and never changes. Tables can be joined from
segments again and again, so a kill while they are joined does no harm.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from math import isqrt
from pathlib import Path

import pyarrow as pa

from shapecat.errors import OutputError
from shapecat.runs.tables.reading import Key, frame_rows, numbers
from shapecat.runs.tables.schemas import PERCEIVED

__all__ = [
    "GROUP_FRAMES",
    "REVISIONS",
    "SEGMENTS",
    "discard_segments",
    "group_frames",
    "list_segments",
    "read_segment",
    "read_segments",
    "require_complete",
    "row_groups",
    "write_segment",
]

GROUP_FRAMES = 32
"""Minimum number of frames in a row group, except for the last."""
_BALANCE = 4096
"""In a table of n frames, row groups have isqrt(n // `_BALANCE`) × `GROUP_FRAMES` frames, but at
least `GROUP_FRAMES`."""
SEGMENTS, REVISIONS = "segments", "revisions"
"""Folders with the segments of *perceive* and *revise*, in the folder of the run."""


def discard_segments(folder: Path) -> None:
    """Remove all segments; call this after they have been joined."""
    for name in (SEGMENTS, REVISIONS):
        shutil.rmtree(folder / name, ignore_errors=True)


def read_segments(folder: Path) -> Iterator[tuple[pa.Table, pa.Table]]:
    """Yield the frames and planes tables of the phase *perceive*, segment by segment.

    Raises
    ------
    OutputError : a segment is unreadable.
    """
    for segment in list_segments(folder / SEGMENTS):
        yield read_segment(segment, "frames"), read_segment(segment, "planes")


def list_segments(place: Path) -> list[Path]:
    """Return the complete segments in a folder, in the order in which they were written."""
    return sorted(place.glob("[0-9]*"))


_Tables = dict[str, pa.Table]
"""The tables of perceive, or parts of them for the same frames, by name."""


def _read_tables(segment: Path) -> _Tables:
    names = [name for name in PERCEIVED if _part(segment, name).exists()]
    return {name: read_segment(segment, name) for name in names}


def _latest(folder: Path) -> Iterator[_Tables]:
    """Yield the tables of each segment of *perceive*.

    Results of *revise* replace those of *perceive*.
    """
    places = {
        key: segment
        for segment in list_segments(folder / REVISIONS)
        for key in _revised(read_segment(segment, "frames"))
    }
    read = lru_cache(maxsize=2)(_read_tables)  # both are in the order of the recording
    for segment in list_segments(folder / SEGMENTS):
        first = _read_tables(segment)
        keys = list(frame_rows(first["frames"]))
        if places.keys().isdisjoint(keys):
            yield first
        else:
            sources = [read(places[key]) if key in places else first for key in keys]
            yield {name: _picked(name, keys, sources) for name in first}


def _revised(frames: pa.Table) -> Iterator[Key]:
    """Yield the frames in which *revise* found a plane or an object.

    Their results replace those of *perceive*.
    """
    is_revised = numbers(frames["revised"].cast(pa.int8()))
    return (key for key, revised in zip(frame_rows(frames), is_revised, strict=True) if revised)


def _picked(name: str, keys: Sequence[Key], sources: Sequence[_Tables]) -> pa.Table:
    """Return the rows of some frames in the table ``name``.

    The rows of the frame ``keys[k]`` are taken from ``sources[k]``.
    """
    rows = {id(tables): frame_rows(tables[name]) for tables in sources}
    chosen = [
        (tables[name], rows[id(tables)].get(key, slice(0, 0)))
        for key, tables in zip(keys, sources, strict=True)
    ]
    return pa.concat_tables(table[of] for table, of in chosen)


def group_frames(frames: int) -> int:
    """Return the number of frames per row group, for a table of ``frames`` frames.

    A reader holds one row group in memory, and 30 kB of metadata for every row group. So both the
    length and the number of row groups grow with the square root of the number of frames.
    """
    return GROUP_FRAMES * max(1, isqrt(frames // _BALANCE))


def row_groups(folder: Path, length: int) -> Iterator[_Tables]:
    """Yield the joined tables in row groups of ``length`` frames; the last one may be shorter."""
    pending: _Tables = {}
    for new in _latest(folder):
        pending = (
            {name: pa.concat_tables([pending[name], new[name]]) for name in new} if pending else new
        )
        while pending["frames"].num_rows >= length:
            group, pending = _cut(pending, length)
            yield group
    if pending and pending["frames"].num_rows:
        yield pending


def _cut(tables: _Tables, count: int) -> tuple[_Tables, _Tables]:
    """Split tables after ``count`` frames."""
    first = set(frame_rows(tables["frames"][:count]))
    ends = {"frames": count}
    for name in tables.keys() - ends.keys():
        rows = frame_rows(tables[name])
        ends[name] = max((rows[key].stop for key in first & set(rows)), default=0)
    return (
        {name: tables[name][:end].combine_chunks() for name, end in ends.items()},
        {name: tables[name][end:] for name, end in ends.items()},
    )


def write_segment(segment: Path, name: str, table: pa.Table) -> None:
    """Write a segment's part of the table ``name``, uncompressed since it is soon read again."""
    with (
        pa.OSFile(str(_part(segment, name)), "wb") as sink,
        pa.ipc.new_file(sink, table.schema) as writer,
    ):
        writer.write_table(table)


def read_segment(segment: Path, name: str) -> pa.Table:
    """Read a segment's part of the table ``name``.

    Raises
    ------
    OutputError : the file is unreadable.
    """
    with _opened(_part(segment, name)) as reader:
        return reader.read_all()


def require_complete(folder: Path) -> None:
    """Check that all segments of an interrupted run can be opened; their rows are not read.

    Raises
    ------
    OutputError : a file is unreadable.
    """
    for name in (SEGMENTS, REVISIONS):
        for part in (folder / name).glob("[0-9]*/*"):
            with _opened(part):
                pass


@contextmanager
def _opened(path: Path) -> Iterator[pa.ipc.RecordBatchFileReader]:
    try:
        with pa.OSFile(str(path), "rb") as source, pa.ipc.open_file(source) as reader:
            yield reader
    except (OSError, pa.ArrowException) as error:
        msg = f"{path}: unreadable, left by a killed run ({error})"
        raise OutputError(msg) from error


def _part(segment: Path, name: str) -> Path:
    return segment / f"{name}.arrow"
