"""Supporting planes: up, RANSAC, parallel levels, what bears objects, heights above it."""

import numpy as np

from shapecat.arrays import F8
from shapecat.detection.depth_grid import Cells
from shapecat.detection.planes.extent import Support
from shapecat.detection.planes.height_map import table_of
from shapecat.detection.planes.parallel import find_levels
from shapecat.detection.planes.supporting import boards_of
from shapecat.detection.planes.up_direction import estimate_up
from shapecat.jit import kernel

__all__ = ["NO_HINT", "find_supporting_planes"]

NO_HINT = np.zeros(3)
"""Takes the place of a direction away from gravity that is not known."""


@kernel
def find_supporting_planes(cells: Cells, hint: F8, draws: F8) -> tuple[list[Support], F8, F8]:
    """Find the horizontal planes that objects may stand on (thesis 4.3).

    Multi-plane RANSAC (Fischler and Bolles 1981): one plane for each accumulation of level
    surface in height, then all of them with one normal.

    Parameters
    ----------
    hint : (3,) unit vector away from gravity, or `NO_HINT`.
    draws : from `draws_of`.

    Returns
    -------
    The planes, lowest first; the normal (3,) of the largest; and the rows of `table_of`.
    """
    up = estimate_up(cells, hint, draws)
    supports = boards_of(cells, find_levels(cells, up, draws))
    largest = 0.0
    for support in supports:
        if support.area_m2 > largest:
            up, largest = support.up, support.area_m2
    return supports, up, table_of(supports, cells.lens)
