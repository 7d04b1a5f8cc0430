"""The records that stages pass on: frozen, shape-checked, read-only.

Units are metres, seconds, radians; stamps are integer nanoseconds; quaternions are x, y, z, w.
Transforms are named ``a_from_b``. The sensor frame is the coordinate frame of the sensor; a depth
camera's is the optical frame (x right, y down, z forward).
"""

from shapecat.types.frame import Camera, Frame, Pose
from shapecat.types.labelled import AnnotationBox, AnnotationFrame, LabelledFrame, LabelledObject
from shapecat.types.scene import (
    CATEGORIES,
    UNKNOWN,
    Box,
    Candidate,
    Detection,
    FullBox,
    ImageMasks,
    NeuralGas,
    Perception,
    Plane,
    Scene,
)

__all__ = [
    "CATEGORIES",
    "UNKNOWN",
    "AnnotationBox",
    "AnnotationFrame",
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
]
