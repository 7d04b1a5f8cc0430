"""The Parquet tables between the phases: their columns, and how records become rows.

A run folder holds ``frames``, ``detections`` and ``planes`` (written by perceive), and ``tracks``
(written by track). Row groups of the first three cover the same frames, so that they can be read
side by side in flat memory. Adding a column is allowed within a schema version; changing the
meaning of one is not.
"""

import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import F4, I4
from shapecat.errors import OutputError
from shapecat.files import complete_folder, replacing
from shapecat.types import Perception, Pose

__all__ = [
    "DETECTIONS",
    "FRAMES",
    "PLANES",
    "SCHEMA_VERSION",
    "TRACKS",
    "FrameRow",
    "Key",
    "PerceptionTables",
    "count_rows",
    "count_segments",
    "discard_segments",
    "frame_rows",
    "numbers",
    "read_row_groups",
    "release_memory",
    "rows_of",
    "topic_codes",
    "write_table",
]

SCHEMA_VERSION = "1"

_VEC3 = pa.list_(pa.float32(), 3)
_QUATERNION = pa.list_(pa.float32(), 4)
_FLOATS = pa.list_(pa.float32())

FRAMES = pa.schema(
    [
        ("topic", pa.string()),
        ("frame", pa.int32()),
        ("stamp_ns", pa.int64()),
        ("log_time_ns", pa.int64()),
        ("frame_id", pa.string()),
        ("up", _VEC3),
        ("up_given", _VEC3),
        ("fixed_translation", pa.list_(pa.float64(), 3)),
        ("fixed_rotation", pa.list_(pa.float64(), 9)),
        ("stages", pa.list_(pa.string())),
        ("seconds", _FLOATS),
    ]
)
"""One row per frame read, also those without a detection. ``up`` is what detection went by,
``up_given`` where transforms, an IMU or an option said it is, null where nothing did. ``fixed_*``
is ``fixed_from_sensor`` (rotation row by row), null without a fixed frame; ``seconds`` per entry
of ``stages``."""

DETECTIONS = pa.schema(
    [
        ("topic", pa.string()),
        ("frame", pa.int32()),
        ("stamp_ns", pa.int64()),
        ("frame_id", pa.string()),
        ("detection", pa.int32()),
        ("plane", pa.int16()),
        ("on_detection", pa.int32()),
        ("touches_border", pa.bool_()),
        ("occluded", pa.bool_()),
        ("center", _VEC3),
        ("size", _VEC3),
        ("orientation", _QUATERNION),
        ("center_fixed", _VEC3),
        ("height_m", pa.float32()),
        ("points", pa.int32()),
        ("indices", pa.list_(pa.uint32())),
        ("posterior", _FLOATS),
        ("category", pa.string()),
        ("confidence", pa.float32()),
        ("novelty", pa.float32()),
        ("descriptor", _FLOATS),
        ("neurons", _FLOATS),
        ("edges", pa.list_(pa.uint16())),
        ("seconds", pa.float32()),
    ]
)
"""One row per object per frame; lengths in metres, ``center`` and ``neurons`` in ``frame_id``."""

PLANES = pa.schema(
    [
        ("topic", pa.string()),
        ("frame", pa.int32()),
        ("stamp_ns", pa.int64()),
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
        ("topic", pa.string()),
        ("frame", pa.int32()),
        ("stamp_ns", pa.int64()),
        ("detection", pa.int32()),
        ("center_fixed", _VEC3),
        ("posterior", _FLOATS),
    ]
)
"""One row per track per frame; ``detection`` is null while the track coasts, ``posterior`` is the
causal one. Without a fixed frame ``center_fixed`` is in the sensor frame."""

Key = tuple[str, int]
"""A frame: its topic, and its number there."""

_GROUP_FRAMES = 32
_SEGMENT_S = 2.0
"""What a kill may cost: frames are kept in a segment at least so often."""
_PERCEIVED = {"frames": FRAMES, "detections": DETECTIONS, "planes": PLANES}


@dataclass(frozen=True)
class FrameRow:
    """What the frames table adds to a `Perception`."""

    log_time_ns: int
    fixed_from_sensor: Pose | None
    up_given: F4 | None = None


