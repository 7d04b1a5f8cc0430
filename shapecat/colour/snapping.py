"""Outlines of masks, moved onto nearby edges in the colour image.

Source: the local statistics of Lankton and Tannenbaum, Localizing region-based active contours,
2008. differs: one step within a narrow band instead of an evolving curve, since the outline from
depth is already right to a pixel or two.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.colour.masks import EMPTY_MASK, Mask
from shapecat.jit import kernel

__all__ = ["snapped"]

_BAND_PX = 3.0
"""Largest distance an outline moves; this and the next three are in pixels of the depth image."""
_CORE_PX = 1.5
"""Pixels farther than this from the outline are samples of the colours on their side."""
_WINDOW_PX = 6.0
"""Half the width of the window from which samples are taken."""
_ERROR_PX = 3.0
"""A pixel this far from the outline changes sides if the other side is over e times as likely."""
_FEWEST = 4
"""Minimum number of samples of each side; with fewer, the colour of a pixel has no influence."""
_NOISE = 64.0
"""Variance that noise adds to each channel, in squared grey levels."""
_CERTAIN = 3.0
"""Largest influence of the colour of a pixel, as a log-likelihood ratio."""


def snapped(masks: Sequence[Mask], pixels: U1, scale: float = 1.0) -> tuple[Mask, ...]:
    """Return masks whose outlines follow the edges in a colour image, where it has edges.

    A pixel near an outline goes to the side whose colours, sampled around the pixel, match it
    better; the farther it is from the outline, the clearer the match must be. Where both sides
    have the same colours the outline stays. No two masks share a pixel.

    Parameters
    ----------
    masks : masks of the objects on the colour image.
    pixels : (h, w, 3) uint8, the colour image.
    scale : pixels of the colour image per pixel of the depth image.

    Notes
    -----
    Time grows with the length of the outlines: about a millisecond per object.
    """
    owners = np.zeros(pixels.shape[:2], np.int32)
    for number, mask in enumerate(masks, start=1):
        height, width = mask.pixels.shape
        part = owners[mask.top : mask.top + height, mask.left : mask.left + width]
        part[mask.pixels] = number
    matches = [
        _match(mask, number, owners, pixels, scale) if mask.pixels.size else None
        for number, mask in enumerate(masks, start=1)
    ]
    # Pixels that any mask gives up are free for every other, whatever the order of the masks.
    for number, one in enumerate(matches, start=1):
        if one is not None:
            part = owners[one.window]
            part[(part == number) & ~one.wanted] = 0
    return tuple(
        EMPTY_MASK if one is None else _claim(one, number, owners)
        for number, one in enumerate(matches, start=1)
    )


class _Match(NamedTuple):
    """A window (rows and columns) around a mask, and which of its pixels match the mask (h, w)."""

    window: tuple[slice, slice]
    wanted: Bool


def _match(mask: Mask, number: int, owners: I4, pixels: U1, scale: float) -> _Match:
    """Return the pixels that match mask ``number``, counted from 1.

    ``owners`` (h, w) holds the number of each pixel's mask, 0 where there is none; ``pixels``
    (h, w, 3) is the colour image; ``scale`` is as in `snapped`.
    """
    band_px, radius = max(2.0, _BAND_PX * scale), max(3, round(_WINDOW_PX * scale))
    margin, (left, top, width, height) = int(band_px) + radius, mask.box
    rows = slice(max(0, top - margin), top + height + margin)
    columns = slice(max(0, left - margin), left + width + margin)
    window = rows, columns
    inside = owners[window] == number
    if inside.all() or not inside.any():
        return _Match(window, inside)
    # The distance of pixel centres from the outline, positive inside.
    within, without = (ndimage.distance_transform_edt(side) for side in (inside, ~inside))
    depth = np.where(inside, within - 0.5, 0.5 - without).astype(np.float32)
    log_ratio = np.zeros(depth.shape, np.float32)
    colours = np.ascontiguousarray(pixels[window])
    _compare(colours, depth, band_px, _CORE_PX * scale, radius, log_ratio)
    score = ndimage.uniform_filter(log_ratio, 3) + depth / np.float32(_ERROR_PX * scale)
    return _Match(window, np.where(np.abs(depth) <= band_px, score > 0, inside))


def _claim(match: _Match, number: int, owners: I4) -> Mask:
    """Give mask ``number`` the matching pixels that no other mask owns; return the new mask.

    ``owners`` is as in `_match`, changed in place.
    """
    rows, columns = match.window
    part = owners[match.window]
    claimed = match.wanted & ((part == number) | (part == 0))
    part[claimed] = number
    return _cut_out(claimed, columns.start, rows.start)


def _cut_out(inside: Bool, left: int, top: int) -> Mask:
    """Return ``inside`` (h, w) without empty margins; its first pixel is (``left``, ``top``)."""
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not rows.size:
        return EMPTY_MASK
    part = inside[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Mask(left + int(columns[0]), top + int(rows[0]), np.ascontiguousarray(part))


@kernel
def _compare(colours: U1, depth: F4, band: float, core: float, window: int, log_ratio: F4) -> None:
    """Write to ``log_ratio`` the log-likelihood ratio of inside to outside, for pixels in the band.

    The colours of each side are modelled by a normal distribution with the same variance in all
    channels, fitted to a grid of pixels around the pixel; pixels with too few samples are left out.
    ``colours`` are (h, w, 3); ``depth`` and ``log_ratio`` (h, w). ``depth`` is the distance from
    the outline in pixels, positive inside. ``band``, ``core`` and ``window`` are as `_BAND_PX`,
    `_CORE_PX` and `_WINDOW_PX`, in pixels of the colour image.
    """
    height, width, channels = colours.shape
    step = max(1, window // 4)
    total = np.zeros((2, channels), np.float32)
    for v in range(height):
        for u in range(width):
            if abs(depth[v, u]) > band:
                continue
            total[:] = 0
            outside = inside = 0
            squares_outside = squares_inside = np.float32(0)
            for y in range(max(v - window, 0), min(v + window + 1, height), step):
                for x in range(max(u - window, 0), min(u + window + 1, width), step):
                    if abs(depth[y, x]) <= core:
                        continue
                    square = np.float32(0)
                    side = 1 if depth[y, x] > 0 else 0
                    for k in range(channels):
                        value = np.float32(colours[y, x, k])
                        total[side, k] += value
                        square += value * value
                    if side:
                        inside, squares_inside = inside + 1, squares_inside + square
                    else:
                        outside, squares_outside = outside + 1, squares_outside + square
            if min(inside, outside) >= _FEWEST:
                cost_inside = _negative_log_likelihood(
                    colours[v, u], total[1], squares_inside, inside
                )
                cost_outside = _negative_log_likelihood(
                    colours[v, u], total[0], squares_outside, outside
                )
                log_ratio[v, u] = min(max(cost_outside - cost_inside, -_CERTAIN), _CERTAIN)


@kernel(inner=True)
def _negative_log_likelihood(colour: U1, total: F4, squares: float, count: int) -> float:
    """Return the negative log-likelihood of a colour (channels,), up to a constant.

    ``total`` (channels,) is the sum of ``count`` sampled colours, ``squares`` the sum of their
    squares over all channels.
    """
    apart, of_means = 0.0, 0.0
    for k in range(colour.size):
        mean = total[k] / count
        apart += (colour[k] - mean) ** 2
        of_means += mean * mean
    variance = max(squares / count - of_means, 0.0) / colour.size + _NOISE
    return float((apart / variance + colour.size * np.log(variance)) / 2)
