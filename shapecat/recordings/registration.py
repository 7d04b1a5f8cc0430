"""Compare the intrinsics of a colour camera and a depth camera.

Images of cameras with similar intrinsics and the same frame are registered pixel by pixel.
"""

from functools import lru_cache

import numpy as np

from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import distort
from shapecat.types import Camera

__all__ = ["are_equal", "are_similar", "is_nearly_aligned"]

_NEAR = 0.01
"""Intrinsics that differ by less than this fraction of the image width are similar."""
_EQUAL = 1e-6
"""Intrinsics that differ by less than this fraction of the image width are equal."""
_ALIGNED_PX = 2.0
"""With a nearly aligned lens, the ray of each pixel projects to less than this from the pixel."""
_STEPS = 9
"""Rows and columns of the grid of pixels at which lens distortion is computed."""


def are_similar(lens: LensCamera, camera: Camera | None) -> bool:
    """Return whether the intrinsics of two cameras are similar; False if ``camera`` is None."""
    return _are_within(lens, camera, _NEAR)


def are_equal(lens: LensCamera, camera: Camera | None) -> bool:
    """Return whether the intrinsics of two cameras are equal; False if ``camera`` is None."""
    return _are_within(lens, camera, _EQUAL)


def is_nearly_aligned(lens: LensCamera, camera: Camera | None) -> bool:
    """Return whether the ray of each pixel of a camera projects near that pixel through a lens.

    Near is less than 2 pixels. The result is True without a camera or without distortion.
    """
    return _largest_offset_px(lens, camera) < _ALIGNED_PX


def _are_within(lens: LensCamera, camera: Camera | None, fraction: float) -> bool:
    """Return whether the intrinsics differ by less than ``fraction`` of the image width.

    The result is False without a camera.
    """
    if camera is None:
        return False
    intrinsics, camera_intrinsics = ((c.fx, c.fy, c.cx, c.cy) for c in (lens.pinhole, camera))
    largest = np.abs(np.subtract(intrinsics, camera_intrinsics)).max()
    return bool(largest < fraction * camera.width)


@lru_cache(maxsize=8)
def _largest_offset_px(lens: LensCamera, camera: Camera | None) -> float:
    """Return the largest offset from a pixel of a camera to its ray's projection through a lens.

    It is in pixels, along x or y; 0 without a camera or without distortion.
    """
    if camera is None or not lens.model:
        return 0.0
    pinhole = lens.pinhole
    steps = np.linspace(0, 1, _STEPS)
    pixels = np.stack(np.meshgrid(steps * (camera.width - 1), steps * (camera.height - 1)), -1)
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    distorted = distort(rays, lens.model, lens.coefficients) * (pinhole.fx, pinhole.fy) + (
        pinhole.cx,
        pinhole.cy,
    )
    return float(np.abs(distorted - pixels).max())
