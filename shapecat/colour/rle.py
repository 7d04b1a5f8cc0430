"""Run-length encoding of masks as in COCO data sets: column by column, zeros first."""

import numpy as np

from shapecat.arrays import U4
from shapecat.colour.masks import EMPTY_MASK, Mask

__all__ = ["rle_counts", "rle_mask", "rle_text"]


def rle_counts(mask: Mask, height: int, width: int) -> U4:
    """Return the run lengths (n,) of a mask in its image, alternately outside and inside.

    The image of ``height`` by ``width`` pixels is read column by column. The first run is outside
    the mask, and may have length 0.

    Examples
    --------
    >>> rle_counts(Mask(1, 0, np.array([[True, True], [True, False]])), 3, 4)
    array([3, 2, 1, 1, 5], dtype=uint32)
    """
    left, top, w, h = mask.box
    columns = np.zeros(w * height + 2, bool)  # with a pixel outside at each end
    columns[1:-1].reshape(w, height)[:, top : top + h] = mask.pixels.T
    changes = np.flatnonzero(columns[1:] != columns[:-1]) + left * height
    ends = np.union1d(changes, height * width)
    return np.diff(ends, prepend=0).astype(np.uint32)


def rle_mask(counts: U4, height: int, width: int) -> Mask:
    """Return the mask with run lengths (n,): the inverse of `rle_counts`.

    Raises
    ------
    ValueError : the run lengths do not add up to ``height * width``.
    """
    runs = np.asarray(counts, np.int64)
    if int(runs.sum()) != height * width:
        msg = f"run lengths of {int(runs.sum())} pixels for an image of {width} x {height}"
        raise ValueError(msg)
    ends = np.cumsum(runs)
    inside = runs[1::2] > 0
    starts, stops = ends[:-1:2][: inside.size][inside], ends[1::2][inside]
    if not starts.size:
        return EMPTY_MASK
    left, right = int(starts[0] // height), int((stops[-1] - 1) // height) + 1
    columns = np.zeros((right - left) * height, bool)
    for start, stop in zip(starts - left * height, stops - left * height, strict=True):
        columns[start:stop] = True
    pixels = columns.reshape(right - left, height).T
    rows = np.flatnonzero(pixels.any(axis=1))
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    return Mask(left, top, np.ascontiguousarray(pixels[top:bottom]))


def rle_text(counts: U4) -> str:
    """Return run lengths (n,) in COCO's compressed text format.

    From the fourth on, a run is stored as the difference from the run two before it. Each
    character holds 5 bits.

    Source: rleToString of the COCO API (Lin et al. 2014).

    Examples
    --------
    >>> rle_text(np.array([6, 1, 40, 4, 5, 4, 5, 4, 21], np.uint32))
    '61X13mN000`0'
    """
    numbers, letters = [int(count) for count in counts], []
    for k, number in enumerate(numbers):
        remainder = number - numbers[k - 2] if k > 2 else number
        more = True
        while more:
            part = remainder & 31
            remainder >>= 5
            more = remainder != (-1 if part & 16 else 0)
            letters.append(chr(part + (32 if more else 0) + 48))
    return "".join(letters)
