"""Decide whether two depth images from the same pose show the same scene."""

import numpy as np

from shapecat.arrays import F4, Bool
from shapecat.geometry import AGREE, compose, inverse
from shapecat.jit import kernel
from shapecat.types import Frame, Pose

__all__ = ["shows_the_same"]

_MOVED_M = 0.003
"""Largest distance between two poses that count as equal, metres: noise moves them this far."""
_TURNED_DEG = 0.15
"""Largest angle between two poses that count as equal, degrees."""
_STRIDE = 2
"""Step between the pixels that are compared."""
_SQUARE = 3
"""Side of a square of compared pixels that shows a change if all of them differ. It covers 6 by 6
pixels, fewer than the smallest object has. Noise at outlines makes only thin lines."""


def shows_the_same(
    frame: Frame, pose: Pose | None, key_frame: Frame, key_pose: Pose | None, *, range_m: float
) -> bool:
    """Return whether the sensor, its pose and the scene within range are the same in two frames.

    Parameters
    ----------
    frame, key_frame : the frames to compare.
    pose, key_pose : ``fixed_from_sensor`` of each; None where there is no fixed frame. If both are
        None, they count as equal.
    range_m : metres; depths farther away in both frames are not compared.

    Notes
    -----
    Point clouds are never the same: their points do not correspond one to one.
    """
    if frame.depth is None or key_frame.depth is None or frame.camera != key_frame.camera:
        return False
    if frame.frame_id != key_frame.frame_id or not _at_rest(pose, key_pose):
        return False
    return not _changed(frame.depth, key_frame.depth, np.float32(range_m))


def _at_rest(pose: Pose | None, other: Pose | None) -> bool:
    if pose is None or other is None:
        return pose is other
    moved = compose(inverse(other), pose)
    turned = np.arccos(np.clip((np.trace(moved.rotation) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(moved.translation) <= _MOVED_M and turned <= np.radians(_TURNED_DEG))


@kernel
def _changed(depth: F4, key_depth: F4, range_m: float) -> bool:
    """Return whether all pixels differ in some square of `_SQUARE` by `_SQUARE` compared pixels.

    Every `_STRIDE`-th pixel of every `_STRIDE`-th row is compared. A depth that a neighbouring
    pixel of the other image has does not differ, and neither do depths that are both beyond
    ``range_m``, metres. ``depth`` and ``key_depth`` are (h, w), metres, 0 where missing.
    """
    height, width = depth.shape
    rows = np.zeros(width, np.int64)  # consecutive rows with a long enough run that ends here
    differs = np.zeros(width, np.bool_)
    for v in range(0, height, _STRIDE):
        _mark(depth[v], key_depth[v], range_m, differs)
        run = 0
        for u in range(0, width, _STRIDE):
            run = run + 1 if differs[u] and _is_unmatched(depth, key_depth, v, u) else 0
            rows[u] = rows[u] + 1 if run >= _SQUARE else 0
            if rows[u] == _SQUARE:
                return True
    return False


@kernel(inline=True)
def _mark(depth: F4, key_depth: F4, range_m: float, differs: Bool) -> None:
    """Mark the depths of a row that differ, unless both are out of range.

    All arrays are (w,); the marks go to ``differs``. The other parameters are as in `_changed`.
    """
    for u in range(len(depth)):
        a, b = depth[u], key_depth[u]
        in_range = (a <= range_m) | (b <= range_m)
        differs[u] = in_range & (abs(a - b) > np.float32(AGREE) * a * b)


@kernel(inline=True)
def _is_unmatched(depth: F4, key_depth: F4, row: int, column: int) -> bool:
    """Return whether neither image has the depth of the other at a pixel or beside it.

    If both depths are missing, the result is False. The images are as in `_changed`.
    """
    a, b = depth[row, column], key_depth[row, column]
    return a != b and not (
        (a > 0 and _finds(key_depth, row, column, a)) or (b > 0 and _finds(depth, row, column, b))
    )


@kernel(inner=True)
def _finds(depth: F4, row: int, column: int, z: float) -> bool:
    """Return whether the depth ``z`` occurs at a pixel or beside it.

    ``depth`` is (h, w), metres.
    """
    height, width = depth.shape
    for v in range(max(row - 1, 0), min(row + 2, height)):
        for u in range(max(column - 1, 0), min(column + 2, width)):
            if abs(depth[v, u] - z) <= AGREE * depth[v, u] * z:
                return True
    return False
