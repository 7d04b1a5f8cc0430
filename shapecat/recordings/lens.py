"""Convert depth images with lens distortion to those of a pinhole camera, or to points."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.cameras.lenses import LENS_MODELS, undistorted_rays
from shapecat.recordings.decoding.pointcloud2 import unorganized
from shapecat.recordings.pinhole import PinholeFit, distortion_of, fit_pinhole
from shapecat.types import Camera

__all__ = ["distortion_problem", "lens_content"]


def lens_content(
    info: Any, camera: Camera, depth: F4, warn: Callable[[str], None]
) -> dict[str, Any]:
    """Return the content of a `Frame`: depth and pinhole camera, or points if no camera fits.

    A distortion that is unknown or cannot be inverted is ignored, with a warning.

    Parameters
    ----------
    info : a decoded CameraInfo.
    camera : the camera that `camera_of_info` returns for ``info``.
    depth : (h, w) metres.
    warn : receives warnings for the user.
    """
    model = str(info.distortion_model)
    coefficients = distortion_of(info)
    lens = _lens_of(camera, model, coefficients)
    if lens is None:
        problem = distortion_problem(model, coefficients)
        problem = problem or f"lens distortion {model!r} that cannot be inverted"
        warn(f"{problem} is ignored")
        return {"depth": depth, "camera": camera}
    if lens.blind > 0:
        warn(f"{lens.blind:.0%} of its pixels have no ray in the lens model and are ignored")
    if lens.fit is not None:
        return {"depth": depth, "camera": lens.fit.camera}
    warn("not rectified: converted to points along the undistorted rays")
    return unorganized(_points_along(lens.rays, depth))


class _Lens(NamedTuple):
    """The geometry of a lens.

    Attributes
    ----------
    rays : (h, w, 2) x / z and y / z of each pixel's ray; NaN where the lens model has none.
    blind : fraction of pixels without a ray.
    fit : a pinhole camera with nearly the same rays; None if there is none.
    """

    rays: F8
    blind: float
    fit: PinholeFit | None


@lru_cache(maxsize=4)  # the calibration of a camera hardly ever changes
def _lens_of(camera: Camera, model: str, coefficients: tuple[float, ...]) -> _Lens | None:
    """Compute the geometry of a lens; return None if its distortion cannot be inverted."""
    rays = undistorted_rays(camera, model, coefficients)
    if rays is None:
        return None
    fit = fit_pinhole(_points_along(rays, np.ones(rays.shape[:2], np.float32)))
    return _Lens(rays, float(np.isnan(rays[..., 0]).mean()), fit)


def distortion_problem(model: str, coefficients: Sequence[float]) -> str:
    """Describe the problem with the distortion in a CameraInfo; empty if it is usable."""
    if model not in LENS_MODELS:
        return f"unknown lens distortion {model!r}"
    return "" if np.isfinite(coefficients).all() else "lens distortion that is not finite"


def _points_along(rays: F8, depth: F4) -> F4:
    """Return the points (h, w, 3), metres, on the ``rays`` of a `_Lens`; NaN without depth.

    ``depth`` (h, w), metres, is measured along z.
    """
    z = np.where(depth > 0, depth, np.float32(np.nan))
    return np.stack([rays[..., 0] * z, rays[..., 1] * z, z], axis=-1).astype(np.float32)
