"""Input and output records of the tracker."""

from dataclasses import replace

from shapecat.arrays import F4, F8, I4, Bool, Record, array

__all__ = ["FrameDetections", "Track"]


class FrameDetections(Record):
    """The detections of one frame as the tracker sees them; a frame may have none.

    Attributes
    ----------
    topic : the stream.
    frame : number of the frame in its stream.
    stamp_ns : time of the measurement.
    detections : (n,) the numbers by which the detections are known.
    centers : (n, 3) metres: centres of the boxes, in the fixed frame; in the sensor frame where
        the recording has no fixed one. The frame must be the same over the whole stream.
    sizes : (n, 3) metres: lengths of the boxes, the third one along the up direction.
    posteriors : (n, c) posteriors of the single views, each sums to 1.
    partial : (n,) whether the border of the image or something nearer cuts the object.
    novelties : (n,) novelty of the single views.
    axes : (n, 3, 3) the columns are the axes of the boxes, in the frame of the centres; None where
        only sizes are known.
    described : (n,) number of the frame whose view each detection repeats, its own where it was
        described itself; None where all were.
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
    axes: F8 | None = array("n 3 3", "f8", default=None)
    described: I4 | None = array("n", "i4", default=None)


class Track(Record):
    """One object over the frames of its streams, from its first to its last detection.

    Between detections it *coasts*: such a row has no detection, its centre lies on the line
    between its neighbours. A gap longer than `TrackingSettings.max_missed_s` has no rows.

    Attributes
    ----------
    id : number of the track in the recording, from 1, in order of birth.
    topics : (k,) the stream of each frame: one, or several that were tracked together.
    hits : number of rows with a detection.
    frames : (k,) numbers of the frames in their streams, in the order of time.
    stamps_ns : (k,) times of the frames.
    detections : (k,) numbers of the detections, -1 where it coasts.
    centers : (k, 3) metres, in the frame of `FrameDetections.centers`.
    causal : (k, c) fused posterior of the views up to each row.
    posterior : (c,) fused posterior of all views.
    confidence : the largest entry of `posterior`.
    novelty : fused novelty of the views; above 1 the object is none of the known.
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
        """Return some of its rows; what is said of the whole stays."""
        columns = ("topics", "frames", "stamps_ns", "detections", "centers", "causal")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    @property
    def topic(self) -> str:
        """Its stream; several are joined by a space."""
        return " ".join(sorted(set(self.topics)))
