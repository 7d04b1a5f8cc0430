"""Records of the planes and objects found in one frame, before tracking."""

from collections.abc import Mapping, Sequence

from shapecat.arrays import F4, U2, U4, Record, array

__all__ = [
    "CATEGORIES",
    "UNKNOWN",
    "Box",
    "Candidate",
    "Detection",
    "FullBox",
    "ImageMasks",
    "NeuralGas",
    "Perception",
    "Plane",
    "Scene",
]

CATEGORIES = ("cup", "can", "box", "bottle", "bowl", "plate", "ball")
"""The shape categories of the default model, in the order of its posteriors."""
UNKNOWN = "unknown"
"""The category of an object that fits none of the model's categories; also a label that a person
may give, and the name of the folder of such objects in a data set."""


class Plane(Record):
    """A horizontal supporting plane: the points with ``normal @ p == offset``.

    Attributes
    ----------
    normal : (3,) unit vector, sensor frame, pointing up.
    offset : metres; the height of a point above the plane is ``normal @ p - offset``.
    outline : (k, 3) metres, sensor frame: the corners of the convex outline, in order.
    area_m2 : visible area, square metres.
    height_m : height above the lowest plane of the scene, along the up direction.
    """

    normal: F4 = array("3", "f4")
    offset: float
    outline: F4 = array("k 3", "f4")
    area_m2: float
    height_m: float


class Box(Record):
    """An upright box: its z axis points up, its yaw fits the points of the object.

    Attributes
    ----------
    center : (3,) metres, sensor frame.
    size : (3,) metres, the full lengths along the axes of the box.
    orientation : (4,) quaternion x, y, z, w: the axes of the box in the sensor frame.
    """

    center: F4 = array("3", "f4")
    size: F4 = array("3", "f4")
    orientation: F4 = array("4", "f4")


class FullBox(Box):
    """The estimated box around a whole object, including its hidden part.

    Attributes
    ----------
    size_std : (3,) metres, the standard deviation of each length.
    outline : (96,) metres, the support function of the visible points about the centre, in
        horizontal directions every 3.75 degrees: a full turn from the box's x axis toward its y.
    """

    size_std: F4 = array("3", "f4")
    outline: F4 = array("k", "f4")


class Candidate(Record):
    """Points that may be one object.

    Attributes
    ----------
    indices : (n,) ascending indices into the frame, at full resolution.
    plane : index in `Scene.planes` of the plane below it; None if there is none.
    on_candidate : index in `Scene.candidates` of the candidate it stands on; None if there is none.
    support_m : height above `plane` of the surface it stands on, metres; 0 on the plane itself.
    touches_border : whether the border of the image, or the maximum range, cuts it off.
    occluded : whether a nearer surface hides part of it.
    """

    indices: U4 = array("n", "u4")
    box: Box
    plane: int | None
    on_candidate: int | None
    support_m: float
    touches_border: bool
    occluded: bool


class Scene(Record):
    """The result of detection in one frame.

    ``up`` is a (3,) unit vector in the sensor frame; ``planes`` are in ascending height.
    """

    up: F4 = array("3", "f4")
    planes: tuple[Plane, ...]
    candidates: tuple[Candidate, ...]

    def support_offset(self, candidate: Candidate) -> float:
        """Return ``up @ p``, in metres, for points p of the surface a candidate stands on.

        Without a plane, this is the bottom of the candidate's box.
        """
        if candidate.plane is None:
            return float(self.up @ candidate.box.center - candidate.box.size[2] / 2)
        return self.planes[candidate.plane].offset + candidate.support_m

    def height_of(self, candidate: Candidate) -> float:
        """Return the height of a candidate's box centre above the surface it stands on, metres."""
        return float(self.up @ candidate.box.center) - self.support_offset(candidate)


class NeuralGas(Record):
    """A graph that has learned the surface of a point cloud (thesis ch. 5).

    Attributes
    ----------
    neurons : (k, 3) metres, in the frame of the points.
    edges : (m, 2) pairs of neurons ``i < j``, each once, in lexicographic order.
    """

    neurons: F4 = array("k 3", "f4")
    edges: U2 = array("m 2", "u2")


class Detection(Record):
    """One object in one frame: everything later phases need.

    Attributes
    ----------
    gas : the surface, in the sensor frame.
    descriptor : (d,) the shape descriptor.
    posterior : (c,) probabilities, in the order of the model's categories.
    novelty : 0 for a familiar shape, above 1 for a shape unlike all categories.
    seconds : time spent on this object.
    full : the box of the whole object, sensor frame; None if only the visible box is known.
    reused_from : index of the frame from which the description is copied; None if it is new.
    """

    candidate: Candidate
    gas: NeuralGas
    descriptor: F4 = array("d", "f4")
    posterior: F4 = array("c", "f4")
    novelty: float
    seconds: float
    full: FullBox | None = None
    reused_from: int | None = None

    def category(self, categories: Sequence[str]) -> str:
        """Return the most probable of the model's categories, or unknown if novelty is above 1."""
        return UNKNOWN if self.novelty > 1 else categories[int(self.posterior.argmax())]


class ImageMasks(Record):
    """The masks of a frame's detections on the colour image taken with it.

    Attributes
    ----------
    topic, stamp_ns, log_time_ns, frame_id : as in `Frame`, but for the colour image.
    width, height : size of the image, pixels.
    boxes : left, top, width and height of each mask, pixels, by the number of the detection (from
        0); detections that the image does not show are missing.
    counts : by the same numbers, the (n,) uint32 run lengths of each mask, from
        `shapecat.colour.rle.rle_counts`; empty if they were not read.
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
    """Everything found in one frame, before tracking.

    ``seconds`` is the time spent in each stage; ``reused_from`` is the index of the frame from
    which the scene is copied, None if it is new; ``masks`` is None without a colour image.
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
