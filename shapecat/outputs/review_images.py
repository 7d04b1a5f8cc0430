"""The colour images of the review: as they came, with the masks and boxes of the objects."""

import io
from typing import NamedTuple

import numpy as np
import rerun as rr

from shapecat.arrays import F4, U1
from shapecat.cameras.colour import COMPRESSED_FORMATS, ColourImage
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.colours import colour_of
from shapecat.outputs.exports_files import png
from shapecat.outputs.review_shapes import label
from shapecat.recordings.colour_image import pixels_of
from shapecat.types import LabelledFrame, LabelledObject

__all__ = ["Images", "Picture", "as_file", "picture_of"]

_QUALITY = 85
_OPACITY = 110


def as_file(image: ColourImage) -> tuple[bytes, str]:
    """Return an image as a file and its media type: as it came, or raw pixels as JPEG.

    Raises
    ------
    MessageError : the pixels are damaged.
    """
    if image.encoding in COMPRESSED_FORMATS:
        return bytes(image.data), f"image/{image.encoding}"
    from PIL import Image  # noqa: PLC0415  # loaded where there is colour

    file = io.BytesIO()
    Image.fromarray(pixels_of(image)).save(file, "jpeg", quality=_QUALITY)
    return file.getvalue(), "image/jpeg"


class Picture(NamedTuple):
    """A colour image as it is shown: its file, the masks as a picture, boxes (n, 4) and labels."""

    topic: str
    contents: bytes
    media_type: str
    masks: bytes
    boxes: F4
    objects: list[LabelledObject]


def picture_of(labelled: LabelledFrame, coloured: Coloured) -> Picture | None:
    """Return the picture of a frame; None where colours are no image, as those of loose points.

    Raises
    ------
    MessageError : the image is damaged.
    """
    image = coloured.view.image
    if image.height <= 1:
        return None
    shown = [
        (item, mask)
        for item, mask in zip(labelled.objects, coloured.masks, strict=True)
        if mask.pixels.size
    ]
    numbers = np.zeros((image.height, image.width), np.uint8)
    for number, (_, mask) in enumerate(shown, start=1):
        left, top, width, height = mask.box
        numbers[top : top + height, left : left + width][mask.pixels] = min(number, 255)
    objects = [item for item, _ in shown]
    boxes = np.array([mask.box for _, mask in shown], np.float32).reshape(-1, 4)
    return Picture(image.topic, *as_file(image), _layer(numbers, objects), boxes, objects)


class Images:
    """Writes the colour image of each frame. ``entities`` are those met, with their titles."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        """Begin without images."""
        self._stream = stream
        self.entities: dict[str, str] = {}

    def add(self, topic: str, picture: Picture) -> None:
        """Write a picture beside the frame of a topic, at the time that is set."""
        entity = rr.new_entity_path(["images", topic])
        self.entities.setdefault(entity, picture.topic)
        image = rr.EncodedImage(contents=picture.contents, media_type=picture.media_type)
        self._stream.log(entity, image)
        layer = rr.EncodedImage(contents=picture.masks, media_type="image/png", draw_order=1.0)
        self._stream.log(f"{entity}/masks", layer)
        boxes, colours = picture.boxes, [colour_of(item.category) for item in picture.objects]
        lighter = [[(part + 255) // 2 for part in colour] for colour in colours]
        self._stream.log(
            f"{entity}/boxes",
            rr.Boxes2D(
                array=boxes,
                array_format=rr.Box2DFormat.XYWH,
                colors=colours,
                draw_order=2.0,
            ),
        )
        self._stream.log(
            f"{entity}/captions",
            rr.Points2D(
                boxes[:, :2] + boxes[:, 2:] * np.array((0.5, 0), np.float32),
                labels=[label(item) for item in picture.objects],
                colors=lighter,
                radii=0.5,
                show_labels=True,
                draw_order=3.0,
            ),
        )


def _layer(numbers: U1, objects: list[LabelledObject]) -> bytes:
    """Return a translucent picture of masks: a segmentation image is not compressed."""
    palette = np.array([(0, 0, 0), *(colour_of(o.category) for o in objects)], np.uint8)[:256]
    alpha = np.array([0, *[_OPACITY] * (len(palette) - 1)], np.uint8)
    return png(numbers, palette, alpha, level=1)
