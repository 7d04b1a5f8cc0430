"""Depth images from a lens with distortion."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.cameras.lenses import LENS_MODELS, undistorted_rays
from shapecat.recordings.decoding.pointcloud2 import unorganized
from shapecat.recordings.pinhole import PinholeFit, distortion_of, fit_pinhole
from shapecat.recordings.recording import Recording
from shapecat.types import Camera

__all__ = ["Lens", "distortion_problem"]


class Lens:
    """The lens of unrectified depth images; recomputed when the calibration changes."""

    def __init__(self, recording: Recording, topic: str) -> None:
        """Start without a calibration."""
        self._recording = recording
        self._topic = topic
        self._key: tuple[Camera, str, tuple[float, ...]] | None = None
        self._rays: F8 | None = None
        self._fit: PinholeFit | None = None

    def content(self, info: Any, camera: Camera, depth: F4) -> dict[str, Any]:
        """Return the content of a `Frame`: depth and pinhole camera, or points if no camera fits.

        Parameters
        ----------
        info : a decoded CameraInfo, with its ``camera`` as `camera_of_info` returns it.
        depth : (h, w) metres.
        """
        model = str(info.distortion_model)
        coefficients = distortion_of(info)
        self._calibrate((camera, model, coefficients), depth)
        if self._rays is None:
            problem = distortion_problem(model, coefficients)
            problem = problem or f"lens distortion {model!r} that cannot be inverted"
            self._warn(f"{problem} is ignored")
            return {"depth": depth, "camera": camera}
        if self._fit is not None:
            return {"depth": depth, "camera": self._fit.camera}
        self._warn("not rectified: converted to points along the undistorted rays")
        return unorganized(_points_along(self._rays, depth))

    def _calibrate(self, key: tuple[Camera, str, tuple[float, ...]], depth: F4) -> None:
        if key == self._key:
            return
        self._key, self._fit = key, None
        self._rays = undistorted_rays(*key)
        if self._rays is not None:
            blind = float(np.isnan(self._rays[..., 0]).mean())
            if blind > 0:
                self._warn(
                    f"{blind:.0%} of its pixels, which the lens model leaves out, are ignored"
                )
            self._fit = fit_pinhole(_points_along(self._rays, np.ones(depth.shape, np.float32)))

    def _warn(self, text: str) -> None:
        self._recording.warn(f"{self._topic}: {text}")


def distortion_problem(model: str, coefficients: Sequence[float]) -> str:
    """Return what is wrong with the distortion in a CameraInfo; empty if it is usable."""
    if model not in LENS_MODELS:
        return f"unknown lens distortion {model!r}"
    return "" if np.isfinite(coefficients).all() else "lens distortion that is not finite"


def _points_along(rays: F8, depth: F4) -> F4:
    """Return the points (h, w, 3) at ``depth`` along the rays; NaN where depth is missing."""
    z = np.where(depth > 0, depth, np.float32(np.nan))
    return np.stack([rays[..., 0] * z, rays[..., 1] * z, z], axis=-1).astype(np.float32)
