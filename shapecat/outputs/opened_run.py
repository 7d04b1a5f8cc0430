"""A finished run in Python: tables as arrays, frames with points."""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.completion import DIRECTIONS
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import OutputError
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.outputs.counts import plural
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.runs.finished import FinishedRun, open_source, read_finished
from shapecat.runs.folder import require_work
from shapecat.runs.run_info import RunInfo
from shapecat.runs.tables.reading import first_stamp, numbers_or_nan, with_fixed_lists
from shapecat.types import Frame, LabelledFrame, LabelledObject

__all__ = ["Run", "RunFrame", "Table"]


@dataclass(frozen=True)
class Table:
    """A table of a run; reads the requested columns on demand.

    ``widths`` holds, for columns of equally long lists, the length of these lists. It is needed
    if the table has no rows. ``work`` is the id ``work`` in run.json: the table of a run with
    another id is refused, unless ``work`` is empty.
    """

    path: Path
    widths: Mapping[str, int] = field(default_factory=dict, compare=False, repr=False)
    work: str = field(default="", compare=False, repr=False)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns.

        Raises
        ------
        OutputError : the table is unreadable.
        """
        with self._reading():
            return tuple(pq.read_schema(self.path).names)

    def arrow(self, columns: str | Iterable[str] | None = None) -> pa.Table:
        """Read the table, or only ``columns`` (names, or a single name), as an Arrow table.

        Raises
        ------
        OutputError : the table is unreadable or has no such column, or its run has been replaced
            since it was opened.
        """
        available = self.columns
        wanted = available if columns is None else columns
        names = [wanted] if isinstance(wanted, str) else list(wanted)
        if missing := [name for name in names if name not in available]:
            msg = f"{self.path}: no column {missing[0]}; known: {', '.join(available)}"
            raise OutputError(msg)
        with (
            self._reading(),
            pq.ParquetFile(self.path, page_checksum_verification=True) as file,
        ):
            table = with_fixed_lists(file.read(columns=names))
        if self.work:
            require_work(self.path.parent, self.work)
        return table

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            msg = f"{self.path}: not a readable table of a run ({error})"
            raise OutputError(msg) from error

    def pandas(self, columns: str | Iterable[str] | None = None) -> Any:
        """Read the table, or some columns, like `arrow`, but as a data frame; requires pandas."""
        return self.arrow(columns).to_pandas()

    def numpy(self, column: str) -> Any:
        """Read a column as an array: (n,) for numbers or text, (n, k) for lists of equal length.

        Lists of different lengths become an object array of arrays. A missing number becomes NaN, a
        missing list a row of NaN. Errors are those of `arrow`.
        """
        chunks = self.arrow([column])[column]
        if pa.types.is_fixed_size_list(chunks.type):
            return numbers_or_nan(chunks)
        values = chunks.combine_chunks()
        if pa.types.is_list(values.type):
            lengths = set(values.value_lengths().to_pylist())
            if not lengths and column in self.widths:
                return np.zeros((0, self.widths[column]), values.type.value_type.to_pandas_dtype())
            if len(lengths) == 1 and None not in lengths:
                flat = values.flatten().to_numpy(zero_copy_only=False)
                return flat.reshape(len(values), -1)
        return values.to_numpy(zero_copy_only=False)


@dataclass(frozen=True)
class RunFrame:
    """A frame of a run: its objects, its points, and its colour image, if any."""

    labelled: LabelledFrame
    reading: Frame
    coloured: Coloured | None = None

    def __repr__(self) -> str:
        where = f"{self.labelled.topic} {self.labelled.index}"
        return f"<RunFrame {where}: {plural(len(self.objects), 'object')}>"

    @property
    def objects(self) -> tuple[LabelledObject, ...]:
        """The objects with their final label, box, posterior and surface."""
        return self.labelled.objects

    @property
    def stamp_ns(self) -> int:
        """The time of measurement in nanoseconds."""
        return self.labelled.stamp_ns

    @property
    def points(self) -> F4:
        """Points (n, 3), metres, sensor frame; one per pixel of a depth image, NaN if missing."""
        return self.reading.xyz()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of masks and labels: (h, w) for a depth image, (n,) for a cloud."""
        return (len(self.points),) if self.reading.depth is None else self.reading.depth.shape

    @property
    def labels(self) -> I4:
        """The track number of each pixel or point, -1 for none; int32, with shape `shape`."""
        image = np.full(self.shape, -1, np.int32)
        for item in self.objects:
            image.reshape(-1)[item.indices] = item.track
        return image

    def mask(self, item: LabelledObject) -> Bool:
        """Return the mask of an object's pixels or points; bool, with shape `shape`."""
        mask = np.zeros(self.shape, np.bool_)
        mask.reshape(-1)[item.indices] = True
        return mask

    @property
    def color(self) -> U1 | None:
        """The colour image as recorded, (h, w, 3) uint8 red, green, blue; None if there is none.

        Raises
        ------
        MessageError : the image is damaged.
        """
        return None if self.coloured is None else pixels_of(self.coloured.view.image)

    def color_mask(self, item: LabelledObject) -> Bool | None:
        """Return an object's mask (h, w) on the colour image; None if there is no image."""
        if self.coloured is None:
            return None
        image = self.coloured.view.image
        mask = self.coloured.masks[[o.track for o in self.objects].index(item.track)]
        return mask.full(image.height, image.width)

    def points_of(self, item: LabelledObject) -> F4:
        """Return the points (n, 3) of an object, metres, sensor frame; NaN if depth is missing."""
        return self.reading.xyz(item.indices)


