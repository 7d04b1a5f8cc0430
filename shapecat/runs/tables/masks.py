"""Make and read the table of masks: the pixels of each detection on a colour image."""

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shapecat.arrays import U4
from shapecat.runs.tables.reading import Key, keys_of, misfit, numbers, read_together
from shapecat.runs.tables.schemas import MASKS
from shapecat.types import ImageMasks, Perception

__all__ = ["mask_columns", "masks_in", "read_nearest_masks"]

_WITHOUT_COUNTS = MASKS.names[:-1]
"""The columns of the masks table except the run lengths."""
_HELD = 256
"""Maximum number of images held back, since a later frame may be nearer to them in time."""


def mask_columns(perceptions: Iterable[Perception]) -> dict[str, Any]:
    """Return the columns of the masks table, by name, for those frames that have masks."""
    pairs = [(p, p.masks) for p in perceptions if p.masks is not None]
    return {
        "topic": [p.topic for p, _ in pairs],
        "frame": [p.index for p, _ in pairs],
        "color_topic": [m.topic for _, m in pairs],
        "color_stamp_ns": [m.stamp_ns for _, m in pairs],
        "color_log_time_ns": [m.log_time_ns for _, m in pairs],
        "color_frame_id": [m.frame_id for _, m in pairs],
        "width": [m.width for _, m in pairs],
        "height": [m.height for _, m in pairs],
        "detection": [list(m.boxes) for _, m in pairs],
        "box": [list(chain.from_iterable(m.boxes.values())) for _, m in pairs],
        "counts": [list(m.counts.values()) for _, m in pairs],
    }


def masks_in(table: pa.Table) -> Iterator[tuple[Key, ImageMasks]]:
    """Yield each frame in a part of the table of masks, and its masks.

    The masks lack run lengths if ``table`` lacks the column ``counts``, the largest by far.
    """
    counts = _run_lengths(table["counts"]) if "counts" in table.column_names else None
    for row in table.select(_WITHOUT_COUNTS).to_pylist():
        detections = row.pop("detection")
        boxes = np.reshape(row.pop("box"), (-1, 4)).astype(int).tolist()
        key = row.pop("topic"), row.pop("frame")
        of_image = {name.removeprefix("color_"): value for name, value in row.items()}
        runs = {} if counts is None else {n: next(counts) for n in detections}
        named = dict(zip(detections, map(tuple, boxes), strict=True))
        yield key, ImageMasks(**of_image, boxes=named, counts=runs)


def read_nearest_masks(folder: Path) -> Iterator[tuple[Key, ImageMasks]]:
    """Yield each colour image once: the frame nearest to it in time, and the masks of this frame.

    Images are in the order in which they were recorded. Several frames share an image if there are
    fewer images than frames, or if several depth sensors share a colour camera. The masks have
    boxes, but no run lengths. Without a table of masks, nothing is yielded.

    Raises
    ------
    OutputError : a table is unreadable, or a frame with masks is not in the frames table.
    """
    if not (folder / "masks.parquet").exists():
        return
    held: dict[tuple[int, int, str], tuple[int, Key, ImageMasks]] = {}
    columns = {"frames": ("topic", "frame", "stamp_ns"), "masks": _WITHOUT_COUNTS}
    for frames, table in read_together(folder, columns):
        stamps = dict(zip(keys_of(frames), numbers(frames["stamp_ns"]).tolist(), strict=True))
        for key, masks in masks_in(table):
            if key not in stamps:
                raise misfit(folder)
            apart = abs(stamps[key] - masks.stamp_ns)
            # Stamps alone repeat after a clock was set back.
            image = masks.log_time_ns, masks.stamp_ns, masks.topic
            if image not in held or apart < held[image][0]:
                held[image] = apart, key, masks
            if len(held) > _HELD:
                yield held.pop(min(held))[1:]
    yield from (held[image][1:] for image in sorted(held))


def _run_lengths(column: pa.ChunkedArray) -> Iterator[U4]:
    """Yield the run lengths (r,) of each mask, without making Python lists, which is slow."""
    masks = column.combine_chunks().flatten()
    ends, values = np.from_dlpack(masks.offsets), numbers(pa.chunked_array([masks]))
    ends = ends - ends[0] if len(ends) else ends
    return (values[start:end] for start, end in pairwise(ends.tolist()))
