"""Splat the pixels of a depth image onto the image of a colour camera, the nearest on top."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F4, I4, U4
from shapecat.cameras.colour import LensCamera
from shapecat.colour.projection import Lens, kernel_lens, project_in_place
from shapecat.jit import kernel
from shapecat.types import Camera, Pose

__all__ = ["splat_depth"]

_FOOTPRINT_PX = 0.05
"""Margin on each side of a splatted depth pixel, in colour pixels; it prevents gaps."""
_HIDDEN = 0.02
"""A surface hides an object if it is nearer by more than this fraction of the object's depth."""
_SPARSE = 4
"""Outside objects, only every fourth pixel of every fourth row of the depth image is used."""
_BESIDE_PX = 30
"""Margin around the objects in the colour image, in depth pixels."""


def splat_depth(
    depth: F4, camera: Camera, objects: Sequence[U4], lens: LensCamera, colour_from_depth: Pose
) -> tuple[int, int, I4, I4]:
    """Label the pixels of a colour camera with the objects of a depth image.

    Each depth pixel of an object covers a square of its own size on the colour image, slightly
    enlarged; where squares overlap, the nearest one shows. The other depth pixels are splatted
    coarsely: they only hide objects, or show that a gap belongs to no object.

    Parameters
    ----------
    depth : (h, w) metres, 0 where depth is missing.
    camera : the depth camera.
    objects : for each object, (k,) uint32 flat indices of its pixels in ``depth``.
    lens : the colour camera.
    colour_from_depth : pose of the depth sensor in the optical frame of the colour camera.

    Returns
    -------
    left, top : column and row, in the image, of the first pixel of ``labels``, which is the part of
        the image around the objects.
    labels : (h, w) int32 the object, from 1; 0 for another surface, -1 where nothing is known.
        Label 0 occurs only within ``boxes``.
    boxes : (n + 1, 4) bounding box of each label's pixels, including hidden ones: left, top,
        right + 1, bottom + 1, in pixels of ``labels``; zeros for a label without pixels.

    Raises
    ------
    ValueError : the distortion model is not known.

    Notes
    -----
    Time grows with the pixels of the objects, the pixels that they cover, and a sixteenth of the
    depth image.
    """
    target = lens.pinhole
    scale = max(target.fx / camera.fx, target.fy / camera.fy)
    pixels = np.concatenate([[], *objects], dtype=np.uint32, casting="unsafe")
    labels = np.repeat(np.arange(1, len(objects) + 1, dtype=np.int32), list(map(len, objects)))
    rays, size = _rays(camera, colour_from_depth), (target.width, target.height)
    boxes = np.zeros((len(objects) + 1, 4), np.int64)
    left, top, splat = _splat(depth, pixels, labels, rays, kernel_lens(lens), scale, size, boxes)
    return left, top, splat, boxes


def _rays(camera: Camera, colour_from_depth: Pose) -> tuple[F4, F4, F4]:
    """Return the rays of depth pixels in the colour camera's frame, and their common origin.

    The ray of pixel (u, v) is column u of the first array (3, w) plus column v of the second one
    (3, h). The third array (3,) is the origin: the translation of ``colour_from_depth``, metres.
    """
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    turn = colour_from_depth.rotation
    by_column, by_row = np.outer(turn[:, 0], x), np.outer(turn[:, 1], y) + turn[:, 2:]
    return (
        by_column.astype(np.float32),
        by_row.astype(np.float32),
        colour_from_depth.translation.astype(np.float32),
    )


@kernel
def _splat(
    depth: F4,
    pixels: U4,
    labels: I4,
    rays: tuple[F4, F4, F4],
    lens: Lens,
    scale: float,
    size: tuple[int, int],
    boxes: I4,
) -> tuple[int, int, I4]:
    """Return left, top and labels as `splat_depth` does, and write its ``boxes``.

    ``pixels`` (n,) are flat indices into ``depth``, ``labels`` (n,) their objects, from 1. ``rays``
    is from `_rays`. ``scale`` is the width of a depth pixel in colour pixels at equal distance.
    ``size`` is width and height of the colour image.
    """
    background = _sample_background(depth, pixels)
    projections = _project_pixels(depth, pixels, rays, lens)
    around = _project_pixels(depth, background, rays, lens)
    squares = _cover(projections, labels, np.float32(scale / 2), size, boxes)
    left, top, right, bottom = _window(boxes, int(_BESIDE_PX * scale), size)
    splat = np.full((bottom - top, right - left), np.int32(-1))
    nearest = np.zeros(splat.shape, np.float32)
    _paint(squares, labels, projections[2], (left, top), nearest, splat)
    cell = max(2, int(_SPARSE * scale + 0.5))
    _hide(
        _nearest_surface(around, (left, top), cell, splat.shape),
        cell,
        boxes,
        nearest,
        splat,
    )
    return left, top, splat


