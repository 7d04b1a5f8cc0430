"""Supporting planes: up, RANSAC, parallel levels, what bears objects, heights above it."""

import numpy as np

from shapecat.arrays import F8
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import SupportingPlane
from shapecat.detection.planes.height_map import pack_planes
from shapecat.detection.planes.parallel import find_parallel_planes
from shapecat.detection.planes.supporting import supporting_planes
from shapecat.detection.planes.up_direction import estimate_up
from shapecat.jit import kernel

__all__ = ["NO_HINT", "find_supporting_planes"]

NO_HINT = np.zeros(3)
"""Takes the place of a direction away from gravity that is not known."""


@kernel
def find_supporting_planes(
    grid: DepthGrid, hint: F8, trials: F8
) -> tuple[list[SupportingPlane], F8, F8]:
    """Find the horizontal planes that objects may stand on (thesis 4.3).

    Multi-plane RANSAC (Fischler and Bolles 1981): one plane for each accumulation of level
    surface in height, then all of them with one normal.

    Parameters
    ----------
    hint : (3,) unit vector away from gravity, or `NO_HINT`.
    trials : from `draw_trials`.

    Returns
    -------
    The planes, lowest first; the normal (3,) of the largest; and the rows of `pack_planes`.
    """
    up = estimate_up(grid, hint, trials)
    supports = supporting_planes(grid, find_parallel_planes(grid, up, trials))
    largest = 0.0
    for support in supports:
        if support.area_m2 > largest:
            up, largest = support.up, support.area_m2
    return supports, up, pack_planes(supports, grid.intrinsics)
