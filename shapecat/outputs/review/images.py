"""The colour images of the review, with the masks and boxes of the objects."""

import io
from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr

from shapecat.arrays import F4, U1
from shapecat.cameras.colour import COMPRESSED_FORMATS, ColourImage
from shapecat.colour.masks import Mask
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.colours import colour_of
from shapecat.outputs.png import png
from shapecat.outputs.review.columns import Columns, Drawing
from shapecat.outputs.review.shapes import short_label
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.types import LabelledFrame, LabelledObject

__all__ = ["Images", "mask_layer"]

_QUALITY = 85  # of JPEG
_OPACITY = 110  # of masks, from 0 to 255
_BYTES_PER_NUMBER = 4  # converts the size of a file for `Columns.add`


def _file_of(image: ColourImage) -> tuple[bytes, str]:
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


def mask_layer(visible: Sequence[tuple[LabelledObject, Mask]], height: int, width: int) -> bytes:
    """Return a PNG (height, width) of the masks, translucent in the colours of the categories.

    Rerun would not compress a segmentation image.
    """
    categories = list(dict.fromkeys(item.category for item, _ in visible))
    layer = np.zeros((height, width), np.uint8)
    for item, mask in visible:
        left, top, wide, high = mask.box
        number = 1 + categories.index(item.category)
        layer[top : top + high, left : left + wide][mask.pixels] = min(number, 255)
    palette = np.array([(0, 0, 0), *map(colour_of, categories)], np.uint8)[:256]
    return png(layer, palette, np.array([0, *[_OPACITY] * (len(palette) - 1)], np.uint8), level=1)


_Boxes = tuple[F4, list[tuple[int, int, int]], list[str]]
"""Boxes (n, 4) on an image, as left, top, width and height in pixels; colours; captions."""


class Images:
    """Writes the frames' colour images; ``entities`` maps their Rerun entity paths to titles."""

    def __init__(self, columns: Columns) -> None:
        """Start without images."""
        self._columns = columns
        self.entities: dict[str, str] = {}

    def add(self, labelled: LabelledFrame, coloured: Coloured) -> None:
        """Add the image of a frame, unless its colours are from an unorganized cloud.

        Raises
        ------
        MessageError : the image is damaged; then nothing is added.
        """
        image, at = coloured.view.image, (labelled.stamp_ns, labelled.index)
        if image.height <= 1:
            return
        visible = [
            (item, mask)
            for item, mask in zip(labelled.objects, coloured.masks, strict=True)
            if mask.pixels.size
        ]
        masks = mask_layer(visible, image.height, image.width), "image/png"
        entity = rr.new_entity_path(["images", labelled.topic])
        for name, file, drawing in (("", _file_of(image), _IMAGE), ("/masks", masks, _MASKS)):
            size = len(file[0]) // _BYTES_PER_NUMBER
            self._columns.add(f"{entity}{name}", at, file, drawing, size=size)
        boxes = (
            np.array([mask.box for _, mask in visible], np.float32).reshape(-1, 4),
            [colour_of(item.category) for item, _ in visible],
            [short_label(item) for item, _ in visible],
        )
        for name, drawing in (("boxes", _BOXES), ("captions", _CAPTIONS)):
            self._columns.add(f"{entity}/{name}", at, boxes, drawing, size=len(visible))
        self.entities.setdefault(entity, image.topic)


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
    """Return the boxes (n, 4) and colours (n, 3) of all images, and the box count of each."""
    tones = [tone for _, tones, _ in rows for tone in tones]
    boxes = np.concatenate([boxes for boxes, _, _ in rows])
    counts = [len(texts) for _, _, texts in rows]
    return boxes, np.array(tones, np.uint8).reshape(-1, 3), counts


_IMAGE = Drawing(_files)
_MASKS = Drawing(_files, rr.EncodedImage.from_fields(draw_order=1.0))
_BOXES = Drawing(_boxes, rr.Boxes2D.from_fields(draw_order=2.0))
_CAPTIONS = Drawing(_captions, rr.Points2D.from_fields(radii=0.5, show_labels=True, draw_order=3.0))
