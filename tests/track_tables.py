"""Builder of track tables for synthetic runs, and readers of tables."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.runs.tables.masks import masks_in
from shapecat.runs.tables.reading import Key
from shapecat.runs.tables.schemas import TRACKS
from shapecat.runs.tables.writing import write_table
from shapecat.types import ImageMasks

__all__ = ["lines", "read_masks", "rows", "untimed_table", "write_tracks"]


def write_tracks(
    folder: Path,
    rows: Sequence[tuple[int, int, int | None]],
    *,
    topics: Sequence[str] = (),
    begin_ns: int = 1000,
) -> None:
    """Write tracks.parquet of rows (track, frame, detection); frames are a nanosecond apart.

    ``topics`` holds the topic of each row; by default, all rows have the same topic.
    """
    columns = {
        "track": [track for track, _, _ in rows],
        "topic": list(topics) or ["/depth"] * len(rows),
        "frame": [frame for _, frame, _ in rows],
        "stamp_ns": [begin_ns + frame for _, frame, _ in rows],
        "detection": [detection for _, _, detection in rows],
        "center_fixed": [[0, 0, 0]] * len(rows),
        "posterior": [[0.5, 0.5]] * len(rows),
    }
    full = {name: [None] * len(rows) for name in TRACKS.names if "_full" in name}
    write_table(folder / "tracks.parquet", full | columns, TRACKS)


def rows(folder: Path, table: str, *columns: str) -> list[dict[str, Any]]:
    """Return the rows of a table of a run, with all columns unless some are named."""
    found = pq.read_table(folder / f"{table}.parquet", columns=list(columns) or None)
    return list(found.to_pylist())


def read_masks(folder: Path) -> list[tuple[Key, ImageMasks]]:
    """Return each frame of a run that has a colour image, and its masks."""
    return list(masks_in(pq.read_table(folder / "masks.parquet")))


def lines(folder: Path) -> list[dict[str, str]]:
    """Return the lines of tracks.csv of a run."""
    with (folder / "tracks.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def untimed_table(folder: Path, name: str) -> pa.Table:
    """Read a table of a run without its measured times, which differ from run to run."""
    table = pq.read_table(folder / f"{name}.parquet")
    return table.drop_columns([c for c in table.column_names if c == "seconds"])
