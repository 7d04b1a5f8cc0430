"""All detections of a stream in columns, with look-ups by frame and by track."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import merge
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.tracking.fusion import view_weights

__all__ = ["DetectionTable", "TableBuilder"]

_BLOCK = 2**16  # detections processed at once
_SET_BACK_NS = 1_000_000_000  # a clock was set back by more than this; late messages differ by less

# Type of each column, and for detections the shape of an item; "c" is the category axis.
_OF_FRAMES = {"topics": "i4", "frames": "i4", "stamps_ns": "i8", "counts": "i4"}
_OF_DETECTIONS: dict[str, tuple[str, tuple[Any, ...]]] = {
    "numbers": ("i4", ()),
    "centers": ("f8", (3,)),
    "sizes": ("f4", (3,)),
    "posteriors": ("f4", ("c",)),
    "partial": ("?", ()),
    "novelties": ("f4", ()),
    "orientations": ("f4", (4,)),
    "described": ("i4", ()),
}


@dataclass(frozen=True)
class DetectionTable:
    """All detections of a stream, in the order of the frames.

    A detection takes only about 100 bytes, because the detections of many hours are in memory at
    once. A track is given by the indices of its detections, ascending. A *row* is the index of a
    frame in this table, as opposed to its number on its topic, in ``frames``.

    Attributes
    ----------
    names : the topics of the stream.
    topics, frames, stamps_ns : (f,) index into ``names``, number and time of each frame.
    first : (f + 1,) index of the first detection of each frame, and n at the end.
    rows : (n,) index of the frame of each detection, ascending.
    numbers : (n,) number of each detection, by which `Track.detections` refers to it; in a run, its
        row in the detections table.
    centers : (n, 3) centres of the boxes, metres, in the fixed frame; in the sensor frame if its
        pose is unknown. All frames of a stream use the same coordinate frame.
    sizes : (n, 3) lengths of the boxes, metres; the third one is along the up direction.
    posteriors : (n, c) posteriors of the single views; each sums to 1.
    partial : (n,) whether the image border or an occluder cuts the object.
    novelties : (n,) novelties of the single views.
    orientations : (n, 4) unit quaternions (x, y, z, w) of the boxes, in the frame of the centres.
    described : (n,) number of the frame from which the description of each detection was copied;
        that of its own frame if it was not copied.
    """

    names: tuple[str, ...]
    topics: I4
    frames: I4
    stamps_ns: I4
    first: I4
    rows: I4
    numbers: I4
    centers: F8
    sizes: F4
    posteriors: F4
    partial: Bool
    novelties: F4
    orientations: F4
    described: I4

    def without_boxes(self) -> Self:
        """Return the detections without sizes and orientations, which a `Track` does not need."""
        nothing = np.zeros((0, 4), np.float32)
        return replace(self, sizes=nothing[:, :3], orientations=nothing)

    def axes(self, which: I4 | slice) -> F8:
        """Return the axes (k, 3, 3) of the boxes of detections ``which``, as columns."""
        quaternions = self.orientations[which]
        if len(quaternions) == 0:
            return np.zeros((0, 3, 3))
        return np.asarray(Rotation.from_quat(quaternions).as_matrix())

    def blocks(self) -> Iterator[slice]:
        """Yield slices of detections that cover all frames in order, never dividing a frame."""
        stops = np.searchsorted(self.first, np.arange(_BLOCK, len(self.rows), _BLOCK))
        bounds = np.unique([0, *self.first[stops], len(self.rows)]).tolist()
        yield from map(slice, bounds[:-1], bounds[1:])

    def of_frame(self, row: int) -> slice:
        """Return the slice of a frame's detections."""
        return slice(int(self.first[row]), int(self.first[row + 1]))

    def track_of_each(self, tracks: Sequence[I4]) -> I4:
        """Return the track index of each detection, (n,), -1 if it has none.

        ``tracks`` are the indices of the detections of each track.
        """
        owner = np.full(len(self.rows), -1, np.int32)
        for k, track in enumerate(tracks):
            owner[track] = k
        return owner

    def stamps(self, which: I4) -> I4:
        """Return the times (k,) of detections ``which`` (k,), ns."""
        return np.asarray(self.stamps_ns[self.rows[which]])

    def weights(self, track: I4) -> F8:
        """Return the weight (k,) that each detection of a ``track`` (k,) has in the fusion.

        Of detections with the same, copied description, only the first counts; others weigh 0.
        """
        topics = self.topics[self.rows[track]].astype(np.int64)
        _, first = np.unique((topics << 32) + self.described[track], return_index=True)
        new = np.zeros(len(track), np.bool_)
        new[first] = True
        return np.where(new, view_weights(self.partial[track]), 0.0)

    def of_frames(self, rows: I4) -> tuple[I4, I4]:
        """Return the detections (k,) of ``rows``, and for each the index of its row in ``rows``."""
        first, stop = self.first[rows], self.first[rows + 1]
        which = np.repeat(np.arange(len(rows)), stop - first)
        return np.arange(which.size) - (np.cumsum(stop - first) - stop)[which], which

    def positions(self, track: I4, rows: I4) -> F8:
        """Return the positions (k, 3) of a track in frames ``rows`` (k,), metres.

        They are interpolated linearly in time between its detections, ``track`` (d,).
        """
        if len(rows) == 0:
            return np.zeros((0, 3))
        # Use only detections near these frames: long tracks are queried for many short spans.
        before, after = np.searchsorted(track, self.first[[rows.min() + 1, rows.max()]])
        nearest = track[max(before - 1, 0) : after + 1]
        last = np.maximum(np.searchsorted(self.rows[nearest], rows, side="right") - 1, 0)
        a, b = nearest[last], nearest[np.minimum(last + 1, len(nearest) - 1)]
        start, stop = self.stamps(a), self.stamps(b)
        share = np.clip((self.stamps_ns[rows] - start) / np.maximum(stop - start, 1), 0, 1)
        step = self.centers[b] - self.centers[a]
        return np.asarray(self.centers[a] + share[:, None] * step)

    def frame_span(self, track: I4, max_gap_s: float) -> tuple[I4, Bool]:
        """Return the rows (k,) from a track's first to its last detection, and a mask (k,).

        The mask marks the frames with a detection. Frames in gaps longer than ``max_gap_s`` are
        left out, and so are frames of topics that never see the object. ``track`` is (d,).
        """
        frames = self.rows[track]
        gap_s = np.diff(self.stamps_ns[frames]) * 1e-9
        lengths = np.append(np.where(gap_s <= max_gap_s, np.diff(frames), 1), 1)
        rows = np.repeat(frames - (np.cumsum(lengths) - lengths), lengths) + np.arange(
            lengths.sum()
        )
        rows = rows[self.sees(track, rows)]
        return rows, np.isin(rows, frames)

    def sees(self, track: I4, rows: I4) -> Bool:
        """Return the mask (n,) of ``rows`` (n,) whose topics have detections of ``track`` (d,)."""
        return np.isin(self.topics[rows], self.topics[self.rows[track]])

    def on_topics_of(self, track: I4, which: I4) -> I4:
        """Return those detections in ``which`` whose topics have detections of ``track`` (d,)."""
        return which if len(self.names) == 1 else which[self.sees(track, self.rows[which])]


