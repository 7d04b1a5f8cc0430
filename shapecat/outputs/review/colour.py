"""The true colours of points that a colour camera sees."""

import numpy as np

from shapecat.arrays import F4, I4, U1, U2, U4
from shapecat.cameras.colour import ColourView
from shapecat.colour.projection import project
from shapecat.jit import kernel
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.types import Frame

__all__ = ["true_colours"]

_TINT = 0.35
"""Fraction of the category's colour in the colour of an object."""
_HIDDEN = 0.05
"""A point is occluded if another one is nearer by more than this fraction of the point's depth."""


def true_colours(
    frame: Frame, view: ColourView, points: F4, pixels: I4, pitch: int, palette: U1, tones: U2
) -> U4:
    """Return the colours (n,) of points, 0xRRGGBBAA; 0 if the colour camera does not see them.

    Each channel is quantised to 32 levels; finer levels would store noise and double the file.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame.
    pixels : (n,) flat indices of the points in the frame.
    pitch : approximate distance of neighbouring points, pixels of the frame.
    palette : (k, 3) colours.
    tones : (n,) index into ``palette`` of the colour that tints each point; 0 for none.

    Raises
    ------
    MessageError : the image is damaged.
    """
    image, result = view.image, np.zeros(pixels.size, np.uint32)
    finer = image.width / frame.camera.width if frame.camera is not None else 1.0
    apart = 1.5 * pitch * finer
    shrink = next((k for k in (4, 2) if k <= apart), 1)  # still finer than the points
    if view.colour_from_depth is None or view.lens is None:
        pixels_in_image = np.stack(np.divmod(pixels, image.width)[::-1], axis=1).astype(np.float32)
    else:
        pixels_in_image = project(points, view.lens, view.colour_from_depth)
        _hide(pixels_in_image, (image.height, image.width), max(4.0, apart), 1 - _HIDDEN)
    colours = pixels_of(image, shrink=shrink)
    _sample_colours(colours, (image.height, image.width), pixels_in_image, palette, tones, result)
    return result


@kernel
def _hide(projected: F4, shape: tuple[int, int], cell: float, share: float) -> None:
    """Set the column of points to NaN if they are outside the image or occluded.

    Parameters
    ----------
    projected : (n, 3) column and row in pixels, and depth in metres; changed in place.
    shape : height and width of the image.
    cell : size of the cells in which the nearest point is found, pixels.
    share : a point is occluded if the nearest depth in its cell is less than this fraction of its
        own depth.
    """
    cells = np.zeros((int(shape[0] / cell) + 2, int(shape[1] / cell) + 2), np.float32)
    for i in range(projected.shape[0]):
        u, v, z = projected[i, 0], projected[i, 1], projected[i, 2]
        if -0.5 < u < shape[1] - 0.5 and -0.5 < v < shape[0] - 0.5 and z > 0:
            # Fill the four nearest cells, since neighbours may be more than a cell apart.
            x, y = int(u / cell + 0.5), int(v / cell + 0.5)
            for row in (max(y - 1, 0), y):
                for column in (max(x - 1, 0), x):
                    cells[row, column] = max(cells[row, column], 1 / z)
        else:
            projected[i, 0] = np.nan
    for i in range(projected.shape[0]):
        if projected[i, 0] > -1:
            front = cells[int(max(projected[i, 1], 0) / cell), int(max(projected[i, 0], 0) / cell)]
            if front * projected[i, 2] * share > 1:
                projected[i, 0] = np.nan


@kernel
def _sample_colours(
    image: U1, shape: tuple[int, int], projected: F4, palette: U1, tones: U2, colours: U4
) -> None:
    """Write the colours of visible points, 0xRRGGBBAA, into ``colours`` (n,).

    Parameters
    ----------
    image : (h, w, 3) red, green, blue; may be smaller than the recorded image.
    shape : height and width of the recorded image.
    projected : (n, 2) or (n, 3); the first two values are the column and row in the recorded image,
        and the column is NaN if the point is not visible.
    palette, tones : as for `true_colours`.
    """
    height, width, _ = image.shape
    tall, wide = height / shape[0], width / shape[1]
    for i in range(projected.shape[0]):
        if not projected[i, 0] > -0.5:
            continue
        v = min(int((projected[i, 1] + 0.5) * tall), height - 1)
        u = min(int((projected[i, 0] + 0.5) * wide), width - 1)
        packed = np.uint32(0)
        for channel in range(3):
            value = np.float32(image[v, u, channel])
            if tones[i] > 0:
                value += np.float32(_TINT) * (np.float32(palette[tones[i], channel]) - value)
            packed = (packed << np.uint32(8)) | (np.uint32(value) & np.uint32(0xF8)) | np.uint32(4)
        colours[i] = (packed << np.uint32(8)) | np.uint32(255)
