"""Supporting planes: the up direction, the planes that objects stand on, and heights above them."""

import numpy as np

from shapecat.arrays import F8
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.extent import SupportingPlane
from shapecat.detection.planes.horizontal import find_horizontal_planes
from shapecat.detection.planes.oriented_points import orient_points
from shapecat.detection.planes.settings import UP
from shapecat.detection.planes.strips import add_strip_planes, may_have_strips
from shapecat.detection.planes.supporting import supporting_planes
from shapecat.detection.planes.up_direction import estimate_up

__all__ = ["find_supporting_planes"]


def find_supporting_planes(
    grid: DepthGrid, hint: F8 | None, trials: F8, *, max_height_m: float, upright: bool
) -> tuple[list[SupportingPlane], F8]:
    """Find the horizontal planes that objects may stand on (thesis 4.3).

    One plane is fitted at each peak in a height histogram of the samples whose normal is nearly up,
    by least squares or, if few inliers are close to it, by RANSAC (Fischler and Bolles 1981). Then
    all planes get a common normal, and planes of which only strips are visible are added.

    Parameters
    ----------
    hint : (3,) unit vector away from gravity, sensor frame; None if unknown.
    trials : (n, 3) random numbers from `draw_trials`.
    max_height_m : height of the tallest object, metres.
    upright : whether to prefer an up direction near that of the image, since cameras are rarely
        held on their side; False for a virtual camera.

    Returns
    -------
    The planes, lowest first, and the up direction (3,), their normal. Without a plane, up is the
    estimate of `estimate_up`, which may be zeros.
    """
    points = orient_points(grid)
    prior = np.zeros(3) if hint is None else hint
    up = estimate_up(points, grid.intrinsics, prior, trials, UP.roll_penalty if upright else 0.0)
    candidates = find_horizontal_planes(grid, points, up, trials)
    if not candidates:
        return [], up
    if may_have_strips(grid, points, candidates):
        candidates = add_strip_planes(grid, candidates)
    supports = supporting_planes(grid, candidates, max_height_m)
    largest = max(supports, key=lambda plane: plane.area_m2, default=None)
    return supports, up if largest is None else largest.up
