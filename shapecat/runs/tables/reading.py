"""Read the Parquet tables of a run folder.

The row groups of all tables but ``tracks`` cover the same frames, so that these tables can be read
side by side in constant memory. A table that is missing or unreadable raises an `OutputError`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import F4, I4, Bool
from shapecat.errors import OutputError
from shapecat.runs.tables.schemas import FIXED_LISTS, FULL_BOX, TABLES

__all__ = [
    "PROCESS_AGAIN",
    "Key",
    "count_rows",
    "first_stamp",
    "frame_rows",
    "full_boxes_of",
    "keys_of",
    "misfit",
    "numbers",
    "numbers_or_nan",
    "opened",
    "partial_of",
    "read_by_topic",
    "read_row_groups",
    "read_rows",
    "read_stamps",
    "read_together",
    "rows_of",
    "topic_codes",
    "with_fixed_lists",
]

PROCESS_AGAIN = "process the recording again"
"""The remedy in the messages about unreadable tables."""
_NUMBERS = {"center", "size", "orientation", "posterior", *FULL_BOX}
"""Columns whose numbers must be finite."""
_TUPLES = {"edges": 2, "neurons": 3, "outline": 3}
"""Columns with flat lists of items, and the number of values per item."""

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
    """Return the earliest stamp of the frames of a run, ns; 0 if there are none.

    It need not be that of the first frame, since frames are in the order of recording.
    """
    groups = read_row_groups(folder / "frames.parquet", ["stamp_ns"])
    return min((int(numbers(group["stamp_ns"]).min()) for group in groups if len(group)), default=0)


def read_stamps(folder: Path) -> Iterator[tuple[Key, int]]:
    """Yield each frame of a run and its stamp in nanoseconds, in the order of the frames table."""
    for group in read_row_groups(folder / "frames.parquet", ["topic", "frame", "stamp_ns"]):
        yield from zip(keys_of(group), numbers(group["stamp_ns"]).tolist(), strict=True)


def read_by_topic(
    folder: Path, columns: Sequence[str], values: Callable[[pa.Table], Any]
) -> dict[str, Any]:
    """Compute values from the frames table; return an array per topic, in the order of its frames.

    Parameters
    ----------
    columns : the columns to read.
    values : function of a table with these columns; returns an array with an item for each row.
    """
    parts: dict[str, list[Any]] = {}
    for group in read_row_groups(folder / "frames.parquet", ["topic", *columns]):
        topics, codes = topic_codes(group)
        rows = values(group)
        for code, topic in enumerate(topics):
            parts.setdefault(topic, []).append(rows[codes == code])
    return {topic: np.concatenate(arrays) for topic, arrays in parts.items()}


def read_row_groups(
    path: Path, columns: Sequence[str] | None = None, *, at_once: int = 1
) -> Iterator[pa.Table]:
    """Yield the row groups of a table of a run folder, ``at_once`` at a time.

    ``columns`` are the columns to read; None for all.

    Raises
    ------
    OutputError : the table is missing or unreadable, or holds values that no run writes.
    """
    with opened(path, columns=columns) as file:
        count = file.num_row_groups
        for first in range(0, count, at_once):
            groups = range(first, min(first + at_once, count))
            table = file.read_row_groups(groups, columns=columns, use_threads=False)
            yield _validated(table)


def read_rows(
    file: pq.ParquetFile, columns: Sequence[str], rows: I4, *, at_once: int = 1
) -> Iterator[tuple[I4, pa.Table]]:
    """Yield some rows of an open table, from at most ``at_once`` row groups at a time.

    Parameters
    ----------
    rows : (n,) numbers of the rows, in any order.

    Yields
    ------
    Indices (k,) into ``rows``, and a table of the rows at these indices.
    """
    sizes = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    starts, rows = np.cumsum([0, *sizes]), rows.astype(np.int64)
    order = np.argsort(rows, kind="stable")
    bounds = np.searchsorted(rows[order], starts)
    groups = np.flatnonzero(np.diff(bounds))
    for k in range(0, len(groups), at_once):
        batch = groups[k : k + at_once]
        at = np.concatenate([order[bounds[g] : bounds[g + 1]] for g in batch])
        skipped = starts[batch] - np.cumsum([0, *np.diff(starts)[batch[:-1]]])
        table = _validated(file.read_row_groups(batch.tolist(), list(columns), use_threads=False))
        yield at, table.take(pa.array(rows[at] - np.repeat(skipped, np.diff(bounds)[batch])))


def read_together(
    folder: Path, columns: Mapping[str, Sequence[str] | None], *, at_once: int = 1
) -> Iterator[tuple[pa.Table, ...]]:
    """Yield the row groups of the same frames from several tables of a run folder.

    ``columns`` maps the names of the tables to the columns to read; None for all columns.
    ``at_once`` is as in `read_row_groups`.

    Raises
    ------
    OutputError : a table is missing or unreadable, or their row groups differ in number.
    """
    groups = (
        read_row_groups(folder / f"{name}.parquet", wanted, at_once=at_once)
        for name, wanted in columns.items()
    )
    try:
        yield from zip(*groups, strict=True)
    except ValueError as error:  # of zip
        names = ", ".join(columns)
        msg = f"{folder}: {names} have different row groups; {PROCESS_AGAIN}"
        raise OutputError(msg) from error


def misfit(folder: Path) -> OutputError:
    """Return the error for tables of a run whose rows refer to missing rows of other tables."""
    problem = "its tables are inconsistent, as if from different runs"
    msg = f"{folder}: {problem}; {PROCESS_AGAIN}"
    return OutputError(msg)


def keys_of(table: pa.Table) -> list[Key]:
    """Return the topic and frame of each row."""
    return list(zip(table["topic"].to_pylist(), table["frame"].to_pylist(), strict=True))


def frame_rows(table: pa.Table) -> dict[Key, slice]:
    """Return the slice of rows of each frame of a table; the rows of a frame are consecutive."""
    return rows_of(*topic_codes(table), numbers(table["frame"]))


def topic_codes(table: pa.Table) -> tuple[list[str], I4]:
    """Return the topics in a table, and for each row the index of its topic, (rows,)."""
    column = table["topic"].combine_chunks().dictionary_encode()
    codes: I4 = column.indices.to_numpy()
    return column.dictionary.to_pylist(), codes


def rows_of(topics: Sequence[str], codes: I4, frames: I4) -> dict[Key, slice]:
    """Return the slice of rows of each frame; the rows of a frame are consecutive.

    Parameters
    ----------
    codes : (rows,) index in ``topics`` of the topic of each row.
    frames : (rows,) frame number of each row.
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
    valid = column.is_valid().to_numpy()
    if valid.any():
        result[valid] = numbers(column.drop_null()).reshape(-1, width)
    return result