class PerceptionTables:
    """Writes frames, detections and planes side by side, a row group every 32 frames.

    What was perceived is first written as *segments*, folders that appear when complete, so that
    a run that was cut short goes on after its last one; leaving the block joins them into the
    tables, which are the same wherever it was cut.

    Attributes
    ----------
    done : frames in the segments that an earlier run has left.
    """

    def __init__(self, folder: Path, *, categories: Sequence[str], model_id: str) -> None:
        """Look for segments in ``folder``, which must exist."""
        metadata = {
            "schema_version": SCHEMA_VERSION,
            "categories": ",".join(categories),
            "model": model_id,
        }
        self._folder = folder
        self._schemas = {name: s.with_metadata(metadata) for name, s in _PERCEIVED.items()}
        self._categories = tuple(categories)
        self._pending: list[tuple[Perception, FrameRow]] = []
        self._segments = _segments(folder)
        self._flushed = time.monotonic()
        self.done = sum(_read_segment(s / "frames.arrow").num_rows for s in self._segments)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write what is pending, and join the segments; after an error only keep what is done."""
        if kind is not None:
            with suppress(OSError):
                self._flush()
            return
        self._flush()
        self._join()

    def write(self, perception: Perception, row: FrameRow) -> None:
        """Append one frame."""
        self._pending.append((perception, row))
        late = time.monotonic() - self._flushed > _SEGMENT_S
        if late or len(self._pending) >= _GROUP_FRAMES:
            self._flush()

    def _flush(self) -> None:
        if not self._pending:
            return
        rows = {
            "frames": _frame_columns(self._pending),
            "detections": _detection_columns(self._pending, self._categories),
            "planes": _plane_columns([perception for perception, _ in self._pending]),
        }
        segment = self._folder / _SEGMENTS / f"{len(self._segments):06d}"
        with complete_folder(segment) as hidden:
            for name, schema in self._schemas.items():
                _write_segment(hidden / f"{name}.arrow", _table(rows[name], schema))
        self._segments.append(segment)
        self._pending.clear()
        self._flushed = time.monotonic()

    def _join(self) -> None:
        """Write the tables, whose row groups cover the same frames."""
        with ExitStack() as stack:
            writers = {}
            for name, schema in self._schemas.items():
                path = stack.enter_context(replacing(self._folder / f"{name}.parquet"))
                writers[name] = stack.enter_context(_open_writer(path, schema))
            for group in _row_groups(self._segments):
                for name, writer in writers.items():
                    writer.write_table(group[name])


_SEGMENTS = "segments"


def count_segments(folder: Path) -> int:
    """Return how many segments a run that was cut short has left."""
    return len(_segments(folder))


def discard_segments(folder: Path) -> None:
    """Remove what the tables were joined from."""
    shutil.rmtree(folder / _SEGMENTS, ignore_errors=True)


def _segments(folder: Path) -> list[Path]:
    """Return the complete segments, in order."""
    return sorted((folder / _SEGMENTS).glob("[0-9]*"))


_Tables = dict[str, pa.Table]


def _row_groups(segments: Iterable[Path]) -> Iterator[_Tables]:
    """Yield the tables of 32 frames at a time, in whatever portions the segments have them."""
    held: _Tables = {}
    for segment in segments:
        new = {name: _read_segment(segment / f"{name}.arrow") for name in _PERCEIVED}
        held = {name: pa.concat_tables([held[name], new[name]]) for name in new} if held else new
        while held["frames"].num_rows >= _GROUP_FRAMES:
            group, held = _cut(held, _GROUP_FRAMES)
            yield group
    if held and held["frames"].num_rows:
        yield held


def _cut(tables: _Tables, count: int) -> tuple[_Tables, _Tables]:
    """Part tables after a number of frames."""
    first = set(frame_rows(tables["frames"][:count]))
    ends = {"frames": count}
    for name in ("detections", "planes"):
        rows = frame_rows(tables[name])
        ends[name] = max((rows[key].stop for key in first & set(rows)), default=0)
    return (
        {name: tables[name][:end].combine_chunks() for name, end in ends.items()},
        {name: tables[name][end:] for name, end in ends.items()},
    )


def _write_segment(path: Path, table: pa.Table) -> None:
    """Write a part of a table as it lies in memory: it is soon read again, once."""
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)


def _read_segment(path: Path) -> pa.Table:
    try:
        with pa.OSFile(str(path), "rb") as source, pa.ipc.open_file(source) as reader:
            return reader.read_all()
    except (OSError, pa.ArrowException) as error:
        msg = f"{path}: what a killed run left there cannot be read ({error}); use --overwrite"
        raise OutputError(msg) from error


def count_rows(folder: Path, table: str) -> int:
    """Return the number of rows of a table of a run folder."""
    with _reading(folder / f"{table}.parquet") as file:
        return int(file.metadata.num_rows)


def write_table(path: Path, columns: dict[str, Any], schema: pa.Schema) -> None:
    """Write a whole table at once."""
    writer = _open_writer(path, schema)
    with writer:
        writer.write_table(_table(columns, schema))


def read_row_groups(
    path: Path, columns: Sequence[str] | None = None, *, at_once: int = 1
) -> Iterator[pa.Table]:
    """Yield the row groups of a table of a run folder, ``at_once`` at a time."""
    with _reading(path) as file:
        count = file.num_row_groups
        for first in range(0, count, at_once):
            yield file.read_row_groups(range(first, min(first + at_once, count)), columns=columns)


def frame_rows(table: pa.Table) -> dict[Key, slice]:
    """Return the rows of each frame, which follow each other in every table."""
    return rows_of(*topic_codes(table), numbers(table["frame"]))


def topic_codes(table: pa.Table) -> tuple[list[str], I4]:
    """Return the topics of a table, and which of them each row has."""
    column = table["topic"].combine_chunks().dictionary_encode()
    return column.dictionary.to_pylist(), np.from_dlpack(column.indices)


def rows_of(topics: Sequence[str], codes: I4, frames: I4) -> dict[Key, slice]:
    """Return the rows of each frame, which follow each other."""
    changes = (np.diff(codes) != 0) | (np.diff(frames) != 0)
    starts = np.flatnonzero(np.concatenate([np.ones(min(1, len(frames)), np.bool_), changes]))
    names = map(topics.__getitem__, codes[starts].tolist())
    stops = [*starts[1:].tolist(), len(frames)]
    rows = map(slice, starts.tolist(), stops)
    return dict(zip(zip(names, frames[starts].tolist(), strict=True), rows, strict=True))


def numbers(column: pa.ChunkedArray) -> Any:
    """Return the numbers of a column without nulls; those of lists row after row.

    Arrow's own way, and any scalar or array made by it, loads Pandas, which takes a third of a
    second.
    """
    array = column.combine_chunks()
    return np.from_dlpack(array if pa.types.is_primitive(array.type) else array.flatten())


def release_memory() -> None:
    """Give the system back what was freed: the next phase has other needs."""
    for pool in (pa.default_memory_pool(), pa.system_memory_pool()):
        pool.release_unused()


@contextmanager
def _reading(path: Path) -> Iterator[pq.ParquetFile]:
    try:
        with pq.ParquetFile(path) as file:
            yield file
    except (OSError, pa.ArrowException) as error:
        msg = f"{path}: not a readable table of a run folder ({error}); process the recording again"
        raise OutputError(msg) from error


def _open_writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    # Ascending pixel indices shrink tenfold as differences; floats do not gain from a dictionary.
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


def _table(columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
    arrays = [
        column if isinstance(column, pa.Array) else pa.array(column, field.type)
        for field, column in ((field, columns[field.name]) for field in schema)
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def lists(rows: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Return ragged rows of numbers as one list column without a Python object per number."""
    flat = [np.ravel(row) for row in rows]
    offsets = np.concatenate([[0], np.cumsum([row.size for row in flat])]).astype(np.int32)
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(offsets, pa.array(values.astype(kind.to_pandas_dtype())))


