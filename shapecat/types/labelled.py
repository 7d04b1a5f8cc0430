"""Records that the outputs show: the objects of a frame with the final label of their track."""

from dataclasses import dataclass
from typing import NamedTuple

from shapecat.arrays import F4, U4, Record, array
from shapecat.types.frame import Pose
from shapecat.types.scene import Box, ImageMasks, NeuralGas, Plane

__all__ = ["AnnotationBox", "AnnotationFrame", "LabelledFrame", "LabelledObject"]


class LabelledObject(Record):
    """One object in one frame as the outputs show it: a detection with its track's label.

    Attributes
    ----------
    track : number of the track.
    category, confidence : the final ones, fused from all views of the track or corrected by a
        person.
    box, gas : box of the visible part, and the graph of its surface; sensor frame.
    indices : (n,) ascending flat indices of its pixels or points in the frame.
    posterior : (c,) from this view alone.
    causal : (c,) fused from the track's views up to this frame.
    height_m : height of the visible box's centre above the surface the object stands on; NaN if
        that is unknown.
    touches_border, occluded : as in `Candidate`.
    detections : numbers of its detections in the frame, from 0; several if tracks were merged.
    full : the box of the whole object, sensor frame, estimated from the track's views; None if
        unknown.
    """

    track: int
    category: str
    confidence: float
    box: Box
    indices: U4 = array("n", "u4")
    gas: NeuralGas
    posterior: F4 = array("c", "f4")
    causal: F4 = array("c", "f4")
    height_m: float = float("nan")
    touches_border: bool = False
    occluded: bool = False
    detections: tuple[int, ...] = ()
    full: Box | None = None

    def __repr__(self) -> str:
        return f"<LabelledObject #{self.track}: {self.category}, confidence {self.confidence:.2f}>"


class LabelledFrame(Record):
    """One frame as the outputs show it, without its points.

    Attributes
    ----------
    topic, index, stamp_ns, log_time_ns, frame_id : as in `Frame`.
    fixed_from_sensor : pose of the sensor in the fixed frame; None if unknown.
    ended : tracks that ended in the previous frame of the topic.
    seconds : time spent in each stage, by its name.
    up : (3,) unit vector, sensor frame.
    reused_from : index of the earlier frame from which the scene is copied; None if it is new.
    masks : None without a colour image.
    """

    topic: str
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    fixed_from_sensor: Pose | None
    planes: tuple[Plane, ...]
    objects: tuple[LabelledObject, ...]
    ended: tuple[int, ...]
    seconds: dict[str, float]
    up: F4 = array("3", "f4")
    reused_from: int | None = None
    masks: ImageMasks | None = None


class AnnotationBox(NamedTuple):
    """The annotation of one object, as plain numbers.

    ``center``, ``size`` (metres) and ``orientation`` (x, y, z, w) are those of a `Box`, but in
    the coordinate frame `AnnotationFrame.frame_id`.
    """

    track: int
    category: str
    confidence: float
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


@dataclass(frozen=True)
class AnnotationFrame:
    """The annotations of one frame; the fields are as in `LabelledFrame`."""

    topic: str
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    objects: tuple[AnnotationBox, ...]
    ended: tuple[int, ...]
