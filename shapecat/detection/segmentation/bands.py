"""Height bands and the lateral axis, along which segments are measured."""

import math

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import level_axes
from shapecat.jit import kernel

__all__ = ["BANDS", "BAND_M", "lateral_axis"]

BAND_M = 0.005
"""Height of a band, metres."""
BANDS = 128
"""Number of bands; higher cells count in the last one."""


@kernel
def lateral_axis(up: F8) -> F8:
    """Return the horizontal unit vector (3,) across the view, given ``up`` (3,); sensor frame.

    It is perpendicular to the optical axis, unless this axis is nearly vertical.
    """
    across = math.hypot(up[0], up[1])
    if across < 0.2:  # the camera looks straight down
        return np.array(level_axes(up[0], up[1], up[2])[0])
    return np.array([up[1] / across, -up[0] / across, 0.0])
