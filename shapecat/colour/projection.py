"""Points of the depth sensor on the image of a colour camera, and what hides what there."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, Bool
from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import LENS_MODELS, distort
from shapecat.jit import kernel
from shapecat.types import Camera, Pose

__all__ = ["Painted", "hidden", "project", "rectified", "splat_depth"]

_FOOTPRINT_PX = 0.05
"""A depth pixel covers so much more of the colour image on each side, to leave no gaps."""
_HIDDEN = 0.02
"""A point is hidden where something is nearer by more than this share of its distance."""
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
    camera, (kind, d) = lens.pinhole, _distortion(lens)
    numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    reach = _reach(lens) ** 2 if kind else np.inf
    seen = np.zeros((len(points), 3), np.float32)
    rotation = np.ascontiguousarray(colour_from_depth.rotation)
    points, shift = np.asarray(points, np.float64), colour_from_depth.translation
    _project(points, rotation, shift, numbers, kind, d.astype(np.float64), reach, seen)
    return seen


def _distortion(lens: LensCamera) -> tuple[int, F4]:
    """Return what kernels know of a lens: 0 none, 1 the polynomial, 2 the fisheye; 8 numbers."""
    if lens.model and lens.model not in LENS_MODELS:
        msg = f"lens distortion {lens.model!r} is not known"
        raise ValueError(msg)
    d = np.zeros(8, np.float32)
    d[: len(lens.coefficients[:8])] = lens.coefficients[:8]
    return 0 if not lens.model else 2 if lens.model in _FISHEYE else 1, d


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

    ``nearest`` (h, w) is the inverse distance, 0 where nothing is known; ``labels`` (h, w) int32
    what is seen, -1 there.
    """

    left: int
    top: int
    nearest: F4
    labels: I4


