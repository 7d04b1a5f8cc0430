"""The detections of a run's tracks, for comparison with another run."""

from collections.abc import Iterator
from itertools import compress, groupby
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from shapecat.arrays import F4, F8, I4
from shapecat.runs.tables.reading import frame_rows, misfit, numbers, opened, read_row_groups

__all__ = ["TrackDetections", "extents_of", "read_track_detections"]

_SAMPLES = 40
"""Approximate number of detections of each track from which its size is computed."""

_Moment = tuple[str, int, int]
"""A frame: its topic, its stamp (ns), and its index, from 0, among the frames with this stamp."""


class TrackDetections(NamedTuple):
    """All detections of the tracks of a run, sorted by topic and time.

    Attributes
    ----------
    tracks, frames, detections : (n,) track, frame and detection numbers.
    moments : the `_Moment` of each detection.
    centers : (n, 3) metres, in the fixed frame, or the sensor frame if there is none.
    rows : for each `_Moment`, the slice of its detections in the arrays.
    """

    tracks: I4
    moments: list[_Moment]
    frames: I4
    detections: I4
    centers: F8
    rows: dict[_Moment, slice]


def read_track_detections(folder: Path) -> TrackDetections:
    """Read the detections of the tracks of a run.

    Raises
    ------
    OutputError : the table of tracks is unreadable.
    """
    columns = ["track", "topic", "frame", "stamp_ns", "detection", "center_fixed"]
    with opened(folder / "tracks.parquet", columns=columns) as file:
        table = file.read(columns=columns)
    table = table.sort_by([(name, "ascending") for name in ("topic", "stamp_ns", "frame")])
    seen = table["detection"].is_valid()
    moments = list(compress(_moments(table), seen.to_pylist()))
    table = table.filter(seen)
    starts = [k for k, moment in enumerate(moments) if not k or moment != moments[k - 1]]
    rows = map(slice, starts, [*starts[1:], len(moments)])
    return TrackDetections(
        numbers(table["track"]),
        moments,
        numbers(table["frame"]),
        numbers(table["detection"]),
        numbers(table["center_fixed"]).reshape(-1, 3).astype(np.float64),
        dict(zip((moments[k] for k in starts), rows, strict=True)),
    )


def _moments(table: pa.Table) -> Iterator[_Moment]:
    """Yield the moment of each row of a sorted table of tracks."""
    cells = (table[name].to_pylist() for name in ("topic", "stamp_ns", "frame"))
    for (topic, stamp), rows in groupby(zip(*cells, strict=True), key=itemgetter(0, 1)):
        places: dict[int, int] = {}
        for *_, frame in rows:
            yield topic, stamp, places.setdefault(frame, len(places))


def extents_of(folder: Path, tracks: TrackDetections) -> dict[int, tuple[float, float]]:
    """Return the larger horizontal side and the largest side of each track's median box, metres.

    The median is over up to about `_SAMPLES` visible boxes of the track.

    Raises
    ------
    OutputError : the table of detections is unreadable, or lacks detections of a track.
    """
    rows_of: dict[tuple[str, int], list[int]] = {}
    for track in np.unique(tracks.tracks):
        rows = np.flatnonzero(tracks.tracks == track)
        for row in rows[:: max(1, len(rows) // _SAMPLES)].tolist():
            rows_of.setdefault((tracks.moments[row][0], int(tracks.frames[row])), []).append(row)
    sizes: dict[int, list[F4]] = {}
    for group in read_row_groups(folder / "detections.parquet", ["topic", "frame", "size"]):
        size = numbers(group["size"]).reshape(-1, 3)
        for key, span in frame_rows(group).items():
            for row in rows_of.pop(key, ()):
                at = span.start + int(tracks.detections[row])
                if at >= span.stop:
                    raise misfit(folder)
                sizes.setdefault(int(tracks.tracks[row]), []).append(size[at])
    if rows_of:
        raise misfit(folder)
    middles = {track: np.median(np.stack(extent), axis=0) for track, extent in sizes.items()}
    return {t: (float(max(m[:2])), float(max(m))) for t, m in middles.items()}
