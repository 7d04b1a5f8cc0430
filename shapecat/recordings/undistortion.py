"""What a pixel of a lens with distortion sees."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.types import Camera

__all__ = ["points_along", "undistorted_rays"]

_ROUNDS = 20
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "fisheye")


def undistorted_rays(camera: Camera, model: str, coefficients: Sequence[float]) -> F8 | None:
    """Return (h, w, 2) the slopes x / z and y / z that each pixel sees.

    Source: the lens models of OpenCV's calibration (Brown 1966; Kannala & Brandt 2006), inverted
    by fixed-point iteration as in OpenCV's undistortPoints.

    Returns
    -------
    None for a model that is not known, or where the iteration does not settle.
    """
    if model not in _MODELS or not np.isfinite(coefficients).all():
        return None
    d = np.zeros(8)
    d[: min(8, len(coefficients))] = coefficients[:8]
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    seen = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    distort = _fisheye if model in {"equidistant", "fisheye"} else _polynomial
    rays = seen.copy()
    with np.errstate(all="ignore"):  # a hostile lens diverges: found below
        for _ in range(_ROUNDS):
            rays += seen - distort(rays, d)
        error = np.abs(distort(rays, d) - seen) * (camera.fx, camera.fy)
    return rays if np.isfinite(rays).all() and error.max() < 0.1 else None


def _polynomial(rays: F8, d: F8) -> F8:
    """Brown's radial and tangential distortion; k4 to k6 are the rational part."""
    k1, k2, p1, p2, k3, k4, k5, k6 = d
    x, y = rays[..., 0], rays[..., 1]
    r = x * x + y * y
    radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
            y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _fisheye(rays: F8, d: F8) -> F8:
    """Kannala and Brandt's equidistant model."""
    radius = np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-12)
    angle = np.arctan(radius)
    s = angle * angle
    bent = angle * (1 + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3]))))
    return np.asarray(rays * (bent / radius)[..., None])


def points_along(rays: F8, depth: F4) -> F4:
    """Return (h, w, 3) points at ``depth`` along the rays; NaN where there is no reading."""
    z = np.where(depth > 0, depth, np.float32(np.nan))
    return np.stack([rays[..., 0] * z, rays[..., 1] * z, z], axis=-1).astype(np.float32)
