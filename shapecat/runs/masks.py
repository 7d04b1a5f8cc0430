"""The table of masks: what the colour camera sees of the detections of each frame."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa

from shapecat.arrays import U4
from shapecat.colour.masks import NOTHING, Mask, united
from shapecat.colour.rle import rle_counts, rle_mask
from shapecat.runs.tables import SCHEMA_VERSION, Key, arrow_table, open_writer, read_row_groups
from shapecat.system.files import replacing

__all__ = ["MASKS", "FrameMasks", "MaskTable", "read_masks"]

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


@dataclass(frozen=True)
class FrameMasks:
    """A row of the table."""

    key: Key
    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    width: int
    height: int
    boxes: dict[int, tuple[int, int, int, int]]
    counts: dict[int, U4]

    def mask(self, detections: Sequence[int]) -> Mask:
        """Return what is seen of some detections, which are parts of one object."""
        seen = [number for number in detections if number in self.counts]
        found = [rle_mask(self.counts[number], self.height, self.width) for number in seen]
        return united(found) if found else NOTHING

    def box(self, detections: Sequence[int]) -> tuple[int, int, int, int] | None:
        """Return left, top, width and height around some detections; None if none is seen."""
        boxes = np.array([self.boxes[n] for n in detections if n in self.boxes])
        if not len(boxes):
            return None
        left, top = boxes[:, :2].min(axis=0).tolist()
        right, bottom = (boxes[:, :2] + boxes[:, 2:]).max(axis=0).tolist()
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

    def write(self, row: dict[str, Any], detections: Sequence[int], masks: Sequence[Mask]) -> None:
        """Append a frame: what is known of its image, and the masks of its detections."""
        seen = [(n, mask) for n, mask in zip(detections, masks, strict=True) if mask.pixels.size]
        size = row["height"], row["width"]
        found = {
            "detection": [n for n, _ in seen],
            "box": [value for _, mask in seen for value in mask.box],
            "counts": [rle_counts(mask, *size) for _, mask in seen],
        }
        self._rows.append({**row, **found})
        if len(self._rows) == _GROUP:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            columns = {name: [row[name] for row in self._rows] for name in MASKS.names}
            self._writer.write_table(arrow_table(columns, self._writer.schema))
            self._rows = []


def read_masks(folder: Path) -> Iterator[FrameMasks]:
    """Yield the masks of a run, in the order of its frames; nothing where there is no colour."""
    path = folder / "masks.parquet"
    if not path.exists():
        return
    for group in read_row_groups(path):
        for row in group.to_pylist():
            numbers = row["detection"]
            boxes = np.reshape(row["box"], (-1, 4)).astype(int).tolist()
            yield FrameMasks(
                (row["topic"], row["frame"]),
                row["color_topic"],
                row["color_stamp_ns"],
                row["color_log_time_ns"],
                row["color_frame_id"],
                row["width"],
                row["height"],
                {n: tuple(box) for n, box in zip(numbers, boxes, strict=True)},
                dict(zip(numbers, row["counts"], strict=True)),
            )
