"""COCO instance labels on images with the size of the depth images."""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import I4, Bool
from shapecat.colour.rle import parse_rle_text, rle_mask
from shapecat.errors import RecordingError
from shapecat.evaluation.comparison.labellings import (
    UNREADABLE,
    LabelledItem,
    Labelling,
    Place,
    Reference,
)

__all__ = ["CocoLabels", "filled_polygon"]

_MOST_PIXELS = 50_000_000
"""Maximum number of pixels of an image."""
_A_STAMP = 10**17
"""A larger number in an image name is a timestamp in nanoseconds; a smaller one is a frame number
or a date. The longest dates, with milliseconds, have 17 digits."""


class _Annotation(NamedTuple):
    """An annotation of a COCO file, with its category, and its track if it has one."""

    content: Mapping[str, Any]
    category: str
    track: int | None


class _Image(NamedTuple):
    """An image of a COCO file, with its size in pixels and its annotations."""

    id: Any
    height: int
    width: int
    annotations: Sequence[_Annotation]


class CocoLabels(Reference[_Image]):
    """Masks of a COCO file, as polygons or run lengths; ``iscrowd`` makes the category undecidable.

    An image names its frame by ``stamp_ns`` (with ``frame`` where stamps repeat), by ``frame``, or
    by a number in its ``file_name``: a timestamp in nanoseconds, else the last number, which is
    the frame number. An image without ``topic`` matches any topic. If the images name several
    recordings, only those whose ``recording`` is the name of the ``run`` are used; if there are
    none, `RecordingError` is raised. If any of the used images have the ``digest`` of the run's
    recording, the others are left out.
    """

    kind, unit = "COCO labels", "images"

    def __init__(
        self, path: Path, content: Mapping[str, Any], run: str = "", digest: str = ""
    ) -> None:
        names = _names_of(path, content["categories"])
        annotations = defaultdict(list)
        for item in content["annotations"]:
            annotation = _Annotation(item, names[item["category_id"]], _track_of(item))
            annotations[item["image_id"]].append(annotation)
        _require_ids(path, [image["id"] for image in content["images"]], list(annotations))
        images = _images_of(run, path, content["images"])
        same = [image for image in images if image.get("digest") == digest]
        images = same or images
        entries = (
            _Image(i["id"], int(i["height"]), int(i["width"]), annotations[i["id"]]) for i in images
        )
        super().__init__(path, zip(map(_place_of, images), entries, strict=True))
        self.numbered = any(map(_is_numbered, images))
        tracks = [annotation.track for i in images for annotation in annotations[i["id"]]]
        self.tracked = bool(tracks) and None not in tracks

    def labelling(self, entry: _Image) -> Labelling:
        """Return the objects of an image.

        Raises
        ------
        RecordingError : the image size or a mask is invalid.
        """
        name, height, width, annotations = entry
        if not 0 < height * width <= _MOST_PIXELS:
            msg = f"{self.path}: image {name} is {width}×{height}"
            raise RecordingError(msg)
        items = (self._item(annotation, height, width) for annotation in annotations)
        return Labelling(tuple(items), None, (height, width))

    def _item(self, annotation: _Annotation, height: int, width: int) -> LabelledItem:
        content, category, track = annotation
        try:
            mask = _mask(content["segmentation"], height, width)
        except UNREADABLE as error:
            msg = f"{self.path}: annotation {content.get('id')} has no readable mask ({error!r})"
            raise RecordingError(msg) from error
        return LabelledItem(
            track=track,
            category=category,
            pixels=np.flatnonzero(mask),
            decidable=not content.get("iscrowd"),
        )


def _names_of(path: Path, categories: Sequence[Mapping[str, Any]]) -> dict[Any, str]:
    """Return the names of the categories by id; raise `RecordingError` if one id has two names."""
    names: dict[Any, str] = {}
    for item in categories:
        name = names.setdefault(item["id"], str(item["name"]))
        if name != str(item["name"]):
            msg = f"{path}: {name} and {item['name']} have the same id, {item['id']!r}"
            raise RecordingError(msg)
    return names


