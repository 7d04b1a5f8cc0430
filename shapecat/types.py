"""The records that stages pass on: frozen, shape-checked, read-only.

Units are metres, seconds, radians; stamps are integer nanoseconds; quaternions are x, y, z, w.
Transforms are named ``a_from_b``. "Sensor frame" is the frame named by ``frame_id``; a depth
camera's is the optical frame (x right, y down, z forward).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, U2, U4, Record, array

__all__ = [
    "CATEGORIES",
    "UNKNOWN",
    "Box",
    "Camera",
    "Candidate",
    "Detection",
    "Frame",
    "FullBox",
    "ImageMasks",
    "LabelledFrame",
    "LabelledObject",
    "NeuralGas",
    "Perception",
    "Plane",
    "Pose",
    "Scene",
    "ShownBox",
    "ShownFrame",
]

CATEGORIES = ("cup", "can", "box", "bottle", "bowl", "plate", "ball")
"""The shape categories of the default model, in the order of every posterior."""
UNKNOWN = "unknown"
"""Category of an object that is of none of the model's; label and folder of shapes of none."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: pixel (u, v) sees the ray ((u - cx) / fx, (v - cy) / fy, 1)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


class Pose(Record):
    """A rigid transform ``a_from_b``: ``p_a = rotation @ p_b + translation``."""

    rotation: F8 = array("3 3", "f8")
    translation: F8 = array("3", "f8")


class Frame(Record):
    """One reading of a depth sensor.

    Either organized, ``depth`` with its ``camera``, or unorganized, ``points``; never both.
    Indices into a frame count pixels row by row, or points.

    Attributes
    ----------
    topic : the stream it came from.
    index : its number in that stream, from 0, counting skipped frames too.
    stamp_ns : time of the measurement (``header.stamp``).
    log_time_ns : time it was recorded.
    frame_id : name of the sensor frame.
    depth : (h, w) metres along the optical axis; 0 where there is no reading, never NaN.
    points : (n, 3) metres, sensor frame, finite; rows of NaN where there is no reading.
    """

    topic: str
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    depth: F4 | None = array("h w", "f4", default=None)
    camera: Camera | None = None
    points: F4 | None = array("n 3", "f4", default=None)

    def __post_init__(self) -> None:
        """Check that the frame is of exactly one kind."""
        super().__post_init__()
        if (self.depth is None) == (self.points is None):
            msg = "a Frame has either depth or points"
            raise ValueError(msg)
        if self.depth is not None and (
            self.camera is None or self.depth.shape != (self.camera.height, self.camera.width)
        ):
            msg = f"depth {self.depth.shape} needs a camera of the same size, got {self.camera}"
            raise ValueError(msg)

    @property
    def organized(self) -> bool:
        """Whether the frame is a depth image."""
        return self.depth is not None

    def xyz(self, indices: U4 | None = None) -> F4:
        """Return the points at ``indices`` (all by default): (n, 3) metres, sensor frame.

        Points without a reading are rows of NaN.
        """
        if self.depth is None or self.camera is None:
            points = self.points if self.points is not None else np.zeros((0, 3), np.float32)
            return points if indices is None else points[indices]
        camera, flat = self.camera, self.depth.reshape(-1)
        pixel = np.arange(flat.size) if indices is None else np.asarray(indices, np.int64)
        z = flat[pixel]
        v, u = np.divmod(pixel, camera.width)
        z = np.where(z > 0, z, np.float32(np.nan))
        result = np.zeros((pixel.size, 3), np.float32)
        result[:, 0] = (u - camera.cx) / camera.fx * z
        result[:, 1] = (v - camera.cy) / camera.fy * z
        result[:, 2] = z
        return result


class Plane(Record):
    """A horizontal supporting plane: the points with ``normal @ p == offset``.

    Attributes
    ----------
    normal : (3,) unit vector, sensor frame, pointing up.
    offset : metres; the height of a point above the plane is ``normal @ p - offset``.
    outline : (k, 3) metres, sensor frame: corners of its convex outline, in order.
    height_m : height above the lowest plane of the scene, along the up direction.
    """

    normal: F4 = array("3", "f4")
    offset: float
    outline: F4 = array("k 3", "f4")
    area_m2: float
    height_m: float


class Box(Record):
    """An oriented box: its z axis is up, its yaw follows the points.

    ``center`` (3,) metres and ``orientation`` (x, y, z, w) of the box axes in the sensor frame;
    ``size`` (3,) metres, full lengths along the box axes.
    """

    center: F4 = array("3", "f4")
    size: F4 = array("3", "f4")
    orientation: F4 = array("4", "f4")


class FullBox(Box):
    """The estimated box around a whole object, with its hidden part.

    Attributes
    ----------
    size_std : (3,) metres, the standard deviation of each length.
    outline : (96,) metres, how far what is seen reaches from the centre in as many directions
        around, from the first axis of the box towards the second.
    """

    size_std: F4 = array("3", "f4")
    outline: F4 = array("k", "f4")


