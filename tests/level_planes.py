"""A level plane on a downsampled grid, for a camera that looks down at 45 degrees."""

import numpy as np

from shapecat.arrays import F4
from shapecat.detection.depth_grid import PinholeIntrinsics

__all__ = ["INTRINSICS", "RAY_HEIGHTS", "UP", "I", "J", "level"]

INTRINSICS = PinholeIntrinsics(262.5, 262.5, 159.5, 119.5)
UP = np.array([0.0, -np.sqrt(0.5), -np.sqrt(0.5)])
I, J = np.mgrid[:240, :320]
"""Row and column of each pixel."""
RAY_HEIGHTS = ((J - 159.5) * UP[0] + (I - 119.5) * UP[1]) / 262.5 + UP[2]
"""Height (240, 320) of each ray above the camera at a depth of one metre."""


def level(below_m: float = 0.7) -> F4:
    """Return the inverse depth (240, 320) of a level plane, ``below_m`` lower than the camera."""
    return np.asarray(RAY_HEIGHTS / -below_m, np.float32)