class TableBuilder:
    """Builds the `DetectionTable` of a stream from its frames, as they are read.

    ``categories`` is the number of categories in the posteriors. Columns are growing byte buffers,
    since joining arrays would need twice the memory.
    """

    def __init__(self, categories: int) -> None:
        self._names: dict[str, int] = {}
        self._bytes = {name: bytearray() for name in (*_OF_FRAMES, *_OF_DETECTIONS)}
        self._categories = categories

    def add(self, topics: Iterable[str], **columns: Any) -> None:
        """Append the next frames and their detections, each topic in recording order.

        Parameters
        ----------
        topics : the topic of each frame.
        columns : ``frames``, ``stamps_ns`` and ``counts`` (f,): number, time and number of
            detections of each frame; and the columns of the detections, as in `DetectionTable`.
        """
        names = self._names
        columns["topics"] = [names.setdefault(topic, len(names)) for topic in topics]
        for name, kind in _OF_FRAMES.items():
            self._bytes[name] += np.asarray(columns[name], kind).tobytes()
        for name, (kind, _) in _OF_DETECTIONS.items():
            self._bytes[name] += np.asarray(columns[name], kind).tobytes()

    def table(self) -> DetectionTable:
        """Return the table, the topics merged by time; the builder cannot be used afterwards."""
        of_frames = {name: self._column(name, kind) for name, kind in _OF_FRAMES.items()}
        counts = of_frames.pop("counts")
        which: Any = slice(None)
        if len(self._names) > 1:
            frames = _by_time(of_frames["topics"], of_frames["stamps_ns"])
            first = np.cumsum(counts) - counts
            which = np.concatenate([np.arange(first[k], first[k] + counts[k]) for k in frames])
            counts = counts[frames]
            of_frames = {name: values[frames] for name, values in of_frames.items()}
        return DetectionTable(
            names=tuple(self._names),
            **of_frames,
            first=np.concatenate([[0], np.cumsum(counts)]),
            rows=np.repeat(np.arange(len(counts), dtype=np.int32), counts),
            **{name: self._column(name, *kind)[which] for name, kind in _OF_DETECTIONS.items()},
        )

    def _column(self, name: str, kind: str, shape: tuple[Any, ...] = ()) -> Any:
        """Move a column to an array (n, *shape) of type ``kind``; "c" is the category axis."""
        widths = (self._categories if width == "c" else width for width in shape)
        return np.frombuffer(self._bytes.pop(name), kind).reshape(-1, *widths)


def _by_time(topics: I4, stamps_ns: I4) -> Any:
    """Return the indices (f,) that sort frames by time but keep each topic's order of recording.

    ``topics`` and ``stamps_ns`` (f,) are those of the frames. Frames that any topic recorded before
    its clock was set back come first.
    """
    streams = [np.flatnonzero(topics == topic) for topic in range(topics.max() + 1)]
    stamps, time = np.unique(stamps_ns, return_inverse=True)
    for stream in streams:
        time[stream] += len(stamps) * _times_set_back(stamps_ns[stream])
    key = time.tolist().__getitem__
    return np.fromiter(merge(*(stream.tolist() for stream in streams), key=key), np.int64)


def _times_set_back(stamps_ns: I4) -> I4:
    """Return the number of times that a clock was set back up to each frame, (f,).

    ``stamps_ns`` (f,) are those of a topic, in the order of recording. Single wrong stamps do not
    count: the two frames before must both be later than this one and the next, by more than
    `_SET_BACK_NS`.
    """
    # A jump after the first stamp or before the last one cannot be confirmed, and does not count.
    ends = ((stamps_ns.min(), stamps_ns.max()),)
    stamps = np.pad(stamps_ns, 2, constant_values=ends)
    before = np.minimum(stamps[:-4], stamps[1:-3])
    return np.asarray((np.maximum(stamps[2:-2], stamps[3:-1]) < before - _SET_BACK_NS).cumsum())