def _frame_columns(rows: Sequence[tuple[Perception, FrameRow]]) -> dict[str, Any]:
    return {
        "topic": [p.topic for p, _ in rows],
        "frame": [p.index for p, _ in rows],
        "stamp_ns": [p.stamp_ns for p, _ in rows],
        "log_time_ns": [row.log_time_ns for _, row in rows],
        "frame_id": [p.frame_id for p, _ in rows],
        "up": [p.scene.up for p, _ in rows],
        "up_given": [row.up_given for _, row in rows],
        "fixed_translation": [
            row.fixed_from_sensor and row.fixed_from_sensor.translation for _, row in rows
        ],
        "fixed_rotation": [
            row.fixed_from_sensor and row.fixed_from_sensor.rotation.ravel() for _, row in rows
        ],
        "stages": [list(p.seconds) for p, _ in rows],
        "seconds": [list(p.seconds.values()) for p, _ in rows],
    }


def _detection_columns(
    rows: Sequence[tuple[Perception, FrameRow]], categories: Sequence[str]
) -> dict[str, Any]:
    objects = [(p, row, k, d) for p, row in rows for k, d in enumerate(p.detections)]
    found = [d for _, _, _, d in objects]
    candidates = [d.candidate for d in found]
    best = [int(np.argmax(d.posterior)) for d in found]
    return {
        "topic": [p.topic for p, *_ in objects],
        "frame": [p.index for p, *_ in objects],
        "stamp_ns": [p.stamp_ns for p, *_ in objects],
        "frame_id": [p.frame_id for p, *_ in objects],
        "detection": [k for _, _, k, _ in objects],
        "plane": [c.plane for c in candidates],
        "on_detection": [c.on_candidate for c in candidates],
        "touches_border": [c.touches_border for c in candidates],
        "occluded": [c.occluded for c in candidates],
        "center": [c.box.center for c in candidates],
        "size": [c.box.size for c in candidates],
        "orientation": [c.box.orientation for c in candidates],
        "center_fixed": [_center_fixed(row, d.candidate.box.center) for _, row, _, d in objects],
        "height_m": [
            _height(p, c.plane, c.support_m, c.box.center)
            for (p, *_), c in zip(objects, candidates, strict=True)
        ],
        "points": [c.indices.size for c in candidates],
        "indices": lists([c.indices for c in candidates], pa.uint32()),
        "posterior": lists([d.posterior for d in found], pa.float32()),
        "category": [
            "unknown" if d.novelty > 1 else categories[k] for d, k in zip(found, best, strict=True)
        ],
        "confidence": [float(d.posterior[k]) for d, k in zip(found, best, strict=True)],
        "novelty": [d.novelty for d in found],
        "descriptor": lists([d.descriptor for d in found], pa.float32()),
        "neurons": lists([d.gas.neurons for d in found], pa.float32()),
        "edges": lists([d.gas.edges for d in found], pa.uint16()),
        "seconds": [d.seconds for d in found],
    }


def _center_fixed(row: FrameRow, center: Any) -> Any:
    pose = row.fixed_from_sensor
    return None if pose is None else pose.rotation @ center + pose.translation


def _height(perception: Perception, plane: int | None, support_m: float, center: Any) -> float:
    """Return the height of a centre above what its object stands on, in metres."""
    if plane is None:
        return float("nan")
    support = perception.scene.planes[plane]
    return float(support.normal @ center) - support.offset - support_m


def _plane_columns(perceptions: Iterable[Perception]) -> dict[str, Any]:
    planes = [(p, k, plane) for p in perceptions for k, plane in enumerate(p.scene.planes)]
    return {
        "topic": [p.topic for p, *_ in planes],
        "frame": [p.index for p, *_ in planes],
        "stamp_ns": [p.stamp_ns for p, *_ in planes],
        "plane": [k for _, k, _ in planes],
        "normal": [plane.normal for *_, plane in planes],
        "offset": [plane.offset for *_, plane in planes],
        "height_m": [plane.height_m for *_, plane in planes],
        "area_m2": [plane.area_m2 for *_, plane in planes],
        "outline": lists([plane.outline for *_, plane in planes], pa.float32()),
    }