@kernel(inner=True)
def _sample_background(depth: F4, pixels: U4) -> U4:
    """Return the pixels on every `_SPARSE`-th row and column with depth that are not in ``pixels``.

    Both ``pixels`` (n,) and the result (k,) are flat indices into ``depth`` (h, w).
    """
    rows, columns = (depth.shape[0] - 1) // _SPARSE + 1, (depth.shape[1] - 1) // _SPARSE + 1
    outside = np.ones((rows, columns), np.bool_)
    v, width = 0, depth.shape[1]
    for pixel in pixels:
        v, u = _row_and_column(pixel, v, width)
        if (v | u) % _SPARSE == 0:  # a power of 2, so that this tests both
            outside[v // _SPARSE, u // _SPARSE] = False
    background, count = np.zeros(outside.size, np.uint32), 0
    for j in range(rows):
        for i in range(columns):
            if outside[j, i] and depth[j * _SPARSE, i * _SPARSE] > 0:
                background[count] = (j * width + i) * _SPARSE
                count += 1
    return background[:count]


@kernel(inner=True)
def _row_and_column(pixel: int, row: int, width: int) -> tuple[int, int]:
    """Return row and column of a flat pixel index, quickly if the guess ``row`` is right."""
    column = pixel - row * width
    if not 0 <= column < width:
        row = pixel // width
        column = pixel - row * width
    return row, column


@kernel(inner=True)
def _project_pixels(depth: F4, pixels: U4, rays: tuple[F4, F4, F4], lens: Lens) -> F4:
    """Return the projection (4, n) of depth pixels into a camera.

    ``pixels`` and ``rays`` are as in `_splat`. The rows are column, row, inverse depth in the
    camera (0 where it does not see the pixel), and depth in the depth image.
    """
    by_column, by_row, shift = rays
    moved = np.zeros((4, pixels.size), np.float32)
    v, width = 0, depth.shape[1]
    for i in range(pixels.size):
        v, u = _row_and_column(pixels[i], v, width)
        z = depth[v, u]
        for k in range(3):
            moved[k, i] = (by_column[k, u] + by_row[k, v]) * z + shift[k]
        moved[3, i] = z
        if not z > 0:
            moved[2, i] = -1
    numbers, kind, d, max_slope2 = lens
    project_in_place(moved[0], moved[1], moved[2], numbers, kind, d, max_slope2)
    return moved


@kernel(inner=True)
def _cover(projections: F4, labels: I4, half: float, size: tuple[int, int], boxes: I4) -> I4:
    """Return, for each depth pixel, the square of image pixels whose centres it covers.

    ``labels`` (n,) are those of the depth pixels, ``size`` is width and height of the image.
    Squares are (n, 4) left, top, right + 1, bottom + 1; zeros outside the image. ``boxes`` is set
    to such a box around the squares of each label, (labels, 4): (width, height, 0, 0) without any.
    ``projections`` is from `_project_pixels`; ``half`` is half the width of a depth pixel in colour
    pixels at equal distance.
    """
    nought, one = np.float32(0), np.float32(1)
    width, height = np.float32(size[0]), np.float32(size[1])
    squares = np.zeros((labels.size, 4), np.int32)
    boxes[:, 0], boxes[:, 1] = size
    for i in range(labels.size):
        x, y, inverse_depth = projections[0, i], projections[1, i], projections[2, i]
        half_width = half * projections[3, i] * inverse_depth + np.float32(_FOOTPRINT_PX)
        # A cast to int rounds towards 0.
        left, right = int(max(x - half_width + one, nought)), int(min(x + half_width + one, width))
        top, bottom = int(max(y - half_width + one, nought)), int(min(y + half_width + one, height))
        if inverse_depth > nought and left < right and top < bottom:
            square, box = squares[i], boxes[labels[i]]
            square[0], square[1], square[2], square[3] = left, top, right, bottom
            box[0], box[1] = min(box[0], left), min(box[1], top)
            box[2], box[3] = max(box[2], right), max(box[3], bottom)
    return squares


@kernel(inner=True)
def _window(boxes: I4, margin: int, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, right + 1, bottom + 1 of a window that encloses boxes with a margin.

    ``boxes`` (k, 4) are from `_cover`, ``size`` is width and height of the image. The boxes are
    shifted into the window in place; empty boxes become zeros. If all are empty, so is the window,
    and the result is zeros.
    """
    left, top, right, bottom = size[0], size[1], 0, 0
    for box in boxes:
        if box[2] > 0:
            left, top = min(left, box[0]), min(top, box[1])
            right, bottom = max(right, box[2]), max(bottom, box[3])
    if right == 0:
        boxes[:] = 0
        return 0, 0, 0, 0
    left, top = max(left - margin, 0), max(top - margin, 0)
    for box in boxes:
        painted = box[2] > 0
        for k in range(4):
            box[k] = box[k] - (left, top)[k % 2] if painted else 0
    return left, top, min(right + margin, size[0]), min(bottom + margin, size[1])


@kernel(inner=True)
def _paint(
    squares: I4,
    labels: I4,
    inverse_depth: F4,
    corner: tuple[int, int],
    nearest: F4,
    splat: I4,
) -> None:
    """Paint the labels of squares into a window, where they are the nearest.

    ``squares`` (n, 4) are from `_cover`, with their ``labels`` and ``inverse_depth`` (n,).
    ``corner`` is the left and top of the window; the labels go to ``splat`` (h, w), and their
    inverse depths to ``nearest`` (h, w).
    """
    left, top = corner
    for i in range(labels.size):
        for v in range(squares[i, 1] - top, squares[i, 3] - top):
            for u in range(squares[i, 0] - left, squares[i, 2] - left):
                if inverse_depth[i] > nearest[v, u]:
                    nearest[v, u] = inverse_depth[i]
                    splat[v, u] = labels[i]


@kernel(inner=True)
def _nearest_surface(around: F4, corner: tuple[int, int], cell: int, shape: tuple[int, int]) -> F4:
    """Return the largest inverse depth of points in each cell of a window; 0 without points.

    ``around`` is from `_project_pixels`; ``corner`` is left and top of the window, ``shape`` its
    height and width; cells are squares of ``cell`` pixels.
    """
    height, width = np.float32(shape[0]), np.float32(shape[1])
    left, top, per_cell = np.float32(corner[0]), np.float32(corner[1]), np.float32(1 / cell)
    front = np.zeros((shape[0] // cell + 1, shape[1] // cell + 1), np.float32)
    for i in range(around.shape[1]):
        inverse_depth, column, row = around[2, i], around[0, i] - left, around[1, i] - top
        if inverse_depth > 0 and 0 <= column < width and 0 <= row < height:
            y, x = int(row * per_cell), int(column * per_cell)
            front[y, x] = max(front[y, x], inverse_depth)
    return front


@kernel(inner=True)
def _hide(front: F4, cell: int, boxes: I4, nearest: F4, splat: I4) -> None:
    """Set to label 0 pixels in boxes that show another surface, in front of an object or alone.

    ``boxes`` are as in `splat_depth`; ``front`` is from `_nearest_surface`, with its ``cell``;
    ``splat`` (h, w) holds the labels, ``nearest`` (h, w) their inverse depth, 0 without a label.
    """
    limit, share = np.zeros(splat.shape[1], np.float32), np.float32(1 - _HIDDEN)
    for k in range(boxes.shape[0]):
        left, top, right, bottom = boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3]
        for v in range(top, bottom):
            if v == top or v % cell == 0:
                for x in range(left // cell, (right - 1) // cell + 1):
                    limit[x * cell : (x + 1) * cell] = front[v // cell, x] * share
            labels, nearest_row = splat[v], nearest[v]
            for u in range(left, right):
                labels[u] = 0 if limit[u] > nearest_row[u] else labels[u]
