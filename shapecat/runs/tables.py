"""The Parquet tables between the phases: their columns, and how to read and write them.

A run folder holds ``frames``, ``detections``, ``planes`` and, with colour images, ``masks``
(written by perceive), and ``tracks`` (written by track). Row groups of all but ``tracks`` cover the
same frames, so that they can be read side by side in constant memory. Adding a column is allowed
within a schema version; changing the meaning of one is not.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import F4, I4
from shapecat.errors import OutputError

__all__ = [
    "BOX_WIDTH",
    "DETECTIONS",
    "FRAMES",
    "FRAME_COLUMNS",
    "FULL_BOX",
    "FULL_WIDTHS",
    "PLANES",
    "SCHEMA_VERSION",
    "TRACKS",
    "Key",
    "arrow_table",
    "count_rows",
    "first_stamp",
    "frame_rows",
    "full_boxes_of",
    "keys_of",
    "numbers",
    "numbers_or_nan",
    "open_writer",
    "opened",
    "read_row_groups",
    "read_together",
    "rows_as_lists",
    "rows_of",
    "topic_codes",
    "write_table",
]

# Arrow's own allocator holds 50 MB more while a long recording is read, and takes longer.
pa.set_memory_pool(pa.system_memory_pool())

SCHEMA_VERSION = "1"

_VEC3 = pa.list_(pa.float32(), 3)
_POSITION = pa.list_(pa.float64(), 3)
"""A position in the fixed frame, whose origin may be thousands of kilometres away."""
_QUATERNION = pa.list_(pa.float32(), 4)
_FLOATS = pa.list_(pa.float32())
_FULL = (
    ("center_full", _VEC3),
    ("size_full", _VEC3),
    ("orientation_full", _QUATERNION),
    ("size_full_std", _VEC3),
)

FULL_WIDTHS = {name: kind.list_size for name, kind in _FULL}
"""Columns of full boxes, and the number of values in each."""
FULL_BOX = ("center_full", "size_full", "orientation_full")
"""Columns of the box itself: centre and size in metres, and a quaternion, in the sensor frame."""
BOX_WIDTH = sum(FULL_WIDTHS[name] for name in FULL_BOX)
FRAME_COLUMNS = (("topic", pa.string()), ("frame", pa.int32()), ("stamp_ns", pa.int64()))
"""Columns that identify a frame: topic, number on that topic, and stamp."""

FRAMES = pa.schema(
    [
        *FRAME_COLUMNS,
        ("log_time_ns", pa.int64()),
        ("frame_id", pa.string()),
        ("up", _VEC3),
        ("up_given", _VEC3),
        ("revised", pa.bool_()),
        ("reused_from", pa.int32()),
        ("fixed_translation", _POSITION),
        ("fixed_rotation", pa.list_(pa.float64(), 9)),
        ("stages", pa.list_(pa.string())),
        ("seconds", _FLOATS),
    ]
)
"""One row per frame read, also without detections. ``up`` is the up direction that detection used;
``up_given`` is from transforms, an IMU or an option, null without these. ``revised`` is true if
the result is from a second look, with the up direction of the whole recording. ``reused_from`` is
the earlier frame whose scene this one repeats, null if none. ``fixed_*`` is ``fixed_from_sensor``
(rotation row by row), null if unknown. ``seconds`` has one entry per entry of ``stages``."""

DETECTIONS = pa.schema(
    [
        *FRAME_COLUMNS,
        ("frame_id", pa.string()),
        ("detection", pa.int32()),
        ("plane", pa.int16()),
        ("on_detection", pa.int32()),
        ("touches_border", pa.bool_()),
        ("occluded", pa.bool_()),
        ("center", _VEC3),
        ("size", _VEC3),
        ("orientation", _QUATERNION),
        ("center_fixed", _POSITION),
        *_FULL,
        ("outline_full", _FLOATS),
        ("height_m", pa.float32()),
        ("points", pa.int32()),
        ("indices", pa.list_(pa.uint32())),
        ("posterior", _FLOATS),
        ("category", pa.string()),
        ("confidence", pa.float32()),
        ("novelty", pa.float32()),
        ("reused_from", pa.int32()),
        ("descriptor", _FLOATS),
        ("neurons", _FLOATS),
        ("edges", pa.list_(pa.uint16())),
        ("seconds", pa.float32()),
    ]
)
"""One row per object per frame; lengths in metres, ``center`` and ``neurons`` in ``frame_id``.
``*_full`` is the box of the whole object, null if only the visible part is known. The columns
``posterior`` to ``edges`` are copied from the frame ``reused_from``, unless that is null."""

PLANES = pa.schema(
    [
        *FRAME_COLUMNS,
        ("plane", pa.int16()),
        ("normal", _VEC3),
        ("offset", pa.float32()),
        ("height_m", pa.float32()),
        ("area_m2", pa.float32()),
        ("outline", _FLOATS),
    ]
)
"""One row per supporting plane per frame; ``outline`` is x, y, z of each corner in turn."""

TRACKS = pa.schema(
    [
        ("track", pa.int32()),
        *FRAME_COLUMNS,
        ("detection", pa.int32()),
        ("center_fixed", _POSITION),
        *_FULL,
        ("posterior", _FLOATS),
    ]
)
"""One row per track per frame; ``detection`` is null while the track coasts; ``posterior`` is
causal. ``center_fixed`` is in the fixed frame, or the sensor frame if there is none.
``center_full`` and ``orientation_full`` are in the sensor frame, null while the track coasts."""

Key = tuple[str, int]
"""A frame: its topic, and its number on that topic."""


def count_rows(folder: Path, table: str) -> int:
    """Return the number of rows of a table in a run folder.

    Raises
    ------
    OutputError : the table is missing or unreadable.
    """
    with opened(folder / f"{table}.parquet") as file:
        return int(file.metadata.num_rows)


def first_stamp(folder: Path) -> int:
    """Return the earliest stamp of the frames of a run, ns; 0 without frames.

    It need not be that of the first row: frames are in the order in which they were recorded.
    """
    groups = read_row_groups(folder / "frames.parquet", ["stamp_ns"])
    return min((int(numbers(group["stamp_ns"]).min()) for group in groups if len(group)), default=0)


def write_table(path: Path, columns: dict[str, Any], schema: pa.Schema) -> None:
    """Write a table as one row group."""
    writer = open_writer(path, schema)
    with writer:
        writer.write_table(arrow_table(columns, schema))


def read_row_groups(
    path: Path, columns: Sequence[str] | None = None, *, at_once: int = 1
) -> Iterator[pa.Table]:
    """Yield the row groups of a table of a run folder, ``at_once`` at a time.

    Raises
    ------
    OutputError : the table is missing or unreadable.
    """
    with opened(path) as file:
        count = file.num_row_groups
        for first in range(0, count, at_once):
            yield file.read_row_groups(
                range(first, min(first + at_once, count)), columns=columns, use_threads=False
            )


def read_together(
    folder: Path, columns: Mapping[str, Sequence[str] | None], *, at_once: int = 1
) -> Iterator[tuple[pa.Table, ...]]:
    """Yield the row groups of the same frames from several tables of a run folder.

    ``columns`` are those to read of each table, by its name; None for all.

    Raises
    ------
    OutputError : a table is missing or unreadable.
    """
    groups = (
        read_row_groups(folder / f"{name}.parquet", wanted, at_once=at_once)
        for name, wanted in columns.items()
    )
    return zip(*groups, strict=True)


def keys_of(table: pa.Table) -> list[Key]:
    """Return the topic and frame of each row."""
    return list(zip(table["topic"].to_pylist(), table["frame"].to_pylist(), strict=True))


def frame_rows(table: pa.Table) -> dict[Key, slice]:
    """Return the slice of rows of each frame of a table; the rows of a frame are consecutive."""
    return rows_of(*topic_codes(table), numbers(table["frame"]))


def topic_codes(table: pa.Table) -> tuple[list[str], I4]:
    """Return the topics in a table, and the index of each row's topic, (rows,)."""
    column = table["topic"].combine_chunks().dictionary_encode()
    return column.dictionary.to_pylist(), np.from_dlpack(column.indices)


