"""The colour images of a run: which there are, and the masks of its detections on them."""

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.arrays import U4
from shapecat.cameras.colour import ColourView
from shapecat.colour.masks import NOTHING, Mask, dense_masks
from shapecat.errors import OutputError
from shapecat.executors.order import map_ahead
from shapecat.recordings import Recording, choose_streams
from shapecat.recordings.colour_frames import frames_with_colour
from shapecat.recordings.colour_streams import ColourStream, choose_colour
from shapecat.recordings.messages import Needed
from shapecat.runs.masks import FrameMasks, MaskRow, MaskTable, read_masks
from shapecat.runs.run_info import RunInfo, window_of
from shapecat.runs.tables import Key, frame_rows, numbers, read_row_groups
from shapecat.types import Frame, LabelledFrame

__all__ = [
    "Coloured",
    "Seen",
    "colours_of",
    "find_masks",
    "views_again",
    "with_colour",
]

Seen = tuple[Frame, ColourView | None, FrameMasks | None]
"""A frame, its colour image, and the masks of its detections on it."""


_AHEAD = 4
"""Frames that are looked for in advance."""


@dataclass(frozen=True)
class Coloured:
    """The colour image of a frame, and the mask of each of its objects, in their order."""

    view: ColourView
    masks: tuple[Mask, ...]


def colours_of(recording: Recording, options: Mapping[str, Any]) -> dict[str, ColourStream]:
    """Return the colour stream of each depth topic of a run that has one.

    Raises
    ------
    NoStreamError : the topic that was asked for holds no colour images.
    """
    wanted = options.get("color")
    if wanted == "":
        return {}
    streams = choose_streams(recording, options["topics"])
    found = {stream.topic: choose_colour(recording, stream, wanted) for stream in streams}
    return {topic: colour for topic, colour in found.items() if colour is not None}


def views_again(
    recording: Recording, run: RunInfo, needed: Needed = None
) -> Iterator[tuple[Frame, ColourView | None]]:
    """Read the frames that a run was made from once more, with their colour images.

    Parameters
    ----------
    needed : as for `shapecat.recordings.frames`.
    """
    options = run["options"]
    streams = choose_streams(recording, options["topics"])
    colours = colours_of(recording, options)
    chosen = {"needed": needed, **window_of(options)}
    return frames_with_colour(recording, streams, colours, skipped=Counter(), **chosen)


def with_colour(
    labelled: Iterable[LabelledFrame],
    recording: Recording,
    run: RunInfo,
    folder: Path,
    seen: Iterator[Seen] | None = None,
) -> Iterator[tuple[LabelledFrame, Frame, Coloured | None]]:
    """Pair labelled frames, in the order they were read, with their clouds and colour images.

    Frames between them need not be read.

    Parameters
    ----------
    seen : of `find_masks`, which is gone through to its end; by default the masks are read.

    Raises
    ------
    OutputError : the recording does not hold one of them any more.
    """
    awaited = _Awaited(labelled)
    seen = _with_known_masks(recording, run, folder, awaited.needs) if seen is None else seen
    for label in awaited:
        for frame, view, found in seen:
            if (label.topic, label.index) == (frame.topic, frame.index):
                yield label, frame, _coloured(label, view, found)
                break
        else:
            msg = f"{recording.path}: has changed since it was processed; process it again"
            raise OutputError(msg)
    deque(seen, maxlen=0)


class _Awaited:
    """Frames that are looked for; a few are known in advance, so that others need not be read."""

    def __init__(self, frames: Iterable[LabelledFrame]) -> None:
        self._source = iter(frames)
        self._next = deque(islice(self._source, _AHEAD))

    def __iter__(self) -> Iterator[LabelledFrame]:
        """Yield the frames, each awaited until the next one is asked for."""
        while self._next:
            yield self._next[0]
            self._next.popleft()
            self._next.extend(islice(self._source, 1))

    def needs(self, topic: str, log_time_ns: int) -> bool:
        """Return whether a frame is awaited, or is later than those that are known."""
        times = [one.log_time_ns for one in self._next if one.topic == topic]
        last = self._next[-1].log_time_ns if len(self._next) == _AHEAD else math.inf
        return log_time_ns in times or log_time_ns >= last


def _coloured(
    labelled: LabelledFrame, view: ColourView | None, found: FrameMasks | None
) -> Coloured | None:
    if view is None:
        return None
    objects = [found.mask(o.detections) if found else NOTHING for o in labelled.objects]
    return Coloured(view, tuple(objects))


def _with_known_masks(
    recording: Recording, run: RunInfo, folder: Path, needed: Needed
) -> Iterator[Seen]:
    """Yield the needed frames of a run with the masks of its table; with colour it is all."""
    rows = read_masks(folder)
    found = next(rows, None)
    for frame, view in views_again(recording, run, None if run.get("color") else needed):
        if found is not None and found.key == (frame.topic, frame.index):
            yield frame, view, found
            found = next(rows, None)
        else:
            yield frame, view, None


def find_masks(
    recording: Recording, run: RunInfo, folder: Path, *, threads: int = 1
) -> Iterator[Seen]:
    """Find the masks of all detections of a run; the table appears with the last frame.

    Parameters
    ----------
    threads : with several, one reads while the others project.
    """
    with MaskTable(folder) as table:
        items = _beside(views_again(recording, run), folder)
        for (frame, view, _), row, masks in map_ahead(_masked, items, threads=threads):
            yield frame, view, None if row is None else table.write(row, masks)


def _beside(
    views: Iterable[tuple[Frame, ColourView | None]], folder: Path
) -> Iterator[tuple[Frame, ColourView | None, dict[int, U4]]]:
    """Yield views beside the pixels of the detections of their frames."""
    found = _indices(folder)
    frames = iter(views)
    for table in read_row_groups(folder / "frames.parquet", ["topic", "frame"]):
        objects = next(found)
        for key in zip(table["topic"].to_pylist(), table["frame"].to_pylist(), strict=True):
            for frame, view in frames:
                if (frame.topic, frame.index) == key:
                    yield frame, view, objects.get(key, {})
                    break


def _indices(folder: Path) -> Iterator[dict[Key, dict[int, U4]]]:
    """Yield by frame the pixels of each detection, row group by row group."""
    wanted = ["topic", "frame", "detection", "indices"]
    for table in read_row_groups(folder / "detections.parquet", wanted):
        names, pixels = numbers(table["detection"]), table["indices"].combine_chunks()
        ends, flat = np.from_dlpack(pixels.offsets), numbers(table["indices"])
        ends = ends - ends[0] if len(ends) else ends
        yield {
            key: {int(names[k]): flat[ends[k] : ends[k + 1]] for k in range(rows.start, rows.stop)}
            for key, rows in frame_rows(table).items()
        }


_Item = tuple[Frame, ColourView | None, dict[int, U4]]


def _masked(item: _Item) -> tuple[_Item, MaskRow | None, dict[int, Mask]]:
    """Return a frame with its row of the table and its masks by detection; no row without image."""
    frame, view, objects = item
    if view is None or not frame.organized:
        return item, None, {}
    image = view.image
    row: MaskRow = {
        "topic": frame.topic,
        "frame": frame.index,
        "color_topic": image.topic,
        "color_stamp_ns": image.stamp_ns,
        "color_log_time_ns": image.log_time_ns,
        "color_frame_id": image.frame_id,
        "width": image.width,
        "height": image.height,
    }
    masks = dense_masks(frame, list(objects.values()), view.lens, view.colour_from_depth)
    return item, row, dict(zip(objects, masks, strict=True))
