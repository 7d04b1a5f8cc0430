"""Points of the depth sensor on the image of a colour camera, and what hides what there."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, U1
from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import LENS_MODELS, distort
from shapecat.jit import kernel
from shapecat.types import Camera, Pose

__all__ = ["Painted", "project", "rectified", "splat_depth"]

_FOOTPRINT_PX = 0.05
"""A depth pixel covers so much more of the colour image on each side, to leave no gaps."""
_HIDDEN = 0.02
"""An object is hidden where something else is nearer by more than this share of its distance."""
_SPARSE = 2
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
    depth: F4, camera: Camera, labels: I4, lens: LensCamera, colour_from_depth: Pose
) -> Painted:
    """Paint a depth image as a colour camera sees it, where it has labels and around them.

    Each labelled depth pixel covers a square on the colour image, as large as its own, and a little
    more; where several cover a pixel, the nearest shows. What has no label is painted coarsely: it
    matters by what it hides, and by the gaps that are none.

    Parameters
    ----------
    depth : (h, w) metres, 0 where there is no reading.
    labels : (h, w) int32 what each depth pixel belongs to, 0 for nothing.

    Notes
    -----
    O(depth pixels + what they cover).
    """
    target = lens.pinhole
    rows, columns = _around(depth, labels, camera, colour_from_depth)
    depth, labels = (np.ascontiguousarray(image[rows, columns]) for image in (depth, labels))
    x = (np.arange(camera.width)[columns] - camera.cx) / camera.fx
    y = (np.arange(camera.height)[rows] - camera.cy) / camera.fy
    turn = colour_from_depth.rotation
    # A ray is turned by adding what its column and its row give to each coordinate.
    by_column = np.outer(turn[:, 0], x).astype(np.float32)
    by_row = (np.outer(y, turn[:, 1]) + turn[:, 2]).astype(np.float32)
    rays = by_column, by_row, colour_from_depth.translation.astype(np.float32)
    numbers, *distortion = _lens_numbers(lens)
    scale = max(target.fx / camera.fx, target.fy / camera.fy)
    size, margin = (target.width, target.height), int(_BESIDE_PX * scale)
    left, top, right, bottom = _landing(depth, labels, *rays, numbers, *distortion, size, margin)
    seen = np.full((max(0, bottom - top), max(0, right - left)), -1, np.int32)
    numbers[2:] -= (left, top)
    half, cell = np.float32(scale / 2), max(2, int(_SPARSE * scale + 0.5))
    _splat(depth, labels, *rays, numbers, *distortion, half, cell, seen)
    return Painted(left, top, seen)


def _around(depth: F4, labels: I4, camera: Camera, colour_from_depth: Pose) -> tuple[slice, slice]:
    """Return the rows and columns of what may hide labelled pixels, or lie beside them.

    Between a near and a far pixel that one camera sees in the same place, the other sees the
    parallax: focal length by distance of the cameras by difference of the inverse depths.
    """
    top, bottom, left, right, near, far = _extent(depth, labels)
    if bottom <= top:
        return slice(0, 0), slice(0, 0)
    shift = float(np.linalg.norm(colour_from_depth.translation))
    margin = int(max(camera.fx, camera.fy) * shift * (1 / near - 1 / far)) + _BESIDE_PX
    return (
        slice(max(0, top - margin), bottom + margin),
        slice(max(0, left - margin), right + margin),
    )


@kernel
def _extent(depth: F4, labels: I4) -> tuple[int, int, int, int, float, float]:
    """Return about where labelled pixels are, the least depth of all, and the greatest of theirs.

    Every other row and column is looked at.
    """
    top, bottom, left, right = depth.shape[0], 0, depth.shape[1], 0
    near, far = np.float32(np.inf), np.float32(0)
    for v in range(0, depth.shape[0], 2):
        for u in range(0, depth.shape[1], 2):
            z = depth[v, u]
            if z > 0:
                near = min(near, z)
                if labels[v, u] > 0:
                    far = max(far, z)
                    top, bottom = min(top, v), max(bottom, v + 1)
                    left, right = min(left, u), max(right, u + 1)
    return top, bottom, left, right, float(near), float(far)


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
def _see_row(
    depth: F4,
    by_column: F4,
    by_row: F4,
    shift: F4,
    numbers: F4,
    kind: int,
    d: F4,
    reach: float,
    seen: F4,
) -> None:
    """Find where a row of a depth image (w,) lands: (3, w) column, row, inverse distance."""
    for k in range(3):
        for u in range(depth.size):
            seen[k, u] = (by_column[k, u] + by_row[k]) * depth[u] + shift[k]
    _see(seen[0], seen[1], seen[2], numbers, kind, d, reach)


@kernel
def _landing(
    depth: F4,
    labels: I4,
    by_column: F4,
    by_row: F4,
    shift: F4,
    numbers: F4,
    kind: int,
    d: F4,
    reach: float,
    size: tuple[int, int],
    margin: int,
) -> tuple[int, int, int, int]:
    """Return the window around where labelled pixels land: left, top, right, bottom."""
    left, top, right, bottom = size[0], size[1], 0, 0
    seen = np.zeros((3, depth.shape[1]), np.float32)
    for v in range(0, depth.shape[0], 4):
        _see_row(depth[v], by_column, by_row[v], shift, numbers, kind, d, reach, seen)
        for u in range(0, depth.shape[1], 2):
            if labels[v, u] > 0 and depth[v, u] > 0 and seen[2, u] > 0:
                x, y = seen[0, u], seen[1, u]
                if -margin < x < size[0] + margin and -margin < y < size[1] + margin:
                    left, top = min(left, int(x) - margin), min(top, int(y) - margin)
                    right, bottom = max(right, int(x) + margin), max(bottom, int(y) + margin)
    return max(left, 0), max(top, 0), min(right, size[0]), min(bottom, size[1])


@kernel
def _splat(
    depth: F4,
    labels: I4,
    by_column: F4,
    by_row: F4,
    shift: F4,
    numbers: F4,
    kind: int,
    d: F4,
    reach: float,
    scale: float,
    cell: int,
    seen: I4,
) -> None:
    """Paint labels where they land, then take back what something without a label hides.

    ``scale`` is half the pixels of the image to a pixel of the depth image, at equal distance.
    """
    height, width = seen.shape
    wide, tall, per_cell = np.float32(width), np.float32(height), np.float32(1 / cell)
    nought, margin = np.float32(0), np.float32(_FOOTPRINT_PX)
    place = np.zeros((3, depth.shape[1]), np.float32)
    nearest = np.zeros(seen.shape, np.float32)
    front = np.zeros((height // cell + 1, width // cell + 1), np.float32)
    for v in range(depth.shape[0]):
        _see_row(depth[v], by_column, by_row[v], shift, numbers, kind, d, reach, place)
        for u in range(depth.shape[1]):
            label = labels[v, u]
            if label <= 0 and (u | v) & (_SPARSE - 1):
                continue
            z, column, row, near = depth[v, u], place[0, u], place[1, u], place[2, u]
            if not z > nought or not near > nought:
                continue
            if label > 0:
                half = scale * z * near + margin
                _paint_square(label, near, column, row, half, nearest, seen)
            elif nought <= column < wide and nought <= row < tall:
                y, x = np.uint32(row * per_cell), np.uint32(column * per_cell)
                front[y, x] = max(front[y, x], near)
    for j in range(front.shape[0]):
        for i in range(front.shape[1]):
            if front[j, i] > nought:
                _hide_behind(front[j, i], j * cell, i * cell, cell, nearest, seen)


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
def _hide_behind(front: float, top: int, left: int, cell: int, nearest: F4, seen: I4) -> None:
    """Give a cell of the image no label where something at inverse distance ``front`` is nearer."""
    limit = front * np.float32(1 - _HIDDEN)
    for j in range(top, min(top + cell, seen.shape[0])):
        for i in range(left, min(left + cell, seen.shape[1])):
            if limit > nearest[j, i]:
                seen[j, i] = 0
