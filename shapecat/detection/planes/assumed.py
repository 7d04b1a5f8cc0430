"""Assumed plane: a support that is not seen, below what no plane that is seen explains.

In a bin, a compartment, or close up, objects hide what they lie on. Where much of the image
stands above no plane, a level plane is assumed below it, so that it is segmented all the same.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, Bool
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import ANGLES, MARGIN_M, SupportingPlane
from shapecat.detection.planes.ransac import horizontal_plane
from shapecat.detection.planes.up_direction import HALF_M
from shapecat.geometry import level_axes
from shapecat.jit import kernel

__all__ = ["UNEXPLAINED", "assume_plane", "unexplained"]

UNEXPLAINED = 0.2
"""Share of the samples above no plane from which one is assumed; 0.06 at most on plain tables."""
BIN_M = 0.01
FEW = 0.01
"""Share of the unexplained samples that may lie below the plane: noise."""


def unexplained(grid: DepthGrid, plane_id: I4, walls: U1) -> Bool | None:
    """Return the samples (rows, columns) above no plane and on no wall; None if they are few."""
    rest, everything = _count(grid.inverse_depth, plane_id, walls)
    if rest <= UNEXPLAINED * everything:
        return None
    return np.asarray((plane_id == 0) & (walls == 0) & (grid.inverse_depth > 0))


@kernel
def _count(inv_depth: F4, plane_id: I4, walls: U1) -> tuple[int, int]:
    """Return how many samples are above no plane and on no wall, and how many there are."""
    rest = everything = 0
    for i in range(inv_depth.shape[0]):
        values, planes, on_wall = inv_depth[i], plane_id[i], walls[i]
        some, all_ = np.int32(0), np.int32(0)
        for j in range(values.size):  # no more than 32 bits, and this vectorises
            seen = values[j] > 0
            some += np.int32(seen & (planes[j] == 0) & (on_wall[j] == 0))
            all_ += np.int32(seen)
        rest, everything = rest + int(some), everything + int(all_)
    return rest, everything


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
    across, along, _ = np.array(level_axes(*up)) @ points
    height = up @ points
    offset = _fullest(height, 1 / (1 + (z / HALF_M) ** 2), tallest_m)
    if offset >= 0:  # its upper side is not seen
        return None
    held = (height > offset) & (height < offset + tallest_m)
    sides = np.cos(ANGLES)[:, None] * across[held] + np.sin(ANGLES)[:, None] * along[held]
    a, b, c = horizontal_plane(k, up, offset)
    return SupportingPlane(a, b, c, up, offset, sides.max(axis=1) + MARGIN_M, 0.0)


def _fullest(height: F8, weight: F8, tallest_m: float) -> float:
    """Return the height above which, up to ``tallest_m``, most weight lies, just below it."""
    low = float(height.min())
    count = np.bincount(((height - low) / BIN_M).astype(np.int64), weight)
    window = round(tallest_m / BIN_M)
    total = np.cumsum(np.concatenate([[0.0], count, np.zeros(window)]))
    inside = total[window:] - total[:-window]
    start = int(np.argmax(inside))
    above = np.cumsum(count[start:])
    start += int(np.argmax(above > FEW * inside[start]))
    return low + start * BIN_M - MARGIN_M
