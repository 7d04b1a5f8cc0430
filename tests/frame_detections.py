"""Frames of detections, written out by hand, as input of the tracker."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool, Record, array
from shapecat.config import TrackingSettings
from shapecat.tracking import DetectionTable, TableBuilder, Track, track_recording

__all__ = ["FrameDetections", "gather", "track_frames"]


class FrameDetections(Record):
    """The detections (n,) of one frame, which may have none; columns are as in `DetectionTable`.

    ``detections`` are its ``numbers``. Without ``described``, all were described themselves.
    """

    topic: str
    frame: int
    stamp_ns: int
    detections: I4 = array("n", "i4")
    centers: F8 = array("n 3", "f8")
    sizes: F4 = array("n 3", "f4")
    posteriors: F4 = array("n c", "f4")
    partial: Bool = array("n", "?")
    novelties: F4 = array("n", "f4")
    orientations: F4 | None = array("n 4", "f4", default=None)
    described: I4 | None = array("n", "i4", default=None)


def gather(
    frames: Iterable[FrameDetections], together: Collection[str] = ()
) -> Iterator[DetectionTable]:
    """Yield the table of each stream; the topics ``together`` form one stream."""
    streams: dict[str, list[FrameDetections]] = {}
    for frame in frames:
        name = "" if frame.topic in together else frame.topic
        streams.setdefault(name, []).append(frame)
    for stream in streams.values():
        builder = TableBuilder(max(frame.posteriors.shape[1] for frame in stream))
        for frame in stream:
            own = np.full(len(frame.detections), frame.frame)
            unknown = np.full((len(frame.detections), 4), np.nan)
            builder.add(
                [frame.topic],
                frames=[frame.frame],
                stamps_ns=[frame.stamp_ns],
                counts=[len(frame.detections)],
                numbers=frame.detections,
                centers=frame.centers,
                sizes=frame.sizes,
                posteriors=frame.posteriors,
                partial=frame.partial,
                novelties=frame.novelties,
                orientations=unknown if frame.orientations is None else frame.orientations,
                described=own if frame.described is None else frame.described,
            )
        table = builder.table()
        known = table.orientations is not None and not np.isnan(table.orientations).any()
        yield table if known else replace(table, orientations=None)


def track_frames(
    frames: Iterable[FrameDetections],
    settings: TrackingSettings,
    *,
    together: Collection[str] = (),
) -> Iterator[Track]:
    """Track the detections of some frames."""
    return track_recording(gather(frames, together), settings)
