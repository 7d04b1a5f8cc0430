"""Make and read the table of masks: the pixels of each detection on a colour image."""

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shapecat.arrays import U4
from shapecat.runs.tables.reading import Key, misfit, numbers, read_row_groups, read_stamps
from shapecat.runs.tables.schemas import MASKS
from shapecat.types import ImageMasks, Perception

__all__ = ["mask_columns", "read_masks", "read_nearest_masks"]

_HELD = 256
"""Maximum number of images held back, since a later frame may be nearer to them in time."""


def mask_columns(perceptions: Iterable[Perception]) -> dict[str, Any]:
    """Return the columns of the masks table for some frames."""
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


def read_masks(folder: Path, *, boxes_only: bool = False) -> Iterator[tuple[Key, ImageMasks]]:
    """Yield each frame that has a colour image, and its masks, in the order of the frames table.

    With ``boxes_only``, the masks lack run lengths, which make up most of the table.
    """
    path = folder / "masks.parquet"
    if not path.exists():
        return
    plain = MASKS.names[: -1 if boxes_only else None]
    for group in read_row_groups(path, plain):
        counts = None if boxes_only else _run_lengths(group["counts"])
        for row in group.select(MASKS.names[:-1]).to_pylist():
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
    boxes, but no run lengths.

    Raises
    ------
    OutputError : a table is unreadable, or a frame with masks is not in the frames table.
    """
    held: dict[tuple[int, int, str], tuple[int, Key, ImageMasks]] = {}
    stamps = read_stamps(folder)
    for key, masks in read_masks(folder, boxes_only=True):
        stamp = next((stamp for candidate, stamp in stamps if candidate == key), None)
        if stamp is None:
            raise misfit(folder)
        apart = abs(stamp - masks.stamp_ns)
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
