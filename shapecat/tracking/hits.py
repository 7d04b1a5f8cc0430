"""All detections of a stream in columns, and the frames between those of a track."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.tracking.fusion import view_weights
from shapecat.tracking.records import FrameDetections

__all__ = ["Hits"]


@dataclass(frozen=True)
class Hits:
    """All detections of a stream: ``rows`` (n,) ascending, the positions of their frames.

    ``topics`` (f,) tell frames of one topic from those of others; ``axes`` (n, 3, 3) of the boxes,
    None if those of some are not known; ``views`` (n,) tells views from those that repeat them.
    """

    frames: Sequence[FrameDetections]
    topics: I4
    rows: I4
    numbers: I4
    centers: F8
    sizes: F8
    posteriors: F8
    partial: Bool
    novelties: F8
    axes: F8 | None
    views: I4

    @classmethod
    def of(cls, frames: Sequence[FrameDetections]) -> Self:
        """Gather the detections of at least one frame."""
        filled = [frame for frame in frames if len(frame.centers)] or frames[:1]
        axes = [frame.axes for frame in filled if frame.axes is not None]
        topics = np.unique([frame.topic for frame in frames], return_inverse=True)[1]
        rows = np.repeat(np.arange(len(frames)), [len(frame.centers) for frame in frames])
        return cls(
            frames,
            topics,
            rows,
            np.concatenate([frame.detections for frame in filled]),
            np.concatenate([frame.centers for frame in filled]),
            np.concatenate([frame.sizes for frame in filled]).astype(np.float64),
            np.concatenate([frame.posteriors for frame in filled]).astype(np.float64),
            np.concatenate([frame.partial for frame in filled]),
            np.concatenate([frame.novelties for frame in filled]).astype(np.float64),
            np.concatenate(axes) if len(axes) == len(filled) else None,
            (topics[rows].astype(np.int64) << 32) + np.concatenate([_described(f) for f in filled]),
        )

    def stamps(self, hits: I4) -> I4:
        """Return the times of some hits."""
        return np.array([self.frames[r].stamp_ns for r in self.rows[hits]], np.int64)

    def weights(self, member: I4) -> F8:
        """Return how much each view of the track ``member`` counts: one that is repeated, once."""
        _, first = np.unique(self.views[member], return_index=True)
        new = np.zeros(len(member), np.bool_)
        new[first] = True
        return np.where(new, view_weights(self.partial[member]), 0.0)

    def at(self, rows: I4) -> tuple[I4, I4]:
        """Return the hits in some frames, and for each the position of its frame in ``rows``."""
        first, stop = np.searchsorted(self.rows, [rows, rows + 1])
        which = np.repeat(np.arange(len(rows)), stop - first)
        return np.arange(which.size) - (np.cumsum(stop - first) - stop)[which], which

    def places(self, member: I4, rows: I4) -> F8:
        """Return (k, 3) where the track ``member`` is in frames: on the line between its hits."""
        seen = self.rows[member]
        lines = [np.interp(rows, seen, self.centers[member, axis]) for axis in range(3)]
        return np.column_stack(lines)

    def life(self, member: I4, max_gap_s: float) -> tuple[I4, Bool]:
        """Return the frames of a track, and in which of them it is detected.

        Gaps that are longer than ``max_gap_s`` are left out, and so are topics that never see it.
        """
        seen = self.rows[member]
        gap_s = np.diff(self.stamps(member)) * 1e-9
        pieces = [
            np.arange(a, b if gap <= max_gap_s else a + 1)
            for a, b, gap in zip(seen[:-1], seen[1:], gap_s, strict=True)
        ]
        rows = np.concatenate([*pieces, seen[-1:]])
        rows = rows[self.sees(member, rows)]
        return rows, np.isin(rows, seen)

    def sees(self, member: I4, rows: I4) -> Bool:
        """Return which frames are of a topic that sees the track ``member``."""
        return np.isin(self.topics[rows], self.topics[self.rows[member]])


def _described(frame: FrameDetections) -> I4:
    own = np.full(len(frame.centers), frame.frame, np.int32)
    return own if frame.described is None else frame.described
