"""Supporting planes: up, RANSAC, parallel levels, what bears objects, heights above it."""

import numpy as np

from shapecat.arrays import F8
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.covered import add_covered_planes
from shapecat.detection.planes.extent import SupportingPlane
from shapecat.detection.planes.parallel import find_parallel_planes
from shapecat.detection.planes.ransac import DepthSamples
from shapecat.detection.planes.supporting import SURE_AREA_M2, supporting_planes
from shapecat.detection.planes.up_direction import HELD, estimate_up

__all__ = ["NO_HINT", "find_supporting_planes"]

NO_HINT = np.zeros(3)
"""Takes the place of a direction away from gravity that is not known."""
BORNE_M = 0.4
"""What is higher above a large plane than this does not stand on it."""


def find_supporting_planes(
    grid: DepthGrid, hint: F8, trials: F8, *, tallest_m: float, upright: bool
) -> tuple[list[SupportingPlane], F8]:
    """Find the horizontal planes that objects may stand on (thesis 4.3).

    Multi-plane RANSAC (Fischler and Bolles 1981): one plane for each accumulation of level
    surface in height, then all of them with one normal, then those that things hide but for
    strips.

    Parameters
    ----------
    hint : (3,) unit vector away from gravity, or `NO_HINT`.
    trials : from `draw_trials`.
    tallest_m : height of the tallest object.
    upright : whether the grid is the image of a camera, which is rarely held on its side.

    Returns
    -------
    The planes, lowest first, and the normal (3,) of the largest.
    """
    up = estimate_up(grid, hint, trials, HELD if upright else 0.0)
    found = find_parallel_planes(grid, up, trials)
    covered_m2 = np.zeros(len(found))
    if _may_cover(found):
        found, covered_m2 = add_covered_planes(grid, found)
    supports = supporting_planes(grid, found, covered_m2, tallest_m)
    largest = max(supports, key=lambda support: support.area_m2, default=None)
    up = up if largest is None else largest.up
    return supports, up


def _may_cover(found: list[tuple[SupportingPlane, DepthSamples]]) -> bool:
    """Whether a plane may be the top of what covers another: no large one bears it or is above."""
    large = [plane.offset for plane, _ in found if plane.area_m2 > SURE_AREA_M2]
    highest = max(large, default=-np.inf)
    return any(plane.offset > highest + BORNE_M for plane, _ in found)
