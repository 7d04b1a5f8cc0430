"""Points of the depth sensor on the image of a colour camera, and what hides what there."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, U1, U4, Bool
from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import LENS_MODELS, distort
from shapecat.jit import kernel
from shapecat.types import Camera, Pose

__all__ = ["Painted", "project", "rectified", "splat_depth"]

_FOOTPRINT_PX = 0.05
"""A depth pixel covers so much more of the colour image on each side, to leave no gaps."""
_HIDDEN = 0.02
"""An object is hidden where something else is nearer by more than this share of its distance."""
_SPARSE = 4
"""Of what is of no object, every so-many-th row and column is looked at."""
_BESIDE_PX = 30
"""Depth pixels so far from labelled ones are looked at, for what lies beside and between them."""
_WIDEST = 3.0
"""Slopes beyond this, 72 degrees off the axis, are not looked at."""
_FISHEYE = {"equidistant", "fisheye"}


def project(points: F4, lens: LensCamera, colour_from_depth: Pose) -> F4:
    """Return where a colour camera sees points.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame; rows that are not finite stay so.
    colour_from_depth : pose of the sensor in the optical frame of the colour camera.

    Returns
    -------
    (n, 3) column, row (0 is the middle of the first pixel) and distance along the optical axis,
    metres; NaN behind the camera, and beyond what a lens with distortion maps one to one.

    Examples
    --------
    >>> lens = LensCamera(Camera(640, 480, 500.0, 500.0, 320.0, 240.0))
    >>> project(np.array([[0.1, -0.2, 1.0]]), lens, Pose(np.eye(3), np.array([0.1, 0.0, 1.0])))
    array([[370., 190.,   2.]], dtype=float32)
    """
    rotation = colour_from_depth.rotation.astype(np.float32)
    shift, seen = colour_from_depth.translation.astype(np.float32), np.zeros((3, len(points)), "f4")
    _turn(np.asarray(points, np.float32), rotation, shift, seen)
    distances = seen[2].copy()
    _see(seen[0], seen[1], seen[2], *_lens_numbers(lens))
    return np.where(seen[2] > 0, (seen[0], seen[1], distances), np.float32(np.nan)).T


def _lens_numbers(lens: LensCamera) -> tuple[F4, int, F4, float]:
    """Return what kernels know of a lens: fx, fy, cx, cy; its kind; 8 coefficients; its reach.

    The kind is 0 for none, 1 for the polynomial, 2 for the fisheye; the reach a squared slope.
    """
    if lens.model and lens.model not in LENS_MODELS:
        msg = f"lens distortion {lens.model!r} is not known"
        raise ValueError(msg)
    d = np.zeros(8, np.float32)
    d[: len(lens.coefficients[:8])] = lens.coefficients[:8]
    kind = 0 if not lens.model else 2 if lens.model in _FISHEYE else 1
    camera, reach = lens.pinhole, _reach(lens) ** 2 if kind else np.inf
    numbers = np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32)
    return numbers, kind, d, reach


def rectified(pixels: U1, lens: LensCamera) -> U1:
    """Return an image (h, w, 3) as the pinhole of its camera would show it.

    Between four pixels colours are interpolated; what the lens has not seen is black.
    """
    if not lens.model:
        return pixels
    camera = lens.pinhole
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    x, y = distort(rays, lens.model, lens.coefficients).transpose(2, 0, 1)
    x, y = x * camera.fx + camera.cx, y * camera.fy + camera.cy
    inside = (x >= 0) & (x <= camera.width - 1) & (y >= 0) & (y <= camera.height - 1)
    inside &= (rays**2).sum(axis=-1) < _reach(lens) ** 2
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    left, top = (
        np.minimum(x.astype(int), camera.width - 2),
        np.minimum(y.astype(int), camera.height - 2),
    )
    a, b = (x - left)[..., None], (y - top)[..., None]
    upper = pixels[top, left] * (1 - a) + pixels[top, left + 1] * a
    lower = pixels[top + 1, left] * (1 - a) + pixels[top + 1, left + 1] * a
    mixed = upper * (1 - b) + lower * b
    return np.asarray(np.rint(mixed * inside[..., None]), np.uint8)


@lru_cache(maxsize=16)
def _reach(lens: LensCamera) -> float:
    """Return the slope up to which rays farther out are seen farther out.

    Beyond, the polynomial of a lens turns back and shows the side of the scene in its middle.
    """
    slopes = np.linspace(0, _WIDEST, 601)[1:]
    seen = distort(np.column_stack([slopes, 0 * slopes]), lens.model, lens.coefficients)[:, 0]
    back = np.flatnonzero(np.diff(seen) <= 0)
    return float(slopes[back[0]]) if back.size else _WIDEST


class Painted(NamedTuple):
    """A part of an image as the colour camera sees it, from row ``top`` and column ``left`` on.

    ``labels`` (h, w) int32 is what is seen, -1 where nothing is known.
    """

    left: int
    top: int
    labels: I4


def splat_depth(
    depth: F4, camera: Camera, objects: Sequence[U4], lens: LensCamera, colour_from_depth: Pose
) -> Painted:
    """Paint the objects of a depth image as a colour camera sees them.

    Each depth pixel of an object covers a square on the colour image, as large as its own, and a
    little more; where several cover a pixel, the nearest shows. The other pixels are painted
    coarsely: they matter by what they hide, and by the gaps that are none.

    Parameters
    ----------
    depth : (h, w) metres, 0 where there is no reading.
    objects : indices of the pixels of each object.

    Notes
    -----
    O(pixels of the objects and what they cover; a few around them).
    """
    target, numbers, *distortion = lens.pinhole, *_lens_numbers(lens)
    scale = max(target.fx / camera.fx, target.fy / camera.fy)
    pixels = np.concatenate([np.zeros(0, np.uint32), *objects])
    labels = np.repeat(np.arange(1, len(objects) + 1, dtype=np.int32), list(map(len, objects)))
    beside = _beside(depth, pixels, camera, colour_from_depth)
    rays = _rays(camera, colour_from_depth)
    place, around = np.zeros((4, len(pixels)), "f4"), np.zeros((4, len(beside)), "f4")
    for indices, seen in ((pixels, place), (beside, around)):
        _move(depth, indices, *rays, seen)
        _see(seen[0], seen[1], seen[2], numbers, *distortion)
    size, margin = (target.width, target.height), int(_BESIDE_PX * scale)
    left, top, right, bottom = _landing(place, size, margin)
    seen = np.full((max(0, bottom - top), max(0, right - left)), -1, np.int32)
    half, cell = np.float32(scale / 2), max(2, int(_SPARSE * scale + 0.5))
    corner = np.array((left, top), np.float32)
    _splat(place, labels, around, corner, half, cell, seen)
    return Painted(left, top, seen)


def _rays(camera: Camera, colour_from_depth: Pose) -> tuple[F4, F4, F4]:
    """Return what column and row (3, n) give to a ray that is turned, and the shift (3,)."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    turn = colour_from_depth.rotation
    by_column, by_row = np.outer(turn[:, 0], x), np.outer(turn[:, 1], y) + turn[:, 2:]
    return (
        by_column.astype(np.float32),
        by_row.astype(np.float32),
        colour_from_depth.translation.astype(np.float32),
    )


