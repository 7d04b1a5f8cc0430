"""The records of colour: an image as it was recorded, and the camera that saw it."""

from dataclasses import dataclass

from shapecat.arrays import Record
from shapecat.types import Camera, Pose

__all__ = ["COMPRESSED_FORMATS", "ColourImage", "ColourView", "LensCamera"]

COMPRESSED_FORMATS = ("jpeg", "png")
"""Encodings of images that are files in themselves."""


@dataclass(frozen=True)
class LensCamera:
    """A camera whose images show the distortion of its lens.

    ``model`` is one of `shapecat.cameras.lenses.LENS_MODELS`, empty for a lens without distortion.
    """

    pinhole: Camera
    model: str = ""
    coefficients: tuple[float, ...] = ()


class ColourImage(Record):
    """A colour image as it was recorded, not decoded.

    Attributes
    ----------
    topic, stamp_ns, log_time_ns, frame_id : as of a `shapecat.types.Frame`.
    encoding : ``jpeg`` or ``png`` where ``data`` is such a file, else a ROS image encoding.
    width, height : pixels.
    step : bytes of a row of raw pixels.
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


class ColourView(Record):
    """A colour image beside a frame of the depth sensor.

    Attributes
    ----------
    lens : the camera of the image.
    colour_from_depth : where the sensor is, in the optical frame of the colour camera; None where
        the image is registered: its pixels, row by row, are those of the frame.
    """

    image: ColourImage
    lens: LensCamera | None = None
    colour_from_depth: Pose | None = None

    @property
    def registered(self) -> bool:
        """Whether pixel k of the image is pixel, or point, k of the frame."""
        return self.colour_from_depth is None
