"""Assumed plane: a hidden support, below the samples that no visible plane explains.

In a bin, in a compartment, or close up, objects hide the surface they lie on. If many samples are
above no plane, a level plane is assumed below them, so that they are segmented anyway.
"""

import numpy as np

from shapecat.arrays import F8, I4, U1, Bool
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import COS, SIN, SupportingPlane, level_coordinates
from shapecat.detection.planes.plane_fit import horizontal_plane
from shapecat.detection.planes.settings import ASSUMED, PLANES, UP

__all__ = ["assume_plane", "find_unexplained"]

SAMPLE_STRIDE = 4
"""One in this many unexplained samples is used to determine the height and extent of the plane."""


def find_unexplained(grid: DepthGrid, explained: I4 | U1) -> Bool | None:
    """Return a mask (rows, columns) of the near samples where ``explained`` is 0; None if too few.

    Near means within `AssumedSettings.max_depth_m`. ``explained`` (rows, columns) is 0 except on or
    above a plane, and on walls.
    """
    in_range = grid.inverse_depth > np.float32(1 / ASSUMED.max_depth_m)
    unexplained: Bool = (explained == 0) & in_range
    too_few = np.count_nonzero(unexplained) <= ASSUMED.unexplained * np.count_nonzero(in_range)
    return None if too_few else unexplained


def assume_plane(
    grid: DepthGrid, unexplained: Bool, up: F8, max_height_m: float
) -> SupportingPlane | None:
    """Return the level plane below most unexplained samples; None if it is above the camera.

    Of all level planes, it has the most samples up to ``max_height_m`` above it; near samples have
    more weight. Its visible area is 0.

    Parameters
    ----------
    unexplained : (rows, columns) from `find_unexplained`.
    up : (3,) unit normal of the plane, sensor frame.
    max_height_m : height of the tallest object, metres.
    """
    subset = np.zeros(unexplained.shape, np.bool_)
    subset.flat[np.flatnonzero(unexplained)[::SAMPLE_STRIDE]] = True
    across, along, height = level_coordinates(grid, subset, up)
    z = 1 / grid.inverse_depth[subset].astype(np.float64)
    offset = _fullest_interval(height, 1 / (1 + (z / UP.half_weight_m) ** 2), max_height_m)
    if offset >= 0:  # its upper side is not visible
        return None
    inside = (height > offset) & (height < offset + max_height_m)
    sides = COS[:, None] * across[inside] + SIN[:, None] * along[inside]
    a, b, c = horizontal_plane(grid.intrinsics, up, offset)
    extent = sides.max(axis=1, initial=-np.inf) + PLANES.margin_m
    return SupportingPlane(a, b, c, up, offset, extent, 0.0)


def _fullest_interval(height: F8, weight: F8, max_height_m: float) -> float:
    """Return a height just below the samples in the heaviest interval of length ``max_height_m``.

    At most `AssumedSettings.noise_share` of their weight is lower. ``height`` (n,), metres, and
    ``weight`` (n,) are those of the samples.
    """
    low = float(height.min())
    count = np.bincount(((height - low) / PLANES.bin_m).astype(np.int64), weight)
    window = max(round(max_height_m / PLANES.bin_m), 1)
    total = np.cumsum(np.concatenate([[0.0], count, np.zeros(window)]))
    inside = total[window:] - total[:-window]
    start = int(np.argmax(inside))
    above = np.cumsum(count[start:])
    start += int(np.argmax(above > ASSUMED.noise_share * inside[start]))
    return low + start * PLANES.bin_m - PLANES.margin_m