def _require_ids(path: Path, images: Sequence[Any], annotated: Sequence[Any]) -> None:
    """Check that the ids of images tell which annotations are theirs.

    ``annotated`` are the ids of images that the annotations name. Some may be missing among
    ``images``, if these are a selection.

    Raises
    ------
    RecordingError : two images have the same id, or no image has annotations.
    """
    if repeated := [name for name, count in Counter(images).items() if count > 1]:
        msg = f"{path}: several images have the id {repeated[0]!r}"
        raise RecordingError(msg)
    if images and annotated and not {*images} & {*annotated}:
        msg = f"{path}: no image has the id of an annotated one, such as {annotated[0]!r}"
        raise RecordingError(msg)


def _track_of(item: Mapping[str, Any]) -> int | None:
    track_id = item.get("track_id", item.get("attributes", {}).get("track_id"))
    return None if track_id is None else int(track_id)


def _images_of(
    run: str, path: Path, images: Sequence[Mapping[str, Any]]
) -> Sequence[Mapping[str, Any]]:
    """Return the images of a run's recording; all images if they name one recording or none.

    Raises
    ------
    RecordingError : they name several recordings, none of which has the name of the run.
    """
    names = {str(image["recording"]) for image in images if "recording" in image}
    if len(names) < 2:
        return images
    if run not in names:
        msg = f"{path}: has images of {', '.join(sorted(names))}, not of {run}"
        raise RecordingError(msg)
    return [image for image in images if str(image.get("recording")) == run]


def _place_of(image: Mapping[str, Any]) -> Place:
    numbers = [int(image[name]) for name in ("stamp_ns", "frame") if image.get(name) is not None]
    numbers = numbers or [_number_in_name(image)]
    return image.get("topic"), numbers[0], numbers[1] if len(numbers) > 1 else None


def _is_numbered(image: Mapping[str, Any]) -> bool:
    """Return whether an image names its frame by a number, not by a timestamp."""
    if image.get("stamp_ns") is not None:
        return False
    return image.get("frame") is not None or _number_in_name(image) <= _A_STAMP


def _number_in_name(image: Mapping[str, Any]) -> int:
    """Return the timestamp (ns), or else the frame number, in the file name of an image.

    Raises
    ------
    ValueError : the name holds no number.
    """
    digits = re.findall(r"\d+", Path(image["file_name"]).stem)
    if not digits:
        msg = f"the name {image['file_name']!r} holds neither a timestamp nor a frame number"
        raise ValueError(msg)
    return max(map(int, digits)) if int(max(digits, key=int)) > _A_STAMP else int(digits[-1])


def _mask(segmentation: Any, height: int, width: int) -> Bool:
    if isinstance(segmentation, Mapping):
        if tuple(segmentation["size"]) != (height, width):
            msg = f"size {segmentation['size']}, the image is {[height, width]}"
            raise ValueError(msg)
        counts = segmentation["counts"]
        runs = parse_rle_text(counts) if isinstance(counts, str) else list(map(int, counts))
        return rle_mask(runs, height, width).full(height, width)
    if not segmentation:
        msg = "it has only a box"
        raise ValueError(msg)
    mask = np.zeros((height, width), np.bool_)
    for polygon in segmentation:
        mask |= filled_polygon(np.reshape(polygon, (-1, 2)), height, width)
    return mask


def filled_polygon(corners: I4, height: int, width: int) -> Bool:
    """Return the mask (height, width) of pixels with their centre inside a polygon.

    ``corners`` (n, 2) are x and y in pixels; the centre of pixel (0, 0) is at (0.5, 0.5).
    """
    corners = np.asarray(corners, np.float64)
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    inside = np.zeros((height, width), np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        rows = np.flatnonzero((y0 <= y) != (y1 <= y))
        crossing = x0 + (y[rows] - y0) * (x1 - x0) / (y1 - y0 or 1.0)
        inside[rows] ^= x < crossing[:, None]
    return inside
