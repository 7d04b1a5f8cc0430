"""The colour images of the review, with the masks and boxes of the objects."""

import io
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr

from shapecat.arrays import F4, U1
from shapecat.cameras.colour import COMPRESSED_FORMATS, ColourImage
from shapecat.colour.masks import Mask
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.colours import colour_of
from shapecat.outputs.png import png
from shapecat.outputs.review.columns import At, Columns, Drawing
from shapecat.outputs.review.shapes import short_label
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.types import LabelledFrame, LabelledObject

__all__ = ["Images", "Picture", "as_file", "picture_of"]

_QUALITY = 85
_OPACITY = 110
_BYTES_PER_NUMBER = 4


def as_file(image: ColourImage) -> tuple[bytes, str]:
    """Return an image file and its media type: the recorded file, or raw pixels as JPEG.

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
    """A colour image to show, with its objects.

    ``contents`` is the image file. ``masks`` is a PNG overlay of the masks, translucent, in the
    colours of the categories. Row k of ``boxes`` (n, 4), left, top, width and height in pixels,
    belongs to ``objects[k]``; objects without a mask are left out.
    """

    topic: str
    contents: bytes
    media_type: str
    masks: bytes
    boxes: F4
    objects: list[LabelledObject]


def picture_of(labelled: LabelledFrame, coloured: Coloured) -> Picture | None:
    """Return the picture of a frame; None if the colours are those of an unorganized cloud.

    Raises
    ------
    MessageError : the image is damaged.
    """
    image = coloured.view.image
    if image.height <= 1:
        return None
    visible = [
        (item, mask)
        for item, mask in zip(labelled.objects, coloured.masks, strict=True)
        if mask.pixels.size
    ]
    objects = [item for item, _ in visible]
    boxes = np.array([mask.box for _, mask in visible], np.float32).reshape(-1, 4)
    layer = _layer(visible, image.height, image.width)
    return Picture(image.topic, *as_file(image), layer, boxes, objects)


def _layer(visible: Sequence[tuple[LabelledObject, Mask]], height: int, width: int) -> bytes:
    """Return masks as a translucent PNG; Rerun would not compress a segmentation image."""
    categories = list(dict.fromkeys(item.category for item, _ in visible))
    layer = np.zeros((height, width), np.uint8)
    for item, mask in visible:
        left, top, wide, high = mask.box
        number = 1 + categories.index(item.category)
        layer[top : top + high, left : left + wide][mask.pixels] = min(number, 255)
    palette = np.array([(0, 0, 0), *map(colour_of, categories)], np.uint8)[:256]
    return png(layer, palette, np.array([0, *[_OPACITY] * (len(palette) - 1)], np.uint8), level=1)


_Boxes = tuple[F4, list[tuple[int, int, int]], list[str]]
"""Boxes (n, 4) on an image, with their colours and captions."""


class Images:
    """Writes the colour images of the frames; ``entities`` maps entities to their titles."""

    def __init__(self, columns: Columns) -> None:
        """Start without images."""
        self._columns = columns
        self.entities: dict[str, str] = {}

    def add(self, topic: str, at: At, picture: Picture) -> None:
        """Add the picture of a frame on a topic."""
        entity = rr.new_entity_path(["images", topic])
        self.entities.setdefault(entity, picture.topic)
        image, masks = (picture.contents, picture.media_type), (picture.masks, "image/png")
        for name, file, drawing in (("", image, _IMAGE), ("/masks", masks, _MASKS)):
            size = len(file[0]) // _BYTES_PER_NUMBER
            self._columns.add(f"{entity}{name}", at, file, drawing, size=size)
        tones = [colour_of(item.category) for item in picture.objects]
        boxes = (picture.boxes, tones, [short_label(item) for item in picture.objects])
        for name, drawing in (("boxes", _BOXES), ("captions", _CAPTIONS)):
            self._columns.add(f"{entity}/{name}", at, boxes, drawing, size=len(picture.boxes))


def _files(rows: Sequence[tuple[bytes, str]]) -> Iterable[rr.ComponentColumn]:
    contents, kinds = zip(*rows, strict=True)
    yield from rr.EncodedImage.columns(blob=contents, media_type=kinds)


def _boxes(rows: Sequence[_Boxes]) -> Iterable[rr.ComponentColumn]:
    boxes, colours, counts = _joined(rows)
    half = boxes[:, 2:] / 2
    columns = rr.Boxes2D.columns(centers=boxes[:, :2] + half, half_sizes=half, colors=colours)
    yield from columns.partition(counts)


def _captions(rows: Sequence[_Boxes]) -> Iterable[rr.ComponentColumn]:
    boxes, colours, counts = _joined(rows)
    columns = rr.Points2D.columns(
        positions=boxes[:, :2] + boxes[:, 2:] * np.array((0.5, 0), np.float32),
        colors=127 + colours // 2,
        labels=[text for _, _, texts in rows for text in texts],
    )
    yield from columns.partition(counts)


def _joined(rows: Sequence[_Boxes]) -> tuple[F4, U1, list[int]]:
    """Return the boxes (n, 4) and colours (n, 3) of all images, and the number in each image."""
    tones = [tone for _, tones, _ in rows for tone in tones]
    boxes = np.concatenate([boxes for boxes, _, _ in rows])
    counts = [len(texts) for _, _, texts in rows]
    return boxes, np.array(tones, np.uint8).reshape(-1, 3), counts


_IMAGE = Drawing(_files)
_MASKS = Drawing(_files, rr.EncodedImage.from_fields(draw_order=1.0))
_BOXES = Drawing(_boxes, rr.Boxes2D.from_fields(draw_order=2.0))
_CAPTIONS = Drawing(_captions, rr.Points2D.from_fields(radii=0.5, show_labels=True, draw_order=3.0))