def rows_of(topics: Sequence[str], codes: I4, frames: I4) -> dict[Key, slice]:
    """Return the slice of rows of each frame; the rows of a frame are consecutive.

    Parameters
    ----------
    codes : (rows,) index of each row's topic.
    frames : (rows,) number of each row's frame.
    """
    changes = (np.diff(codes) != 0) | (np.diff(frames) != 0)
    starts = np.flatnonzero(np.concatenate([np.ones(min(1, len(frames)), np.bool_), changes]))
    names = map(topics.__getitem__, codes[starts].tolist())
    stops = [*starts[1:].tolist(), len(frames)]
    rows = map(slice, starts.tolist(), stops)
    return dict(zip(zip(names, frames[starts].tolist(), strict=True), rows, strict=True))


def numbers(column: pa.ChunkedArray) -> Any:
    """Return a column without nulls as a flat array; lists are concatenated.

    Arrow's own conversion loads pandas, which takes a third of a second.
    """
    array = column.combine_chunks()
    return np.from_dlpack(array if pa.types.is_primitive(array.type) else array.flatten())


def numbers_or_nan(column: pa.ChunkedArray) -> Any:
    """Return a column of lists of fixed size as an array (rows, size); null becomes NaN."""
    width, kind = column.type.list_size, column.type.value_type.to_pandas_dtype()
    result = np.full((len(column), width), np.nan, kind)
    known = pa.compute.is_valid(column).to_numpy()
    if known.any():
        result[known] = numbers(column.drop_null()).reshape(-1, width)
    return result