class Run:
    """A finished run: its tables, its tracks with their final labels, and its frames.

    The tables are ``detections``, ``tracks``, ``planes`` and ``frame_table`` (a row per frame).
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._finished: FinishedRun = read_finished(folder)
        widths = {
            "posterior": len(self.info["model"]["categories"]),
            "descriptor": len(DESCRIPTOR_NAMES),
            "outline_full": DIRECTIONS,
        }
        work = self.info["work"]
        self.detections = Table(folder / "detections.parquet", widths, work)
        self.tracks = Table(folder / "tracks.parquet", widths, work)
        self.frame_table = Table(folder / "frames.parquet", work=work)
        self.planes = Table(folder / "planes.parquet", work=work)

    def __repr__(self) -> str:
        frames, labels = self.info["counts"]["frames"], self._finished.labels.values()
        tracks = plural(len({label.track for label in labels}), "track")
        return f"<Run {self.folder}: {plural(frames, 'frame')}, {tracks}>"

    @property
    def info(self) -> RunInfo:
        """The content of run.json: input, settings, counts, seconds, warnings."""
        return self._finished.info

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories in the order of every posterior, then categories that a person added."""
        return self._finished.categories

    @cached_property
    def labels(self) -> dict[int, str]:
        """The final category of each track of the tables, with corrections.

        Deleted tracks are missing. A merged track has the category of the track that it was merged
        with. The objects in `frames` have the number of that other track.
        """
        return {track: label.category for track, label in self._finished.labels.items()}

    def posterior(self, track: int) -> tuple[Any, Any]:
        """Return the posterior of a track over time.

        Returns
        -------
        (n,) seconds since the first frame of the run, and (n, categories) posteriors, each fused
        from the views so far.

        Raises
        ------
        OutputError : there is no such track.
        """
        tracks = self.tracks.numpy("track")
        rows = np.flatnonzero(tracks == track)
        if not len(rows):
            msg = (
                f"{self.folder}: no track #{track} among {plural(len(np.unique(tracks)), 'track')}"
            )
            raise OutputError(msg)
        seconds = (self.tracks.numpy("stamp_ns")[rows] - first_stamp(self.folder)) * 1e-9
        return seconds, self.tracks.numpy("posterior")[rows]

    def labelled_frames(self) -> Iterator[LabelledFrame]:
        """Yield the frames without their points; this does not need the recording.

        Raises
        ------
        OutputError : a table is unreadable, or the run has been replaced since it was opened.
        """
        return self._finished.frames()

    def frames(self, recording: str | Path | None = None) -> Iterator[RunFrame]:
        """Yield the frames with their points, in constant memory.

        ``recording`` is the path of the recording; None means the path where it was processed.

        Raises
        ------
        RecordingError : the recording is missing or unreadable.
        OutputError : the recording has changed since it was processed, a table is unreadable, or
            the run has been replaced since it was opened.
        """
        moved = None
        if recording is not None:
            moved = Path(os.path.expanduser(recording))  # noqa: PTH111  Path fails without a home
        with open_source(self.info, moved) as source:
            shown = with_colour(self.labelled_frames(), source, self.info)
            for labelled, reading, coloured in shown:
                yield RunFrame(labelled, reading, coloured)