class Candidate(Record):
    """Points that may be one object.

    Attributes
    ----------
    indices : (n,) ascending indices into the frame, at full resolution.
    plane : position of the plane it stands on in `Scene.planes`; None if on none.
    on_candidate : position of the candidate it stands on in `Scene.candidates`, or None.
    support_m : height of what it stands on above `plane`, metres (0 when it stands on the plane).
    touches_border : it is cut by the border of the image, or where the range of readings ends.
    occluded : something nearer hides a part of it.
    """

    indices: U4 = array("n", "u4")
    box: Box
    plane: int | None
    on_candidate: int | None
    support_m: float
    touches_border: bool
    occluded: bool


class Scene(Record):
    """The result of the detection in one frame.

    ``up`` is a (3,) unit vector in the sensor frame; ``planes`` ascend in height.
    """

    up: F4 = array("3", "f4")
    planes: tuple[Plane, ...]
    candidates: tuple[Candidate, ...]

    def support_offset(self, candidate: Candidate) -> float:
        """Return how far along ``up`` lies what a candidate stands on; its bottom if unseen."""
        if candidate.plane is None:
            return float(self.up @ candidate.box.center - candidate.box.size[2] / 2)
        return self.planes[candidate.plane].offset + candidate.support_m

    def height_of(self, candidate: Candidate) -> float:
        """Return how far the centre of a candidate's box is above what it stands on, in metres."""
        return float(self.up @ candidate.box.center) - self.support_offset(candidate)


class NeuralGas(Record):
    """A graph that has learned the surface of a point cloud (thesis ch. 5).

    ``neurons`` (k, 3) metres, in the frame of the points; ``edges`` (m, 2) pairs of neurons with
    ``i < j``, each once, in lexicographic order.
    """

    neurons: F4 = array("k 3", "f4")
    edges: U2 = array("m 2", "u2")


class Detection(Record):
    """One object in one frame: everything later phases need.

    ``neurons`` of ``gas`` are in the sensor frame; ``posterior`` sums to 1 in the order of the
    model's categories; ``novelty`` is 0 for a familiar shape and above 1 beyond the threshold;
    ``full`` is in the sensor frame, None where only the visible box is known; ``reused_from`` is
    the index of the frame whose description it repeats, None if it has its own.
    """

    candidate: Candidate
    gas: NeuralGas
    descriptor: F4 = array("d", "f4")
    posterior: F4 = array("c", "f4")
    novelty: float
    seconds: float
    full: FullBox | None = None
    reused_from: int | None = None


class ImageMasks(Record):
    """The pixels of the detections of a frame on the colour image beside it.

    Attributes
    ----------
    topic, stamp_ns, log_time_ns, frame_id : of the image.
    width, height : of the image, pixels.
    boxes : left, top, width and height, pixels, of the mask of each detection on the image.
    counts : (n,) uint32, the run lengths of each of them, as of `shapecat.colour.rle.rle_counts`.
    """

    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    width: int
    height: int
    boxes: Mapping[int, tuple[int, int, int, int]]
    counts: Mapping[int, U4]


class Perception(Record):
    """All that is known of one frame before anything is followed over time.

    ``reused_from`` is the index of the frame whose scene it repeats, None if it has its own;
    ``masks`` are None without a colour image.
    """

    topic: str
    index: int
    stamp_ns: int
    frame_id: str
    scene: Scene
    detections: tuple[Detection, ...]
    seconds: dict[str, float]
    reused_from: int | None = None
    masks: ImageMasks | None = None


class LabelledObject(Record):
    """One object in one frame as the outputs show it: a detection with its track's label.

    ``box`` is in the sensor frame, as are the ``neurons`` of ``gas``; ``posterior`` is this single
    view's, ``causal`` the track's up to this frame; ``confidence`` and ``category`` are final.
    ``height_m`` is the height of the centre above what it stands on, NaN if on nothing;
    ``detections`` are its rows of the frame, several where tracks were merged; ``full`` is the box
    around all of it, as the views of its track tell, if that is known.
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


class LabelledFrame(Record):
    """One frame as the outputs show it, without its points.

    ``fixed_from_sensor`` is None where the recording has no fixed frame; ``ended`` names the
    tracks shown in an earlier frame of the topic that are not seen again; ``up`` (3,) is the unit
    vector up in the sensor frame; ``reused_from`` is the index of the frame that shows the same,
    None if there is none before it; ``masks`` are None without a colour image.
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
    up: F4 | None = array("3", "f4", default=None)
    reused_from: int | None = None
    masks: ImageMasks | None = None


class ShownBox(NamedTuple):
    """The annotation of one object, as plain numbers.

    ``center`` and ``size`` in metres, ``orientation`` x, y, z, w, as in `Box`; sensor frame.
    """

    track: int
    category: str
    confidence: float
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


@dataclass(frozen=True)
class ShownFrame:
    """The annotations of one frame; the fields are those of `LabelledFrame`."""

    topic: str
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    objects: tuple[ShownBox, ...]
    ended: tuple[int, ...]
