"""The true colours of points, where a colour camera sees them."""

import numpy as np

from shapecat.arrays import F4, I4, U1, U4, Bool
from shapecat.cameras.colour import ColourView, LensCamera
from shapecat.colour.projection import project
from shapecat.jit import kernel
from shapecat.recordings.colour_image import pixels_of
from shapecat.types import Frame, Pose

__all__ = ["packed", "tinted", "true_colours"]

_TINT = 0.35
"""Share of the colour of the category in that of an object."""
_HIDDEN = 0.05
"""A point is hidden where something is nearer by more than this share of its distance."""


def true_colours(
    frame: Frame, view: ColourView, points: F4, pixels: I4, pitch: int
) -> tuple[U1, Bool]:
    """Return the colours of some points of a frame, and which of them the colour camera sees.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame.
    pixels : (n,) their indices in the frame.
    pitch : about how many pixels of the frame lie between neighbours.

    Raises
    ------
    MessageError : the image is damaged.
    """
    image = view.image
    if not frame.organized and view.registered:
        return pixels_of(image).reshape(-1, 3)[pixels], np.ones(pixels.size, bool)
    apart = 1.5 * pitch * (image.width / frame.camera.width if frame.camera is not None else 1.0)
    shrink = next((k for k in (4, 2) if k <= apart), 1)  # finer than the points are apart
    colours = pixels_of(image, shrink=shrink)
    if view.colour_from_depth is None or view.lens is None:
        v, u = np.divmod(pixels, image.width)
        known = np.ones(pixels.size, bool)
    else:
        u, v, known = _seen(frame, view.lens, view.colour_from_depth, points, pitch)
    height, width = colours.shape[:2]
    rows = np.minimum(v * height // image.height, height - 1)
    columns = np.minimum(u * width // image.width, width - 1)
    return colours[rows, columns], known


def _seen(
    frame: Frame, lens: LensCamera, colour_from_depth: Pose, points: F4, pitch: int
) -> tuple[I4, I4, Bool]:
    """Return the pixels of points, (0, 0) for those that are not seen, and which are seen."""
    seen, camera = project(points, lens, colour_from_depth), lens.pinhole
    finer = camera.fx / frame.camera.fx if frame.camera is not None else 1.0
    cell = max(4.0, 1.5 * pitch * finer)
    known = np.zeros(len(points), bool)
    cells = np.zeros((int(camera.height / cell) + 2, int(camera.width / cell) + 2), np.float32)
    _look(seen, (camera.height, camera.width), cell, 1 - _HIDDEN, cells, known)
    u, v = (np.where(known, seen[:, k], 0) + 0.5 for k in range(2))
    return u.astype(np.int64), v.astype(np.int64), known


@kernel
def _look(
    seen: F4, shape: tuple[int, int], cell: float, share: float, cells: F4, known: Bool
) -> None:
    """Find the nearest point around each cell of an image, then the points that are not behind."""
    for i in range(seen.shape[0]):
        u, v, z = seen[i, 0], seen[i, 1], seen[i, 2]
        known[i] = -0.5 < u < shape[1] - 0.5 and -0.5 < v < shape[0] - 0.5 and z > 0
        if known[i]:
            # Of the four cells around it: neighbours may be more than a cell apart.
            x, y = int(u / cell + 0.5), int(v / cell + 0.5)
            for row in (max(y - 1, 0), y):
                for column in (max(x - 1, 0), x):
                    cells[row, column] = max(cells[row, column], 1 / z)
    for i in range(seen.shape[0]):
        if known[i]:
            front = cells[int(max(seen[i, 1], 0) / cell), int(max(seen[i, 0], 0) / cell)]
            known[i] = front * seen[i, 2] * share <= 1


def tinted(colours: U1, tints: U1) -> U1:
    """Mix colours (n, 3) with those of categories (n, 3)."""
    mixed = (1 - _TINT) * colours + _TINT * tints.astype(np.float32)
    return np.asarray(mixed + 0.5).astype(np.uint8)


def packed(colours: U1, known: Bool, otherwise: U4) -> U4:
    """Return colours (n, 3) as 0xRRGGBBAA; where they are not known, others.

    32 tones of each colour are enough to tell things apart, and the noise of the others would
    double the size of the file.
    """
    red, green, blue = (colours & np.uint8(0xF8) | np.uint8(4)).astype(np.uint32).T
    own = (red << 24) | (green << 16) | (blue << 8) | 255
    return np.where(known, own, otherwise).astype(np.uint32)
