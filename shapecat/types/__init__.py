"""The records that stages pass on: frozen, shape-checked, read-only.

Units are metres, seconds, radians; stamps are integer nanoseconds; quaternions are x, y, z, w.
Transforms are named ``a_from_b``. "Sensor frame" is the frame named by ``frame_id``; a depth
camera's is the optical frame (x right, y down, z forward).
"""

from shapecat.types.found import (
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
from shapecat.types.readings import Camera, Frame, Pose
from shapecat.types.shown import LabelledFrame, LabelledObject, ShownBox, ShownFrame

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
