"""Pictures of frames in which a run and the truth differ."""

import base64
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from shapecat.arrays import U1
from shapecat.evaluation.comparison.labellings import LabelledItem, Labelling
from shapecat.evaluation.comparison.matching import Difference
from shapecat.outputs.png import png
from shapecat.runs.tables.reading import Key
from shapecat.types import Frame

__all__ = ["COLOURS", "DifferenceImage", "draw_frame", "words_of"]

_SHADES = 48
"""Number of shades of grey."""
COLOURS = {
    "both": (66, 160, 71),
    "missed": (230, 81, 0),
    "surplus": (30, 100, 220),
    "category": (160, 40, 170),
}
"""Colours of the pixels of objects: the same in run and truth, only in the truth, only in the run,
and in both but with different categories."""
_INK = 0.55
"""Opacity of the colours over the grey, from 0 to 1."""


class Caption(NamedTuple):
    """A text, and the middle of its baseline in the picture, pixels."""

    x: float
    y: float
    text: str


class DifferenceImage(NamedTuple):
    """A picture of a frame: a PNG image as a data URI, with captions.

    ``rows`` are the differences that it shows.
    """

    topic: str
    frame: int
    image: str
    width: int
    height: int
    captions: tuple[Caption, ...]
    rows: tuple[Difference, ...]


def draw_frame(
    key: Key,
    frame: Frame | None,
    found: Labelling,
    true: Labelling,
    pairs: Mapping[int, int],
    rows: Sequence[Difference],
) -> DifferenceImage | None:
    """Draw found and true masks over the depth image.

    Parameters
    ----------
    frame : the depth frame; None for a plain background.
    pairs : index of the true object for each matched found object.
    rows : rows of the frame: first those of the found objects, then those of the missed ones, both
        in the order of the objects.

    Returns
    -------
    The picture; None if the frame is not an image.
    """
    shape = true.shape
    if frame is not None:
        shape = frame.depth.shape if frame.depth is not None else None
    if shape is None:
        return None
    height, width = shape
    image = _shades(frame, height, width) + _SHADES * _states(
        found, true, pairs, rows, height * width
    )
    code = base64.b64encode(png(image.reshape(height, width).astype(np.uint8), _palette())).decode()
    differing = tuple(row for row in rows if row.difference)
    captions = _captions(rows, found.items, true.items, pairs, width)
    uri = f"data:image/png;base64,{code}"
    return DifferenceImage(*key, uri, width, height, captions, differing)


def _states(
    found: Labelling,
    true: Labelling,
    pairs: Mapping[int, int],
    rows: Sequence[Difference],
    size: int,
) -> U1:
    """Return the state of each pixel, (n,): 0 without an object, else 1 to 4 as in `COLOURS`.

    ``pairs`` maps found to true objects, ``rows`` are their differences; the picture has ``size``
    pixels. Where a found object covers a true one that it does not match, its pixels count as
    surplus, so that split objects are visible.
    """
    state = np.zeros(size, np.int64)
    for number, labelling in ((2, true), (3, found)):
        for item in labelling.items:
            if item.pixels is not None:
                state[item.pixels] = number
    for i, j in pairs.items():
        found_pixels, true_pixels = found.items[i].pixels, true.items[j].pixels
        if found_pixels is not None and true_pixels is not None:
            state[np.intersect1d(found_pixels, true_pixels)] = (
                4 if rows[i].difference == "category" else 1
            )
    return state


def _shades(frame: Frame | None, height: int, width: int) -> U1:
    """Return the grey level (n,) of each pixel, from 0 to `_SHADES` - 1.

    Surfaces are lit from the camera; nearer ones are brighter. Without depth, all are alike.
    """
    if frame is None or frame.depth is None:
        return np.full(height * width, _SHADES * 3 // 4)
    depth = np.asarray(frame.depth, np.float64)
    measured = depth > 0
    z = np.where(measured, depth, np.nan)
    nearest, farthest = np.nanpercentile(z, [2, 90]) if measured.any() else (0.0, 1.0)
    distance = np.clip((z - nearest) / max(farthest - nearest, 1e-3), 0, 1)
    slope = np.hypot(*np.gradient(z)) / z
    light = 1 / np.sqrt(1 + (slope * 250) ** 2)
    shade = (0.35 + 0.65 * light) * (1 - 0.5 * distance)
    level = np.nan_to_num(shade, nan=0.2) * (_SHADES - 1)
    return np.where(measured, level, 2).astype(np.int64).reshape(-1)


def _palette() -> U1:
    """Return the colour table (k, 3): shades of grey, then these shades tinted with each colour."""
    grey = np.repeat(np.linspace(0, 255, _SHADES)[:, None], 3, axis=1)
    tinted = [grey * (1 - _INK) + _INK * np.array(colour) for colour in COLOURS.values()]
    return np.concatenate([grey, *tinted]).astype(np.uint8)


def _captions(
    rows: Sequence[Difference],
    found: Sequence[LabelledItem],
    true: Sequence[LabelledItem],
    pairs: Mapping[int, int],
    width: int,
) -> tuple[Caption, ...]:
    """Return a caption for each difference, above its object; none for objects without a mask.

    ``pairs`` maps found to true objects; ``rows`` are those of found, then of missed objects. The
    picture is ``width`` pixels wide.
    """
    missed = [item for j, item in enumerate(true) if j not in pairs.values()]
    captions = []
    for row, item in zip(rows, [*found, *missed], strict=True):
        if row.difference and item.pixels is not None and item.pixels.size:
            y, x = np.divmod(item.pixels, width)
            captions.append(Caption(float(x.mean()), float(y.min()) - 4, words_of(row)))
    return tuple(captions)


def words_of(row: Difference) -> str:
    """Describe a difference as a short phrase; its ``difference`` must not be None."""
    track = "" if row.track is None else f" #{row.track}"
    return {
        "missed": f"missed {row.true_category}",
        "surplus": f"surplus {row.category}{track}",
        "category": f"{row.true_category} mistaken for {row.category}{track}",
        "identity": f"{row.true_category} now{track}",
        "outline": f"{row.category}{track}: outline differs",
    }[str(row.difference)]
