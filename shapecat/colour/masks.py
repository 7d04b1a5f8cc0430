"""Dense masks of objects on a colour image."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shapecat.arrays import I4, U4, Bool, Record, array
from shapecat.cameras.colour import LensCamera
from shapecat.colour.projection import splat_depth
from shapecat.jit import kernel
from shapecat.types import Frame, Pose

__all__ = ["NOTHING", "Mask", "dense_masks", "labelled_masks", "united"]

_NARROW_PX = 4.0
"""Gaps in an object that are not wider, in pixels of the depth image, are closed."""
_WIDE_PX = 24.0
"""So far, in pixels of the depth image, unknown pixels look for the object around them."""
_RAGGED_PX = 5.0
"""Width, in pixels of the depth image, of the window that smooths the ragged outlines of depth."""


class Mask(Record):
    """The pixels of an object on an image: ``pixels`` (h, w) bool from row ``top``, ``left`` on.

    An object that is not seen has no pixels: (0, 0).
    """

    left: int
    top: int
    pixels: Bool = array("h w", "?")

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, width and height, pixels."""
        height, width = self.pixels.shape
        return self.left, self.top, width, height

    @property
    def area(self) -> int:
        """The number of its pixels."""
        return int(np.count_nonzero(self.pixels))

    def full(self, height: int, width: int) -> Bool:
        """Return (height, width) bool: the mask in its image."""
        result = np.zeros((height, width), bool)
        left, top, w, h = self.box
        result[top : top + h, left : left + w] = self.pixels
        return result


NOTHING = Mask(0, 0, np.zeros((0, 0), bool))
"""The mask of what is not seen."""


def dense_masks(
    frame: Frame,
    objects: Sequence[U4],
    lens: LensCamera | None = None,
    colour_from_depth: Pose | None = None,
) -> tuple[Mask, ...]:
    """Return what a colour camera sees of objects that a depth image knows.

    Labelled depth pixels are projected into the colour image, where the nearest shows; what is
    narrow and between pixels of the same object belongs to it, and so do pixels of which nothing
    is known, that it surrounds.

    Parameters
    ----------
    frame : a depth image.
    objects : indices of the pixels of each object.
    lens : the colour camera; not needed for a registered image.
    colour_from_depth : pose of the sensor in the optical frame of the colour camera; None where
        the image is registered: its pixels are those of the depth image.

    Raises
    ------
    ValueError : the frame is no depth image.
    """
    if frame.depth is None or frame.camera is None:
        msg = "masks need a depth image"
        raise ValueError(msg)
    if colour_from_depth is None or lens is None:
        labels = np.where(frame.depth > 0, 0, -1).astype(np.int32)
        for number, indices in enumerate(objects, start=1):
            labels.reshape(-1)[indices] = number
        return labelled_masks(labels, len(objects))
    scale = lens.pinhole.fx / frame.camera.fx
    painted = splat_depth(frame.depth, frame.camera, objects, lens, colour_from_depth)
    masks = labelled_masks(painted.labels, len(objects), scale)
    return tuple(
        replace(mask, left=mask.left + painted.left, top=mask.top + painted.top)
        if mask.pixels.size
        else mask
        for mask in masks
    )


def labelled_masks(seen: I4, count: int, scale: float = 1.0) -> tuple[Mask, ...]:
    """Return the dense mask of each label.

    Parameters
    ----------
    seen : (h, w) labels from 1, 0 for what is none, -1 where nothing is known.
    count : of labels.
    scale : pixels of the image to a pixel of the depth image.
    """
    boxes = np.zeros((count + 1, 4), np.int64)
    _bounds(seen, boxes)
    narrow, wide = max(1, round(_NARROW_PX * scale)), max(1, round(_WIDE_PX * scale))
    filled = seen.copy()
    for box in boxes[boxes[:, 2] > 0].tolist():
        _fill(seen, tuple(box), narrow, wide, filled)
    reach = max(1, round(_RAGGED_PX * scale / 2))
    return tuple(
        _smoothed(filled, label, boxes[label].tolist(), reach) for label in range(1, count + 1)
    )


def _smoothed(filled: I4, label: int, box: list[int], reach: int) -> Mask:
    """Return the pixels around which most others are of the label; no two labels share one."""
    left, top, right, bottom = box
    if right <= left:
        return NOTHING
    left, top = max(0, left - reach), max(0, top - reach)
    around = filled[top : bottom + reach, left : right + reach]
    pixels = np.zeros(around.shape, np.bool_)
    west, north, east, south = _majority(around, label, reach, pixels)
    if east <= west:
        return NOTHING
    return Mask(left + west, top + north, pixels[north:south, west:east])


