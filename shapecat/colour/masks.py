"""Dense masks of objects on a colour image."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import I4, U4, Bool, Record, array
from shapecat.cameras.colour import LensCamera
from shapecat.colour.splatting import splat_depth
from shapecat.jit import kernel
from shapecat.types import Frame, Pose

__all__ = ["EMPTY_MASK", "Mask", "dense_masks", "union"]

_NARROW_PX = 4.0
"""Widest gap in an object that is filled, in pixels of the depth image."""
_WIDE_PX = 24.0
"""Largest distance from an unknown pixel to the object it joins, in pixels of the depth image."""
_RAGGED_PX = 5.0
"""Width, in pixels of the depth image, of the window that smooths the ragged outlines of masks."""


class Mask(Record):
    """An object's mask, cropped to its bounding box.

    ``pixels`` is (h, w) bool, (0, 0) if the object is not visible; its top-left pixel is at row
    ``top`` and column ``left`` of the image.
    """

    left: int
    top: int
    pixels: Bool = array("h w", "?")

    @property
    def box(self) -> tuple[int, int, int, int]:
        """The bounding box: left, top, width and height, pixels."""
        height, width = self.pixels.shape
        return self.left, self.top, width, height

    @property
    def area(self) -> int:
        """The number of pixels that belong to the object."""
        return int(np.count_nonzero(self.pixels))

    def full(self, height: int, width: int) -> Bool:
        """Return the mask at the size of the image: (height, width) bool."""
        result = np.zeros((height, width), bool)
        left, top, w, h = self.box
        result[top : top + h, left : left + w] = self.pixels
        return result


EMPTY_MASK = Mask(0, 0, np.zeros((0, 0), bool))
"""The mask of an object that is not visible."""


def dense_masks(
    frame: Frame,
    objects: Sequence[U4],
    lens: LensCamera | None = None,
    colour_from_depth: Pose | None = None,
) -> tuple[Mask, ...]:
    """Return the masks, on a colour image, of objects found in a depth image.

    Labelled depth pixels are projected into the colour image, where the nearest one shows. Narrow
    gaps between pixels of the same object are filled, and so are unknown pixels that an object
    surrounds. A majority filter smooths the outlines.

    Parameters
    ----------
    frame : a depth image.
    objects : for each object, (k,) uint32 flat indices of its pixels in the frame.
    lens : the colour camera.
    colour_from_depth : pose of the depth sensor in the optical frame of the colour camera. If it or
        ``lens`` is None, the image is registered: its pixels coincide with the depth image's.

    Returns
    -------
    One mask per object, in the order of ``objects``; no two masks share a pixel.

    Raises
    ------
    ValueError : the frame is not a depth image, or the distortion model is not known.
    """
    if frame.depth is None or frame.camera is None:
        msg = "masks need a depth image"
        raise ValueError(msg)
    if colour_from_depth is None or lens is None:
        labels: I4 = np.where(frame.depth > 0, 0, -1).astype(np.int32)
        boxes: I4 = np.zeros((len(objects) + 1, 4), np.int64)
        for number, indices in enumerate(objects, start=1):
            if len(indices):
                labels.reshape(-1)[indices] = number
                rows, columns = np.divmod(indices, labels.shape[1])
                boxes[number, :2] = columns.min(), rows.min()
                boxes[number, 2:] = columns.max() + 1, rows.max() + 1
        return _labelled_masks(labels, boxes)
    scale = lens.pinhole.fx / frame.camera.fx
    left, top, labels, boxes = splat_depth(
        frame.depth, frame.camera, objects, lens, colour_from_depth
    )
    return _labelled_masks(labels, boxes, scale, corner=(left, top))


def _labelled_masks(
    labels: I4, boxes: I4, scale: float = 1.0, *, corner: tuple[int, int] = (0, 0)
) -> tuple[Mask, ...]:
    """Return the dense mask of each label, from 1 to n.

    Parameters
    ----------
    labels : (h, w) labels of the objects, from 1; 0 for other surfaces, -1 where nothing is known.
        Its gaps are filled in place.
    boxes : (n + 1, 4) the bounding box of each label: left, top, right + 1, bottom + 1; zeros in
        row 0, and for labels that do not occur.
    scale : pixels of the colour image per pixel of the depth image.
    corner : column and row, in the image, of the first pixel of ``labels``.
    """
    narrow, wide = max(1, round(_NARROW_PX * scale)), max(1, round(_WIDE_PX * scale))
    for box in boxes[boxes[:, 2] > 0].tolist():
        _fill(labels, tuple(box), narrow, wide)
    radius = max(1, round(_RAGGED_PX * scale / 2))
    box_list = boxes.tolist()
    return tuple(
        _smoothed(labels, label, box_list[label], radius, corner) for label in range(1, len(boxes))
    )


def _smoothed(labels: I4, label: int, box: list[int], radius: int, corner: tuple[int, int]) -> Mask:
    """Return the mask of a label after a majority filter.

    ``labels`` (h, w) are in a window at ``corner`` (left, top) of the image; ``box`` is left, top,
    right + 1, bottom + 1 of the label in the window; ``radius`` is half the width of the filter.
    """
    left, top, right, bottom = box
    if right <= left:
        return EMPTY_MASK
    left, top = max(0, left - radius), max(0, top - radius)
    around = labels[top : bottom + radius, left : right + radius]
    pixels = np.zeros(around.shape, np.bool_)
    west, north, east, south = _majority(around, label, radius, pixels)
    if east <= west:
        return EMPTY_MASK
    left, top = left + corner[0], top + corner[1]
    return Mask(left + west, top + north, pixels[north:south, west:east])


def union(masks: Sequence[Mask]) -> Mask:
    """Return the union of masks of one image."""
    nonempty = [mask for mask in masks if mask.pixels.size]
    if len(nonempty) < 2:
        return nonempty[0] if nonempty else EMPTY_MASK
    left, top = min(mask.left for mask in nonempty), min(mask.top for mask in nonempty)
    right = max(mask.left + mask.box[2] for mask in nonempty)
    bottom = max(mask.top + mask.box[3] for mask in nonempty)
    pixels = np.zeros((bottom - top, right - left), bool)
    for mask in nonempty:
        x, y, width, height = mask.left - left, mask.top - top, *mask.box[2:]
        pixels[y : y + height, x : x + width] |= mask.pixels
    return Mask(left, top, pixels)


@kernel(inner=True)
def _update_last_object(label: int, packed: int) -> int:
    """Return ``packed`` updated with the label of the next pixel.

    ``packed`` describes the last object encountered: its label in the upper 16 bits, 0 if none, and
    below them 4 times its distance in pixels, plus 1 if a pixel of label 0 lies between.
    """
    return label << 16 if label > 0 else (packed + 4) | (label == 0)


@kernel(inner=True)
def _update_row(labels: I4, packed: I4, result: I4) -> None:
    """Apply `_update_last_object` to all pixels of a row, ``labels`` (w,).

    ``packed`` (w,) are the states before, ``result`` (w,) those after.
    """
    for u in range(labels.size):
        result[u] = _update_last_object(labels[u], packed[u])


@kernel
def _fill(labels: I4, region: tuple[int, int, int, int], narrow: int, wide: int) -> None:
    """Within a region, give pixels of label 0 or -1 the label of the object that surrounds them.

    This takes one forward and one backward pass. ``labels`` (h, w) is changed in place; ``region``
    is left, top, right + 1, bottom + 1; ``narrow`` and ``wide`` are as in `_surrounding`. A pixel
    changes only after its old label has been passed on in all four directions.
    """
    left, top, right, bottom = region
    height, width = bottom - top, right - left
    west = np.zeros((height, width + 1), np.int32)  # states from the left
    north = np.zeros((height + 1, width), np.int32)  # states from above
    for v in range(height):
        row = labels[top + v, left:right]
        _update_row(row, north[v], north[v + 1])
        for u in range(width):
            west[v, u + 1] = _update_last_object(row[u], west[v, u])
    east, south = np.zeros(width + 1, np.int32), np.zeros((2, width), np.int32)
    for v in range(height - 1, -1, -1):
        row, below = labels[top + v, left:right], south[v % 2]
        _update_row(row, south[(v + 1) % 2], below)
        for u in range(width - 1, -1, -1):
            label = row[u]
            east[u] = _update_last_object(label, east[u + 1])
            if label < 0 or (label == 0 and west[v, u + 1] >> 16 == east[u] >> 16):
                w, n = west[v, u + 1], north[v + 1, u]
                surrounding = _surrounding(label, w, east[u], n, below[u], narrow, wide)
                if surrounding > 0:
                    row[u] = surrounding


@kernel(inner=True)
def _surrounding(label: int, w: int, e: int, n: int, s: int, narrow: int, wide: int) -> int:
    """Return the object that surrounds a pixel of label 0 or -1; the label itself if none does.

    ``w``, ``e``, ``n`` and ``s`` are from `_update_last_object`, for the four directions. An object
    surrounds a pixel of label 0 if the gap at the pixel is at most ``narrow`` pixels along both
    axes. For label -1, one axis is enough, or the object on three sides within ``wide`` pixels,
    with no label 0 in between.
    """
    across = w >> 16 if w >> 16 == e >> 16 and _gap(w) + _gap(e) <= narrow + 1 else 0
    along = n >> 16 if n >> 16 == s >> 16 and _gap(n) + _gap(s) <= narrow + 1 else 0
    if label == 0:
        return across if across == along else 0
    if across > 0 or along > 0:
        return across if across > 0 else along
    candidate = w >> 16 if w >> 16 == e >> 16 or w >> 16 == n >> 16 else s >> 16
    sides = 0
    for packed in (w, e, n, s):
        sides += packed >> 16 == candidate and not packed & 1 and _gap(packed) <= wide
    return candidate if sides >= 3 and candidate > 0 else -1


@kernel(inner=True)
def _gap(packed: int) -> int:
    """Return the distance in a state of `_update_last_object`, pixels."""
    return (packed & 0xFFFF) >> 2


@kernel
def _majority(labels: I4, label: int, radius: int, pixels: Bool) -> tuple[int, int, int, int]:
    """Set each of ``pixels`` (h, w) if most pixels of the square around it have the label.

    ``labels`` (h, w) are those of the pixels. The square extends ``radius`` pixels to each side;
    only its part within ``labels`` counts. Returns left, top, right + 1 and bottom + 1 of the
    pixels that are set; (w, h, 0, 0) if none is.
    """
    height, width = labels.shape
    west, north, east, south = width, height, 0, 0
    column = np.zeros(width + 2 * radius, np.int32)  # pixels of the label, in the rows around
    middle = column[radius : radius + width]
    at = np.arange(width)
    columns = np.minimum(width, at + radius + 1) - np.maximum(0, at - radius)
    for v in range(-radius, height):
        if v + radius < height:
            _count(labels[v + radius], label, 1, middle)
        if v > radius:
            _count(labels[v - radius - 1], label, -1, middle)
        if v < 0:
            continue
        count = np.zeros(width, np.int32)
        for shift in range(2 * radius + 1):
            for u in range(width):
                count[u] += column[u + shift]
        rows = min(height, v + radius + 1) - max(0, v - radius)
        row = pixels[v]
        for u in range(width):
            row[u] = 2 * count[u] > rows * columns[u]
        first, last = 0, width
        while first < width and not row[first]:
            first += 1
        while last > first and not row[last - 1]:
            last -= 1
        if last > first:
            west, east = min(west, first), max(east, last)
            north, south = min(north, v), v + 1
    return west, north, east, south


@kernel(inner=True)
def _count(row: I4, label: int, one: int, counts: I4) -> None:
    """Add ``one``, which is 1 or -1, to the count of each column whose pixel has the label.

    ``row`` (w,) are the labels; ``counts`` (w,) is changed in place.
    """
    for u in range(row.size):
        counts[u] += one if row[u] == label else 0