def full_boxes_of(table: pa.Table) -> F4:
    """Return the columns `FULL_BOX` as one array (rows, `BOX_WIDTH`); NaN if unknown."""
    return np.hstack([numbers_or_nan(table[name]) for name in FULL_BOX])


@contextmanager
def opened(path: Path, *, read_dictionary: Sequence[str] = ()) -> Iterator[pq.ParquetFile]:
    """Open a table of a run folder; the columns ``read_dictionary`` are read as dictionaries.

    Raises
    ------
    OutputError : the table is missing or unreadable.
    """
    try:
        with pq.ParquetFile(path, read_dictionary=list(read_dictionary)) as file:
            yield file
    except (OSError, pa.ArrowException) as error:
        msg = f"{path}: not a readable table of a run folder ({error}); process the recording again"
        raise OutputError(msg) from error


def open_writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    """Open a table for writing row groups."""
    # Ascending pixel indices shrink tenfold as differences; a dictionary does not help floats.
    texts = [f.name for f in schema if f.type == pa.string()]
    deltas = {f"{n}.list.element": "DELTA_BINARY_PACKED" for n in ("indices",) if n in schema.names}
    return pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        use_dictionary=texts,
        column_encoding=deltas or None,
        # The statistics of all columns of a long recording take ten megabytes to read.
        write_statistics=[n for n in ("topic", "frame", "stamp_ns", "track") if n in schema.names],
    )


def arrow_table(columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
    """Make a table with the given schema from columns by name."""
    arrays = [
        column if isinstance(column, pa.Array) else pa.array(column, field.type)
        for field, column in ((field, columns[field.name]) for field in schema)
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def lists(rows: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Return rows of numbers, which may differ in length, as a list column of type ``kind``."""
    flat = [np.ravel(row) for row in rows]
    offsets = np.concatenate([[0], np.cumsum([row.size for row in flat])]).astype(np.int32)
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(offsets, pa.array(values.astype(kind.to_pandas_dtype())))


def rows_as_lists(values: F4) -> pa.Array:
    """Return the rows of an array (n, c) as a list column of float32."""
    offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
    return pa.ListArray.from_arrays(offsets, pa.array(values.astype(np.float32).ravel()))
