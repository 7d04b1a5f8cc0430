"""The records of colour cameras: an image as recorded, and its camera."""

from dataclasses import dataclass
from typing import Any

from shapecat.arrays import Record
from shapecat.types import Camera, Pose

__all__ = ["COMPRESSED_FORMATS", "ColourImage", "ColourView", "LensCamera"]

COMPRESSED_FORMATS = ("jpeg", "png")
"""Encodings whose image data is a complete image file."""


@dataclass(frozen=True)
class LensCamera:
    """A camera whose images are distorted by its lens.

    Attributes
    ----------
    pinhole : the camera without distortion.
    model : one of `shapecat.cameras.lenses.LENS_MODELS`, or empty without distortion.
    coefficients : the distortion coefficients, in OpenCV's order.
    """

    pinhole: Camera
    model: str = ""
    coefficients: tuple[float, ...] = ()


class ColourImage(Record):
    """A colour image as recorded, not decoded.

    Attributes
    ----------
    topic, stamp_ns, log_time_ns, frame_id : as in `shapecat.types.Frame`.
    encoding : ``jpeg`` or ``png`` if ``data`` is a JPEG or PNG file, otherwise a ROS encoding.
    width, height : pixels.
    step : bytes per row, for raw pixels.
    """

    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    encoding: str
    width: int
    height: int
    step: int
    data: bytes | memoryview

    def __getstate__(self) -> dict[str, Any]:
        """Return the content to pickle, with a copy of the data: pickle refuses a memoryview."""
        return vars(self) | {"data": bytes(self.data)}


class ColourView(Record):
    """A colour image that belongs to a frame of the depth sensor.

    Attributes
    ----------
    lens : the colour camera; None if it is unknown.
    colour_from_depth : pose of the depth sensor in the optical frame of the colour camera; None for
        a registered image, whose pixels (row by row) coincide with the frame's.
    """

    image: ColourImage
    lens: LensCamera | None = None
    colour_from_depth: Pose | None = None

    @property
    def registered(self) -> bool:
        """Whether pixel k of the image shows pixel (or point) k of the frame."""
        return self.colour_from_depth is None
