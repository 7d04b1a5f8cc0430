"""Write the Parquet tables of a run folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import F4
from shapecat.runs.tables.schemas import FIXED_LISTS, MAY_BE_NULL

__all__ = ["arrow_table", "lists", "open_writer", "rows_as_lists", "write_table"]


def write_table(path: Path, columns: dict[str, Any], schema: pa.Schema) -> None:
    """Write a table as one row group."""
    writer = open_writer(path, schema)
    with writer:
        writer.write_table(arrow_table(columns, schema))


def open_writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    """Open a table for writing row groups."""
    # Ascending pixel indices shrink tenfold as differences; a dictionary does not help floats.
    texts = [f.name for f in schema if f.type == pa.string()]
    deltas = {f"{n}.list.element": "DELTA_BINARY_PACKED" for n in ("indices",) if n in schema.names}
    plain = {name: pa.list_(FIXED_LISTS[name].value_type) for name in MAY_BE_NULL}
    fields = [field.with_type(plain.get(field.name, field.type)) for field in schema]
    return _Writer(
        path,
        pa.schema(fields, schema.metadata),
        compression="zstd",
        write_page_checksum=True,
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
    """Return rows of numbers as a list column with items of type ``kind``; lengths may differ."""
    flat = [np.ravel(row) for row in rows]
    offsets = np.concatenate([[0], np.cumsum([row.size for row in flat])]).astype(np.int32)
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(offsets, pa.array(values.astype(kind.to_pandas_dtype())))


def rows_as_lists(values: F4) -> pa.Array:
    """Return the rows of an array (n, c) as a list column of float32."""
    offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
    return pa.ListArray.from_arrays(offsets, pa.array(values.astype(np.float32).ravel()))


class _Writer(pq.ParquetWriter):  # type: ignore[misc]  # pyarrow has no types
    """Writes row groups with the column types of its schema, whatever those of the tables.

    `open_writer` replaces lists of fixed size that may be null by plain lists: Arrow before version
    26, and programs that use it, cannot read nulls among lists of fixed size.
    """

    def write_table(self, table: pa.Table) -> None:
        super().write_table(table.cast(self.schema))