def _beside(depth: F4, pixels: U4, camera: Camera, colour_from_depth: Pose) -> U4:
    """Return the sparse pixels of no object that may hide those of objects, or lie beside them.

    Between a near and a far pixel that one camera sees in the same place, the other sees the
    parallax: focal length by distance of the cameras by difference of the inverse depths.
    """
    own = np.zeros((-(-depth.shape[0] // _SPARSE), -(-depth.shape[1] // _SPARSE)), np.bool_)
    top, bottom, left, right, near, far = _extent(depth, pixels, own)
    if not near < np.inf or bottom < top:
        return np.zeros(0, np.uint32)
    shift = float(np.linalg.norm(colour_from_depth.translation))
    parallax = max(camera.fx, camera.fy) * shift * max(0.0, 1 / near - 1 / far)
    margin = int(parallax) + _BESIDE_PX
    rows, columns = (top - margin, bottom + margin), (left - margin, right + margin)
    return np.asarray(_list_others(depth, own, rows, columns))


@kernel
def _extent(depth: F4, pixels: U4, own: Bool) -> tuple[int, int, int, int, float, float]:
    """Return first and last row and column of some pixels, the least depth of all, their greatest.

    ``own`` becomes which of the sparse pixels are theirs.
    """
    top, bottom, left, right = depth.shape[0], -1, depth.shape[1], -1
    near, far = np.float32(np.inf), np.float32(0)
    width = np.uint32(depth.shape[1])
    for pixel in pixels:
        v, u = int(pixel // width), int(pixel % width)
        if depth[v, u] > 0:
            far = max(far, depth[v, u])
            top, bottom, left, right = min(top, v), max(bottom, v), min(left, u), max(right, u)
            if v % _SPARSE == 0 and u % _SPARSE == 0:
                own[v // _SPARSE, u // _SPARSE] = True
    for j in range(own.shape[0]):
        for i in range(own.shape[1]):
            z = depth[j * _SPARSE, i * _SPARSE]
            if z > 0:
                near = min(near, z)
    return top, bottom, left, right, float(near), float(far)


@kernel
def _list_others(depth: F4, own: Bool, rows: tuple[int, int], columns: tuple[int, int]) -> U4:
    """Return the sparse pixels with a reading, from a row to one and a column to one, but own."""
    found, count = np.zeros(own.size, np.uint32), 0
    for j in range(max(0, rows[0]) // _SPARSE, min(rows[1] // _SPARSE + 1, own.shape[0])):
        for i in range(max(0, columns[0]) // _SPARSE, min(columns[1] // _SPARSE + 1, own.shape[1])):
            if depth[j * _SPARSE, i * _SPARSE] > 0 and not own[j, i]:
                found[count] = (j * depth.shape[1] + i) * _SPARSE
                count += 1
    return found[:count]


@kernel
def _turn(points: F4, rotation: F4, shift: F4, turned: F4) -> None:
    """Move points (n, 3) into the frame of a camera; behind it where they are not finite."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        known = np.isfinite(x + y + z)
        for k in range(3):
            value = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + shift[k]
            turned[k, i] = value if known else np.float32(-1)


@kernel(fast=True)
def _see(x: F4, y: F4, z: F4, numbers: F4, kind: int, d: F4, reach: float) -> None:
    """Turn points in the frame of a camera, in place, into column, row and inverse distance.

    The inverse distance is 0 for what is not seen. Source of the lenses:
    `shapecat.cameras.lenses.distort`.
    """
    one, two, nought = np.float32(1), np.float32(2), np.float32(0)
    for k in range(x.size):
        near = one / max(z[k], np.float32(1e-3))
        x[k], y[k] = x[k] * near, y[k] * near
        z[k] = near if z[k] > np.float32(1e-3) else nought
    if kind == 1:
        k1, k2, p1, p2, k3, k4, k5, k6 = d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7]
        for k in range(x.size):
            a, b = x[k], y[k]
            r = a * a + b * b
            radial = (one + r * (k1 + r * (k2 + r * k3))) / (one + r * (k4 + r * (k5 + r * k6)))
            x[k] = a * radial + two * p1 * a * b + p2 * (r + two * a * a)
            y[k] = b * radial + p1 * (r + two * b * b) + two * p2 * a * b
            z[k] = z[k] if r < reach else nought
    elif kind == 2:
        for k in range(x.size):
            r = x[k] * x[k] + y[k] * y[k]
            radius = max(np.sqrt(r), np.float32(1e-9))
            angle = np.arctan(radius)
            s = angle * angle
            bent = angle * (one + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3])))) / radius
            x[k], y[k] = x[k] * bent, y[k] * bent
            z[k] = z[k] if r < reach else nought
    for k in range(x.size):
        x[k], y[k] = x[k] * numbers[0] + numbers[2], y[k] * numbers[1] + numbers[3]


@kernel
def _move(depth: F4, pixels: U4, by_column: F4, by_row: F4, shift: F4, moved: F4) -> None:
    """Find pixels in the frame of the colour camera: (4, n) x, y, z, and their depth."""
    width = np.uint32(depth.shape[1])
    for i in range(pixels.size):
        v, u = int(pixels[i] // width), int(pixels[i] % width)
        z = depth[v, u]
        for k in range(3):
            moved[k, i] = (by_column[k, u] + by_row[k, v]) * z + shift[k]
        moved[3, i] = z
        if not z > 0:
            moved[2, i] = -1


@kernel
def _landing(place: F4, size: tuple[int, int], margin: int) -> tuple[int, int, int, int]:
    """Return the window around where pixels land: left, top, right, bottom."""
    left, top, right, bottom = size[0], size[1], 0, 0
    for i in range(place.shape[1]):
        x, y = place[0, i], place[1, i]
        if place[2, i] > 0 and -margin < x < size[0] + margin and -margin < y < size[1] + margin:
            left, top = min(left, int(x) - margin), min(top, int(y) - margin)
            right, bottom = max(right, int(x) + margin), max(bottom, int(y) + margin)
    return max(left, 0), max(top, 0), min(right, size[0]), min(bottom, size[1])


@kernel
def _splat(
    place: F4, labels: I4, around: F4, corner: F4, scale: float, cell: int, seen: I4
) -> None:
    """Paint labels where they land, then take back what something without a label hides.

    Pixels land at (4, n) column, row, inverse distance, and have a depth. ``corner`` is left and
    top of the window; ``scale`` half the pixels of the image to a pixel of the depth image, at
    equal distance.
    """
    height, width = seen.shape
    wide, tall, per_cell = np.float32(width), np.float32(height), np.float32(1 / cell)
    nought, margin = np.float32(0), np.float32(_FOOTPRINT_PX)
    nearest = np.zeros(seen.shape, np.float32)
    front = np.zeros((height // cell + 1, width // cell + 1), np.float32)
    for i in range(labels.size):
        near = place[2, i]
        if near > nought:
            half = scale * place[3, i] * near + margin
            column, row = place[0, i] - corner[0], place[1, i] - corner[1]
            _paint_square(labels[i], near, column, row, half, nearest, seen)
    for i in range(around.shape[1]):
        near, column, row = around[2, i], around[0, i] - corner[0], around[1, i] - corner[1]
        if near > nought and nought <= column < wide and nought <= row < tall:
            y, x = np.uint32(row * per_cell), np.uint32(column * per_cell)
            front[y, x] = max(front[y, x], near)
    for j in range(front.shape[0]):
        _hide_behind(front[j], cell, nearest[j * cell : (j + 1) * cell], seen[j * cell :])


@kernel
def _paint_square(
    label: int, near: float, column: float, row: float, half: float, nearest: F4, seen: I4
) -> None:
    """Paint the pixels whose middle lies in a square, where it is the nearest."""
    nought, one = np.float32(0), np.float32(1)
    # A cast to int rounds towards 0.
    left, right = max(column - half + one, nought), min(column + half, seen.shape[1] - one)
    top, bottom = max(row - half + one, nought), min(row + half, seen.shape[0] - one)
    if left >= right + one or top >= bottom + one:
        return
    for j in range(np.uint32(top), np.uint32(max(bottom, nought)) + np.uint32(1)):
        for i in range(np.uint32(left), np.uint32(max(right, nought)) + np.uint32(1)):
            if near > nearest[j, i]:
                nearest[j, i] = near
                seen[j, i] = label


@kernel
def _hide_behind(front: F4, cell: int, nearest: F4, seen: I4) -> None:
    """Give rows no label where something at the inverse distances ``front`` of cells is nearer."""
    limit = np.zeros(nearest.shape[1], np.float32)
    for i in range(limit.size):
        limit[i] = front[i // cell] * np.float32(1 - _HIDDEN)
    for j in range(nearest.shape[0]):
        own, labels = nearest[j], seen[j]
        for i in range(limit.size):
            labels[i] = 0 if limit[i] > own[i] else labels[i]
