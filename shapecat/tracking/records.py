"""The record of a track."""

from dataclasses import replace

from shapecat.arrays import F4, F8, I4, Record, array

__all__ = ["Track"]


class Track(Record):
    """One object over the frames of its topics, from its first to its last detection.

    A track has a row for each frame. In a row without a detection the track *coasts*: its centre is
    interpolated linearly in time between detections. A gap longer than
    `TrackingSettings.max_missed_s` has no rows.

    Attributes
    ----------
    id : number of the track in the recording, from 1, in order of birth.
    topics : (k,) topic of each frame: one, or several that were tracked together.
    hits : number of rows with a detection.
    frames : (k,) numbers of the frames on their topics, in temporal order.
    stamps_ns : (k,) times of the frames.
    detections : (k,) `DetectionTable.numbers` of the detection, -1 where the track coasts.
    centers : (k, 3) metres, in the coordinate frame of `DetectionTable.centers`.
    causal : (k, c) fused posterior of the views up to each row, over the c categories.
    posterior : (c,) fused posterior of all views.
    confidence : largest entry of `posterior`.
    novelty : fused novelty of all views; above 1, the object belongs to no known category.
    """

    id: int
    topics: tuple[str, ...]
    hits: int
    frames: I4 = array("k", "i4")
    stamps_ns: I4 = array("k", "i8")
    detections: I4 = array("k", "i4")
    centers: F8 = array("k 3", "f8")
    causal: F4 = array("k c", "f4")
    posterior: F4 = array("c", "f4")
    confidence: float
    novelty: float

    def part(self, rows: slice) -> "Track":
        """Return the track with only some of its rows; the fields without rows stay the same."""
        columns = ("topics", "frames", "stamps_ns", "detections", "centers", "causal")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    @property
    def topic(self) -> str:
        """The name of its topic; several names are sorted and joined by a space."""
        return " ".join(sorted(set(self.topics)))