def full_boxes_of(table: pa.Table) -> F4:
    """Return the columns `FULL_BOX` as one array (rows, `BOX_WIDTH`); NaN if unknown."""
    return np.hstack([numbers_or_nan(table[name]) for name in FULL_BOX])


def partial_of(table: pa.Table) -> Bool:
    """Return whether each detection is occluded or cut off by the image border, (rows,)."""
    cut_off, occluded = (table[name].to_numpy() for name in ("touches_border", "occluded"))
    return np.asarray(cut_off | occluded)


@contextmanager
def opened(
    path: Path, *, columns: Sequence[str] | None = None, read_dictionary: Sequence[str] = ()
) -> Iterator[pq.ParquetFile]:
    """Open a table of a run folder.

    Parameters
    ----------
    columns : the columns to check; by default all of the table's schema.
    read_dictionary : columns that stay dictionary-encoded.

    Raises
    ------
    OutputError : the table is missing or unreadable, even if only the block notices it, or a column
        is missing or has the wrong type.
    """
    try:
        with _open_parquet(path, read_dictionary) as file:
            if wrong := _wrong_column(file.schema_arrow, TABLES[path.stem], columns):
                msg = f"{path}: {wrong}; {PROCESS_AGAIN} with --overwrite, which keeps labels"
                raise OutputError(msg)
            yield file
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        msg = f"{path}: not a readable table of a run folder ({error}); {PROCESS_AGAIN}"
        raise OutputError(msg) from error


def _validated(table: pa.Table) -> pa.Table:
    """Check the values in some rows of a table; return the rows with lists of fixed size.

    Raises
    ------
    pa.ArrowInvalid : a box or a posterior holds NaN or infinity, a visible size is negative, or a
        list ends within an item.
    """
    table = with_fixed_lists(table)
    for name in _TUPLES.keys() & set(table.column_names):
        lengths = (np.diff(chunk.offsets.to_numpy()) for chunk in table[name].chunks)
        if any((length % _TUPLES[name]).any() for length in lengths):
            msg = f"column {name} holds a list that is not of {_TUPLES[name]} numbers per item"
            raise pa.ArrowInvalid(msg)
    for name in _NUMBERS.intersection(table.column_names):
        values = numbers(table[name].drop_null())
        if not np.isfinite(values).all() or (name == "size" and np.any(values < 0)):
            msg = f"column {name} holds NaN, infinity or a negative size"
            raise pa.ArrowInvalid(msg)
    return table


def with_fixed_lists(table: pa.Table) -> pa.Table:
    """Return a table with each column in `FIXED_LISTS` cast to lists of fixed size.

    Raises
    ------
    pa.ArrowInvalid : a list has a different length.
    """
    for k, field in enumerate(table.schema):
        if (kind := FIXED_LISTS.get(field.name, field.type)) != field.type:
            table = table.set_column(k, field.name, table[k].cast(kind))
    return table


def _open_parquet(path: Path, read_dictionary: Sequence[str]) -> pq.ParquetFile:
    """Open a file; the columns ``read_dictionary`` stay dictionary-encoded."""
    try:
        return pq.ParquetFile(
            path, read_dictionary=list(read_dictionary), page_checksum_verification=True
        )
    except KeyError as error:
        msg = f"no column {', '.join(read_dictionary)}"
        raise pa.ArrowInvalid(msg) from error


def _wrong_column(schema: pa.Schema, expected: pa.Schema, columns: Sequence[str] | None) -> str:
    """Describe the first of ``columns`` that is missing or mistyped; empty if there is none."""
    for field in (field for field in expected if columns is None or field.name in columns):
        if field.name not in schema.names:
            return f"no column {field.name}"
        kind = schema.field(field.name).type
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        if kind not in _file_types(field.type):
            return f"column {field.name} holds {kind}, not {field.type}"
    return ""


def _file_types(kind: pa.DataType) -> tuple[pa.DataType, ...]:
    """Return the types of a column of ``kind`` in a file, where lists may lack a fixed size."""
    is_fixed = pa.types.is_fixed_size_list(kind)
    return (kind, pa.list_(kind.value_type)) if is_fixed else (kind,)