def splat_depth(
    depth: F4, camera: Camera, labels: I4, lens: LensCamera, colour_from_depth: Pose
) -> Painted:
    """Paint a depth image as a colour camera sees it, where it has labels and around them.

    Each depth pixel covers a square on the colour image, as large as its own, and a little more;
    where several cover a pixel, the nearest shows.

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
    by_column = np.outer(x, turn[:, 0]).astype(np.float32)
    by_row = (np.outer(y, turn[:, 1]) + turn[:, 2]).astype(np.float32)
    shift = colour_from_depth.translation.astype(np.float32)
    kind, d = _distortion(lens)
    scale = max(target.fx / camera.fx, target.fy / camera.fy)
    limits = np.array((_reach(lens) ** 2 if kind else np.inf, scale / 2, _FOOTPRINT_PX), np.float32)
    numbers = np.array((target.fx, target.fy, target.cx, target.cy), np.float32)
    size = (target.width, target.height)
    margin = int(_BESIDE_PX * scale)
    rays, lens_of = (by_column, by_row, shift), (numbers, kind, d, limits)
    left, top, right, bottom = _landing(depth, labels, *rays, *lens_of, size, margin)
    nearest = np.zeros((max(0, bottom - top), max(0, right - left)), np.float32)
    owners = np.full(nearest.shape, -1, np.int32)
    numbers[2:] -= (left, top)
    _splat(depth, labels, *rays, *lens_of, nearest, owners)
    return Painted(left, top, nearest, owners)


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
    """Return where labelled pixels are, the least depth of all, and the greatest of theirs."""
    top, bottom, left, right = depth.shape[0], 0, depth.shape[1], 0
    near, far = np.inf, 0.0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if z > 0:
                near = min(near, z)
                if labels[v, u] > 0:
                    far = max(far, z)
                    top, bottom = min(top, v), max(bottom, v + 1)
                    left, right = min(left, u), max(right, u + 1)
    return top, bottom, left, right, near, far


@kernel
def _bend(x: float, y: float, kind: int, d: F4) -> tuple[float, float]:
    """Return `shapecat.cameras.lenses.distort` of one ray: 1 is the polynomial, 2 the fisheye."""
    one, two = np.float32(1), np.float32(2)
    r = x * x + y * y
    if kind == 2:
        radius = max(np.sqrt(r), np.float32(1e-9))
        angle = np.arctan(radius)
        s = angle * angle
        bent = angle * (one + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3])))) / radius
        return x * bent, y * bent
    k1, k2, p1, p2, k3, k4, k5, k6 = d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7]
    radial = (one + r * (k1 + r * (k2 + r * k3))) / (one + r * (k4 + r * (k5 + r * k6)))
    a = x * radial + two * p1 * x * y + p2 * (r + two * x * x)
    b = y * radial + p1 * (r + two * y * y) + two * p2 * x * y
    return a, b


@kernel
def _place(
    px: float, py: float, pz: float, numbers: F4, kind: int, d: F4, reach: float
) -> tuple[Any, Any, Any]:
    """Return column, row and inverse distance of a point; 0 for one that is not seen."""
    nowhere = numbers[0] * 0, numbers[0] * 0, numbers[0] * 0  # of the precision of the others
    if not pz > np.float32(1e-3):
        return nowhere
    near = np.float32(1) / pz
    x, y = px * near, py * near
    if kind:
        if x * x + y * y >= reach:
            return nowhere
        x, y = _bend(x, y, kind, d)
    return x * numbers[0] + numbers[2], y * numbers[1] + numbers[3], near


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
    limits: F4,
    size: tuple[int, int],
    margin: int,
) -> tuple[int, int, int, int]:
    """Return the window around where labelled pixels land: left, top, right, bottom."""
    left, top, right, bottom = size[0], size[1], 0, 0
    for v in range(0, depth.shape[0], 2):
        for u in range(0, depth.shape[1], 2):
            z = depth[v, u]
            if labels[v, u] > 0 and z > 0:
                px = (by_column[u, 0] + by_row[v, 0]) * z + shift[0]
                py = (by_column[u, 1] + by_row[v, 1]) * z + shift[1]
                pz = (by_column[u, 2] + by_row[v, 2]) * z + shift[2]
                x, y, near = _place(px, py, pz, numbers, kind, d, limits[0])
                inside = -margin < x < size[0] + margin and -margin < y < size[1] + margin
                if near > 0 and inside:
                    left, top = min(left, int(x) - margin), min(top, int(y) - margin)
                    right, bottom = max(right, int(x) + margin), max(bottom, int(y) + margin)
    return max(left, 0), max(top, 0), min(right, size[0]), min(bottom, size[1])


@kernel
def _project(
    points: F8, rotation: F8, shift: F8, numbers: F8, kind: int, d: F8, reach: float, seen: F4
) -> None:
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + shift[0]
        py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + shift[1]
        pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + shift[2]
        column, row, near = _place(px, py, pz, numbers, kind, d, reach)
        if near > 0:
            seen[i, 0], seen[i, 1], seen[i, 2] = column, row, pz
        else:
            seen[i] = np.nan


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
    limits: F4,
    nearest: F4,
    owners: I4,
) -> None:
    height, width = nearest.shape
    reach, scale, margin = limits[0], limits[1], limits[2]
    wide, tall = np.float32(width), np.float32(height)
    nought, one, two = np.float32(0), np.float32(1), np.float32(2)
    for v in range(depth.shape[0]):
        ray_x, ray_y, ray_z = by_row[v, 0], by_row[v, 1], by_row[v, 2]
        for u in range(depth.shape[1]):
            z, label = depth[v, u], labels[v, u]
            # What is of no object matters by what it hides: a quarter of it is enough.
            if not z > nought or (label == 0 and (u | v) & 1):
                continue
            px = (by_column[u, 0] + ray_x) * z + shift[0]
            py = (by_column[u, 1] + ray_y) * z + shift[1]
            pz = (by_column[u, 2] + ray_z) * z + shift[2]
            column, row, near = _place(px, py, pz, numbers, kind, d, reach)
            half = scale * z * near + margin if label else two * scale * z * near
            # The pixels whose middle lies in the square; a cast to int rounds towards 0.
            left, right = max(column - half + one, nought), min(column + half, wide - one)
            top, bottom = max(row - half + one, nought), min(row + half, tall - one)
            if near > nought and left < right + one and top < bottom + one:
                for j in range(np.uint32(top), np.uint32(max(bottom, nought)) + np.uint32(1)):
                    for i in range(np.uint32(left), np.uint32(max(right, nought)) + np.uint32(1)):
                        if near > nearest[j, i]:
                            nearest[j, i] = near
                            owners[j, i] = label


def hidden(seen: F4, painted: Painted) -> Bool:
    """Tell which points the colour camera does not see.

    Parameters
    ----------
    seen : (n, 3) as from `project`.
    painted : what is nearest, as from `splat_depth`.

    Returns
    -------
    (n,) True for points behind something nearer, and outside of what is painted.
    """
    height, width = painted.nearest.shape
    seen = seen - np.array([painted.left, painted.top, 0], np.float32)
    with np.errstate(invalid="ignore"):
        inside = (seen[:, 0] > -0.5) & (seen[:, 0] < width - 0.5)
        inside &= (seen[:, 1] > -0.5) & (seen[:, 1] < height - 0.5)
    result = np.ones(len(seen), bool)
    u, v, z = seen[inside].T
    front = painted.nearest[np.rint(v).astype(np.int64), np.rint(u).astype(np.int64)]
    result[inside] = front * z * (1 - _HIDDEN) > 1
    return result
