"""What a pixel of a lens with distortion sees."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.recordings.pinhole import PinholeFit, fit_pinhole
from shapecat.recordings.pointcloud2 import unorganized
from shapecat.recordings.recording import Recording
from shapecat.types import Camera

__all__ = ["Lens", "undistorted_rays"]

_ROUNDS = 20
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "fisheye")


class Lens:
    """The lens of images that were not rectified; computed anew when the calibration changes."""

    def __init__(self, recording: Recording, topic: str) -> None:
        """Begin without a calibration."""
        self._recording = recording
        self._topic = topic
        self._key: tuple[Camera, str, tuple[float, ...]] | None = None
        self._rays: F8 | None = None
        self._fit: PinholeFit | None = None

    def content(self, info: Any, camera: Camera, depth: F4) -> dict[str, Any]:
        """Give depth with the pinhole nearest to the lens, or points where none is near."""
        model = str(info.distortion_model)
        coefficients = tuple(float(c) for c in (info.d if hasattr(info, "d") else info.D))
        self._calibrate((camera, model, coefficients), depth)
        if self._rays is None:
            self._warn(f"lens distortion {model!r} is not known and left as it is")
            return {"depth": depth, "camera": camera}
        if self._fit is not None:
            return {"depth": depth, "camera": self._fit.camera}
        self._warn("not rectified: read as points along the undistorted rays")
        return unorganized(_points_along(self._rays, depth))

    def _calibrate(self, key: tuple[Camera, str, tuple[float, ...]], depth: F4) -> None:
        if key == self._key:
            return
        self._key, self._fit = key, None
        self._rays = undistorted_rays(*key)
        if self._rays is not None:
            self._fit = fit_pinhole(_points_along(self._rays, np.ones(depth.shape, np.float32)))

    def _warn(self, text: str) -> None:
        self._recording.warn(f"{self._topic}: {text}")


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


def _points_along(rays: F8, depth: F4) -> F4:
    """Return (h, w, 3) points at ``depth`` along the rays; NaN where there is no reading."""
    z = np.where(depth > 0, depth, np.float32(np.nan))
    return np.stack([rays[..., 0] * z, rays[..., 1] * z, z], axis=-1).astype(np.float32)
