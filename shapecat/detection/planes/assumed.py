"""Assumed plane: a support that is not seen, below what no plane that is seen explains.

In a bin, a compartment, or close up, objects hide what they lie on. Where much of the image
stands above no plane, a level plane is assumed below it, so that it is segmented all the same.
"""

import numpy as np

from shapecat.arrays import F8, I4, U1, Bool
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import COS, SIN, SupportingPlane
from shapecat.detection.planes.ransac import horizontal_plane
from shapecat.detection.planes.settings import PLANES, UP
from shapecat.geometry import gravity_rotation

__all__ = ["assume_plane", "unexplained"]

UNEXPLAINED = 0.2
"""Share of the samples above no plane from which one is assumed; 0.06 at most on plain tables."""
FEW = 0.01
"""Share of the unexplained samples that may lie below the plane: noise."""


def unexplained(grid: DepthGrid, plane_id: I4, walls: U1) -> Bool | None:
    """Return the samples (rows, columns) above no plane and on no wall; None if they are few."""
    seen = grid.inverse_depth > 0
    rest: Bool = ((plane_id.view(np.uint8) | walls) == 0) & seen
    few = np.count_nonzero(rest) <= UNEXPLAINED * np.count_nonzero(seen)
    return None if few else rest


def assume_plane(grid: DepthGrid, rest: Bool, up: F8, tallest_m: float) -> SupportingPlane | None:
    """Return the level plane below most of some samples, of area 0; None above the camera.

    Parameters
    ----------
    rest : from `unexplained`.
    up : (3,) unit normal of the plane.
    tallest_m : height of the tallest object: the plane is the one with most surface within this
        height above it, what is near counting more than what is far.
    """
    i, j = np.nonzero(rest)
    z = 1 / grid.inverse_depth[i, j].astype(np.float64)
    k = grid.intrinsics
    points = np.stack([(j - k.cx) / k.fx * z, (i - k.cy) / k.fy * z, z])
    across, along, height = gravity_rotation(up) @ points
    offset = _fullest(height, 1 / (1 + (z / UP.half_m) ** 2), tallest_m)
    if offset >= 0:  # its upper side is not seen
        return None
    held = (height > offset) & (height < offset + tallest_m)
    sides = COS[:, None] * across[held] + SIN[:, None] * along[held]
    a, b, c = horizontal_plane(k, up, offset)
    return SupportingPlane(a, b, c, up, offset, sides.max(axis=1) + PLANES.margin_m, 0.0)


def _fullest(height: F8, weight: F8, tallest_m: float) -> float:
    """Return the height above which, up to ``tallest_m``, most weight lies, just below it."""
    low = float(height.min())
    count = np.bincount(((height - low) / PLANES.bin_m).astype(np.int64), weight)
    window = round(tallest_m / PLANES.bin_m)
    total = np.cumsum(np.concatenate([[0.0], count, np.zeros(window)]))
    inside = total[window:] - total[:-window]
    start = int(np.argmax(inside))
    above = np.cumsum(count[start:])
    start += int(np.argmax(above > FEW * inside[start]))
    return low + start * PLANES.bin_m - PLANES.margin_m
