"""The masks of a frame's detections, as stored in masks.parquet."""

from collections.abc import Sequence

from shapecat.arrays import U4
from shapecat.cameras.colour import ColourView
from shapecat.colour.masks import EMPTY_MASK, Mask, dense_masks, union
from shapecat.colour.rle import rle_counts, rle_mask
from shapecat.types import Frame, ImageMasks

__all__ = ["box_of", "find_masks", "mask_of"]


def find_masks(frame: Frame, view: ColourView, objects: Sequence[U4]) -> ImageMasks:
    """Return the masks of a frame's detections on a colour image.

    The masks follow from the depth image and the cameras alone, not from the colours. An
    unorganized cloud has no masks.

    Parameters
    ----------
    view : the colour image with its camera.
    objects : for each detection, (k,) uint32 flat indices of its pixels in the frame.

    Raises
    ------
    ValueError : the distortion model of the colour camera is not known.
    """
    image = view.image
    masks: tuple[Mask, ...] = ()
    if frame.organized:
        masks = dense_masks(frame, objects, view.lens, view.colour_from_depth)
    visible = {number: mask for number, mask in enumerate(masks) if mask.pixels.size}
    return ImageMasks(
        image.topic,
        image.stamp_ns,
        image.log_time_ns,
        image.frame_id,
        image.width,
        image.height,
        {number: mask.box for number, mask in visible.items()},
        {n: rle_counts(mask, image.height, image.width) for n, mask in visible.items()},
    )


def mask_of(masks: ImageMasks, detections: Sequence[int]) -> Mask:
    """Return the union of the masks of some detections; an empty mask if none has one.

    Parameters
    ----------
    detections : numbers in the frame, from 0.

    Raises
    ------
    ValueError : the run lengths of a mask do not fill the image.
    """
    counts = [masks.counts[number] for number in detections if number in masks.counts]
    decoded = [rle_mask(runs, masks.height, masks.width) for runs in counts]
    return union(decoded) if decoded else EMPTY_MASK


def box_of(masks: ImageMasks, detections: Sequence[int]) -> tuple[int, int, int, int] | None:
    """Return left, top, width and height, in pixels, of the box around some detections' masks.

    The result is None if no detection has a mask. ``detections`` are numbers in the frame, from 0.
    """
    boxes = [masks.boxes[number] for number in detections if number in masks.boxes]
    if not boxes:
        return None
    left, top = min(box[0] for box in boxes), min(box[1] for box in boxes)
    right, bottom = max(box[0] + box[2] for box in boxes), max(box[1] + box[3] for box in boxes)
    return left, top, right - left, bottom - top
