"""Frames of detections, written out by hand, as input of the tracker."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8, I4, Bool, Record, array
from shapecat.config import TrackingSettings
from shapecat.tracking import DetectionTable, TableBuilder, Track, track_recording

__all__ = ["FrameDetections", "frame", "gather", "track_frames"]


class FrameDetections(Record):
    """The detections (n,) of one frame, which may have none; columns are as in `DetectionTable`.

    Its ``numbers`` are ``detections`` here. If ``orientations`` is None, boxes are aligned with the
    axes; if ``described`` is None, this frame described all.
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


def frame(
    k: int,
    centers: Any,
    *,
    size: ArrayLike = (0.13, 0.09, 0.07),
    posterior: ArrayLike = (0.9, 0.1),
    **changes: Any,
) -> FrameDetections:
    """Return frame ``k``, at k / 10 seconds by default, with equal objects at ``centers`` (n, 3).

    ``changes`` are other fields of the frame.
    """
    places = np.reshape(np.asarray(centers, float), (-1, 3))
    n = len(places)
    found = FrameDetections(
        *("/depth", k, k * 10**8, np.arange(n), places),
        np.broadcast_to(size, (n, 3)),
        np.broadcast_to(posterior, (n, 2)),
        np.zeros(n, bool),
        np.full(n, 0.5),
        np.broadcast_to((0, 0, 0, 1), (n, 4)),
    )
    return replace(found, **changes)


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
            aligned = np.broadcast_to((0, 0, 0, 1), (len(frame.detections), 4))
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
                orientations=aligned if frame.orientations is None else frame.orientations,
                described=own if frame.described is None else frame.described,
            )
        yield builder.table()


def track_frames(
    frames: Iterable[FrameDetections],
    settings: TrackingSettings,
    *,
    together: Collection[str] = (),
) -> Iterator[Track]:
    """Track the detections of some frames."""
    return track_recording(gather(frames, together), settings)
