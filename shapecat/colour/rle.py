"""Run-length encoding of masks as in COCO data sets: column by column, zeros first."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import U4
from shapecat.colour.masks import EMPTY_MASK, Mask

__all__ = ["parse_rle_text", "rle_counts", "rle_mask", "rle_text"]


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


def rle_mask(counts: U4 | Sequence[int], height: int, width: int) -> Mask:
    """Return the mask with run lengths (n,): the inverse of `rle_counts`.

    Raises
    ------
    ValueError : a run length is negative, or the sum is not ``height * width``.

    Examples
    --------
    >>> rle_mask([1, 2, 1], 2, 2).pixels.astype(int)
    array([[0, 1],
           [1, 0]])
    """
    runs, size = np.asarray(counts), height * width
    # The sum of runs that are longer than the image may overflow to the size of the image.
    if runs.min(initial=0) < 0 or runs.max(initial=0) > size or runs.sum() != size:
        total = sum(map(int, counts))
        msg = f"run lengths of {total} pixels, or negative ones, for an image of {width} x {height}"
        raise ValueError(msg)
    ends = np.cumsum(runs, dtype=np.int64)
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


def parse_rle_text(text: str) -> list[int]:
    """Return the run lengths in COCO's compressed text format: the inverse of `rle_text`.

    Raises
    ------
    ValueError : the text is not ASCII, or a number in it has more than 64 bits.

    Examples
    --------
    >>> parse_rle_text("61X13mN000`0")
    [6, 1, 40, 4, 5, 4, 5, 4, 21]
    """
    counts: list[int] = []
    value = shift = 0
    for letter in text.encode("ascii"):
        part = letter - 48
        value |= (part & 31) << shift
        shift += 5
        if shift > 65:
            msg = "a run length has more than 64 bits"
            raise ValueError(msg)
        if part & 32:
            continue
        if part & 16:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    return counts
