"""Projection of points from the depth sensor into the image of a colour camera."""

from functools import lru_cache

import numpy as np

from shapecat.arrays import F4, F8, U1
from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import FISHEYE_MODELS, LENS_MODELS, distort
from shapecat.jit import kernel
from shapecat.types import Pose

__all__ = ["Lens", "kernel_lens", "project", "project_in_place", "rectified"]

_WIDEST = 3.0
"""Largest slope that a lens with distortion is assumed to see: 72 degrees off the axis."""
Lens = tuple[F4, int, F4, float]
"""A lens for kernels: fx, fy, cx, cy in pixels; the kind of distortion (0 none, 1 polynomial,
2 fisheye); its 8 coefficients; and the square of the largest slope that the lens sees."""


def project(points: F4, lens: LensCamera, colour_from_depth: Pose) -> F4:
    """Return the pixels where a colour camera sees points.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame; rows that are not finite give NaN.
    lens : the colour camera.
    colour_from_depth : pose of the depth sensor in the optical frame of the colour camera.

    Returns
    -------
    (n, 3) column and row (0 is the centre of the first pixel) and depth along the optical axis,
    metres; NaN for points behind the camera, or so far off its axis that the distortion is no
    longer one-to-one.

    Raises
    ------
    ValueError : the distortion model is not known.

    Examples
    --------
    >>> from shapecat.types import Camera
    >>> lens = LensCamera(Camera(640, 480, 500.0, 500.0, 320.0, 240.0))
    >>> project(np.array([[0.1, -0.2, 1.0]]), lens, Pose(np.eye(3), np.array([0.1, 0.0, 1.0])))
    array([[370., 190.,   2.]], dtype=float32)
    """
    rotation = colour_from_depth.rotation.astype(np.float32)
    shift, projected = (
        colour_from_depth.translation.astype(np.float32),
        np.zeros((3, len(points)), "f4"),
    )
    _to_camera(np.asarray(points, np.float32), rotation, shift, projected)
    distances = projected[2].copy()
    project_in_place(projected[0], projected[1], projected[2], *kernel_lens(lens))
    return np.where(projected[2] > 0, (projected[0], projected[1], distances), np.float32(np.nan)).T


def kernel_lens(lens: LensCamera) -> Lens:
    """Return a lens in the form that kernels take.

    Raises
    ------
    ValueError : the distortion model is not known.
    """
    if lens.model and lens.model not in LENS_MODELS:
        msg = f"lens distortion {lens.model!r} is not known"
        raise ValueError(msg)
    d = np.zeros(8, np.float32)
    d[: len(lens.coefficients[:8])] = lens.coefficients[:8]
    kind = 0 if not lens.model else 2 if lens.model in FISHEYE_MODELS else 1
    camera, max_slope2 = lens.pinhole, _monotonic_up_to(lens) ** 2 if kind else np.inf
    numbers = np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32)
    return numbers, kind, d, max_slope2


def rectified(pixels: U1, lens: LensCamera) -> U1:
    """Undistort a colour image, ``pixels`` (h, w, 3) uint8.

    Colours are interpolated bilinearly. Pixels outside the original image are black.

    Raises
    ------
    ValueError : the distortion model is not known.
    """
    if not lens.model:
        return pixels
    from scipy import ndimage  # noqa: PLC0415  # only exports need it

    source = _sources(lens)
    channels = [
        ndimage.map_coordinates(pixels[..., k], source, np.float64, order=1) for k in range(3)
    ]
    return np.asarray(np.rint(np.stack(channels, axis=-1)), np.uint8)


@lru_cache(maxsize=2)  # a recording has one lens
def _sources(lens: LensCamera) -> F8:
    """Return the row and column (2, h, w) at which the lens shows each ray of its pinhole camera.

    They may be outside the image, and are -1 for rays that the lens does not see.
    """
    camera = lens.pinhole
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    x, y = distort(rays, lens.model, lens.coefficients).transpose(2, 0, 1)
    seen = (rays**2).sum(axis=-1) < _monotonic_up_to(lens) ** 2
    return np.where(seen, (y * camera.fy + camera.cy, x * camera.fx + camera.cx), -1)


@lru_cache(maxsize=16)
def _monotonic_up_to(lens: LensCamera) -> float:
    """Return the slope, at most `_WIDEST`, up to which the distortion increases monotonically.

    Beyond it the polynomial turns back, and would map the sides of the scene into the image.
    """
    slopes = np.linspace(0, _WIDEST, 601)[1:]
    distorted = distort(np.column_stack([slopes, 0 * slopes]), lens.model, lens.coefficients)[:, 0]
    back = np.flatnonzero(np.diff(distorted) <= 0)
    return float(slopes[back[0]]) if back.size else _WIDEST


@kernel
def _to_camera(points: F4, rotation: F4, shift: F4, transformed: F4) -> None:
    """Transform points (n, 3) to the frame of a camera, (3, n); z is -1 if they are not finite.

    ``rotation`` (3, 3) and ``shift`` (3,), metres, are the pose; writes to ``transformed``.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        finite = np.isfinite(x + y + z)
        for k in range(3):
            value = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + shift[k]
            transformed[k, i] = value if finite else np.float32(-1)


@kernel(fast=True)
def project_in_place(x: F4, y: F4, z: F4, numbers: F4, kind: int, d: F4, max_slope2: float) -> None:
    """Project points, in place, from the camera frame to the image.

    Source of the lens models: `shapecat.cameras.lenses.distort`.

    Parameters
    ----------
    x, y, z : (n,) metres, in the optical frame of the camera. They become column and row in pixels
        and inverse depth in 1/m, which is 0 where the camera does not see the point.
    numbers : (4,) fx, fy, cx, cy, pixels.
    kind : kind of distortion: 0 none, 1 polynomial, 2 fisheye.
    d : (8,) distortion coefficients.
    max_slope2 : the square of the largest slope that the lens sees; ignored without distortion.
    """
    one, two, nought = np.float32(1), np.float32(2), np.float32(0)
    for k in range(x.size):
        inverse_depth = one / max(z[k], np.float32(1e-3))
        x[k], y[k] = x[k] * inverse_depth, y[k] * inverse_depth
        z[k] = inverse_depth if z[k] > np.float32(1e-3) else nought
    if kind == 1:
        k1, k2, p1, p2, k3, k4, k5, k6 = d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7]
        for k in range(x.size):
            a, b = x[k], y[k]
            r = a * a + b * b
            radial = (one + r * (k1 + r * (k2 + r * k3))) / (one + r * (k4 + r * (k5 + r * k6)))
            x[k] = a * radial + two * p1 * a * b + p2 * (r + two * a * a)
            y[k] = b * radial + p1 * (r + two * b * b) + two * p2 * a * b
            z[k] = z[k] if r < max_slope2 else nought
    elif kind == 2:
        for k in range(x.size):
            r = x[k] * x[k] + y[k] * y[k]
            radius = max(np.sqrt(r), np.float32(1e-9))
            angle = np.arctan(radius)
            s = angle * angle
            bent = angle * (one + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3])))) / radius
            x[k], y[k] = x[k] * bent, y[k] * bent
            z[k] = z[k] if r < max_slope2 else nought
    for k in range(x.size):
        x[k], y[k] = x[k] * numbers[0] + numbers[2], y[k] * numbers[1] + numbers[3]
