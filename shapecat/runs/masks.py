"""The table of masks: the pixels of each detection on the colour image."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import U4
from shapecat.colour.masks import NOTHING, Mask, united
from shapecat.colour.rle import rle_counts, rle_mask
from shapecat.runs.tables import SCHEMA_VERSION, Key, arrow_table, open_writer, read_row_groups
from shapecat.system.files import replacing

__all__ = ["MASKS", "FrameMasks", "MaskRow", "MaskTable", "count_masks", "read_masks"]

MASKS = pa.schema(
    [
        ("topic", pa.string()),
        ("frame", pa.int32()),
        ("color_topic", pa.string()),
        ("color_stamp_ns", pa.int64()),
        ("color_log_time_ns", pa.int64()),
        ("color_frame_id", pa.string()),
        ("width", pa.int32()),
        ("height", pa.int32()),
        ("detection", pa.list_(pa.int32())),
        ("box", pa.list_(pa.int32())),
        ("counts", pa.list_(pa.list_(pa.uint32()))),
    ]
)
"""One row per frame that has a colour image: the size of the image, and for each detection that
is seen in it the box (left, top, width, height) and the run lengths of its mask."""

_GROUP = 32


MaskRow = dict[str, Any]
"""The columns of a row that tell of the frame and of its image, by name."""


@dataclass(frozen=True)
class FrameMasks:
    """A row of the table; ``masks`` are those that need not be decoded."""

    key: Key
    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    width: int
    height: int
    boxes: dict[int, tuple[int, int, int, int]]
    counts: dict[int, U4]
    masks: dict[int, Mask] = field(default_factory=dict)

    def mask(self, detections: Sequence[int]) -> Mask:
        """Return the union of the masks of some detections."""
        found = [self._mask(number) for number in detections if number in self.counts]
        return united(found) if found else NOTHING

    def _mask(self, number: int) -> Mask:
        found = self.masks.get(number)
        return rle_mask(self.counts[number], self.height, self.width) if found is None else found

    def box(self, detections: Sequence[int]) -> tuple[int, int, int, int] | None:
        """Return left, top, width and height around some detections, or None."""
        boxes = [self.boxes[n] for n in detections if n in self.boxes]
        if not boxes:
            return None
        left, top = min(box[0] for box in boxes), min(box[1] for box in boxes)
        right, bottom = max(box[0] + box[2] for box in boxes), max(box[1] + box[3] for box in boxes)
        return left, top, right - left, bottom - top


class MaskTable:
    """Writes ``masks.parquet`` row group by row group; it appears when the block succeeds."""

    def __init__(self, folder: Path) -> None:
        """Begin without rows."""
        self._path = folder / "masks.parquet"
        self._rows: list[dict[str, Any]] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Open the table."""
        hidden = self._stack.enter_context(replacing(self._path))
        schema = MASKS.with_metadata({"schema_version": SCHEMA_VERSION})
        self._writer = self._stack.enter_context(open_writer(hidden, schema))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write the rest; after an error nothing appears."""
        if kind is None:
            self._flush()
        self._stack.__exit__(kind, error, trace)

    def write(self, row: MaskRow, masks: Mapping[int, Mask]) -> FrameMasks:
        """Append a frame: what is known of its image, and the masks of its detections."""
        seen = {number: mask for number, mask in masks.items() if mask.pixels.size}
        size = row["height"], row["width"]
        counts = {number: rle_counts(mask, *size) for number, mask in seen.items()}
        boxes = [value for mask in seen.values() for value in mask.box]
        found = {**row, "detection": list(seen), "box": boxes, "counts": list(counts.values())}
        self._rows.append(found)
        if len(self._rows) == _GROUP:
            self._flush()
        return _frame_masks(found, seen)

    def _flush(self) -> None:
        if self._rows:
            columns = {name: [row[name] for row in self._rows] for name in MASKS.names}
            self._writer.write_table(arrow_table(columns, self._writer.schema))
            self._rows = []


def count_masks(folder: Path) -> int:
    """Return how many frames of a run have a colour image."""
    return int(pq.read_metadata(folder / "masks.parquet").num_rows)


def read_masks(folder: Path, *, boxes_only: bool = False) -> Iterator[FrameMasks]:
    """Yield the masks of a run, in the order of its frames; none without colour.

    With ``boxes_only`` they have no pixels, which are nearly all of the table.
    """
    path = folder / "masks.parquet"
    if not path.exists():
        return
    wanted = [name for name in MASKS.names if name != "counts" or not boxes_only]
    for group in read_row_groups(path, wanted):
        for row in group.to_pylist():
            yield _frame_masks(row, {})


def _frame_masks(row: MaskRow, masks: dict[int, Mask]) -> FrameMasks:
    numbers = row["detection"]
    boxes = np.reshape(row["box"], (-1, 4)).astype(int).tolist()
    return FrameMasks(
        (row["topic"], row["frame"]),
        row["color_topic"],
        row["color_stamp_ns"],
        row["color_log_time_ns"],
        row["color_frame_id"],
        row["width"],
        row["height"],
        {n: tuple(box) for n, box in zip(numbers, boxes, strict=True)},
        dict(zip(numbers, row["counts"], strict=True)) if "counts" in row else {},
        masks,
    )