def united(masks: Sequence[Mask]) -> Mask:
    """Return the pixels of any of some masks of one image."""
    seen = [mask for mask in masks if mask.pixels.size]
    if len(seen) < 2:
        return seen[0] if seen else NOTHING
    left, top = min(mask.left for mask in seen), min(mask.top for mask in seen)
    right = max(mask.left + mask.box[2] for mask in seen)
    bottom = max(mask.top + mask.box[3] for mask in seen)
    pixels = np.zeros((bottom - top, right - left), bool)
    for mask in seen:
        x, y, width, height = mask.left - left, mask.top - top, *mask.box[2:]
        pixels[y : y + height, x : x + width] |= mask.pixels
    return Mask(left, top, pixels)


@kernel
def _bounds(seen: I4, boxes: I4) -> None:
    """Find left, top, and one more than right and bottom, of each label."""
    for label in range(boxes.shape[0]):
        boxes[label] = seen.shape[1], seen.shape[0], 0, 0
    for v in range(seen.shape[0]):
        for u in range(seen.shape[1]):
            label = seen[v, u]
            if label > 0:
                box = boxes[label]
                box[0], box[1] = min(box[0], u), min(box[1], v)
                box[2], box[3] = max(box[2], u + 1), max(box[3], v + 1)
    for label in range(boxes.shape[0]):
        if boxes[label, 2] == 0:
            boxes[label] = 0


@kernel
def _step(label: int, packed: int) -> int:
    """Move one pixel on: ``packed`` tells of the last object, how far it is, what was between.

    It is 4 times the distance, and 1 where a pixel was seen to be of no object; the object is
    in the upper half.
    """
    if label > 0:
        return label << 32
    far = packed + 4
    return far | 1 if label == 0 else far


@kernel
def _fill(seen: I4, region: tuple[int, int, int, int], narrow: int, wide: int, filled: I4) -> None:
    """Give objects the pixels of no object that they surround in a region: a sweep there, one back.

    ``region`` is left, top, and one more than right and bottom.
    """
    left, top, right, bottom = region
    west = np.zeros((bottom - top, right - left), np.int64)
    north = np.zeros((bottom - top, right - left), np.int64)
    above = np.zeros(right - left, np.int64)
    for v in range(top, bottom):
        packed = 0
        for u in range(left, right):
            label = int(seen[v, u])
            packed = _step(label, packed)
            above[u - left] = _step(label, above[u - left])
            west[v - top, u - left], north[v - top, u - left] = packed, above[u - left]
    below = np.zeros(right - left, np.int64)
    for v in range(bottom - 1, top - 1, -1):
        packed = 0
        for u in range(right - 1, left - 1, -1):
            label = int(seen[v, u])
            packed = _step(label, packed)
            below[u - left] = _step(label, below[u - left])
            if label <= 0:
                w, n = west[v - top, u - left], north[v - top, u - left]
                found = _surrounding(label, w, packed, n, below[u - left], narrow, wide)
                if found > 0:
                    filled[v, u] = found


@kernel
def _surrounding(label: int, w: int, e: int, n: int, s: int, narrow: int, wide: int) -> int:
    """Return the object that a pixel of none belongs to, from what lies in four directions."""
    across = w >> 32 if w >> 32 == e >> 32 and _gap(w) + _gap(e) <= narrow + 1 else 0
    along = n >> 32 if n >> 32 == s >> 32 and _gap(n) + _gap(s) <= narrow + 1 else 0
    if label == 0:
        return across if across == along else 0
    if across > 0 or along > 0:
        return across if across > 0 else along
    found = w >> 32 if w >> 32 == e >> 32 or w >> 32 == n >> 32 else s >> 32
    sides = 0
    for packed in (w, e, n, s):
        sides += packed >> 32 == found and not packed & 1 and _gap(packed) <= wide
    return found if sides >= 3 and found > 0 else -1


@kernel
def _gap(packed: int) -> int:
    return (packed & 0xFFFFFFFF) >> 2


@kernel
def _majority(seen: I4, label: int, reach: int, pixels: Bool) -> tuple[int, int, int, int]:
    """Set the pixels of which most of the square around them, in the image, is of a label.

    Returns left, top, and one more than right and bottom, of those that are set.
    """
    height, width = seen.shape
    west, north, east, south = width, height, 0, 0
    sums = np.zeros((height + 1, width + 1), np.int32)
    for v in range(height):
        row = 0
        for u in range(width):
            row += seen[v, u] == label
            sums[v + 1, u + 1] = sums[v, u + 1] + row
    for v in range(height):
        top, bottom = max(0, v - reach), min(height, v + reach + 1)
        for u in range(width):
            left, right = max(0, u - reach), min(width, u + reach + 1)
            count = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
            if 2 * count > (bottom - top) * (right - left):
                pixels[v, u] = True
                west, north = min(west, u), min(north, v)
                east, south = max(east, u + 1), max(south, v + 1)
    return west, north, east, south
