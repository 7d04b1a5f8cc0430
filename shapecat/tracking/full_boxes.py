"""One full size for a track, from the full boxes of its views."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.tracking.fusion import view_weights

__all__ = ["BoxViews", "fuse_boxes"]

_STILL_M = 0.05
"""Centres stray less while an object stands still."""
_SQUARE = 0.2
"""Weight of the yaw of a square footprint; that of an elongated one is its elongation more."""
_SHARE = 0.5
"""Share of the views that have seen a smaller size than the fused one."""
_COMMON = 0.5
"""Share of a single view's error that all views have in common, as they see the same side."""


class BoxViews(NamedTuple):
    """Full boxes of k views of one object, in one frame.

    Attributes
    ----------
    centers, sizes, stds : (k, 3) metres: centres, lengths, and the deviations of the lengths.
    axes : (k, 3, 3) the columns are the axes of the boxes; the third one is up.
    """

    centers: F8
    axes: F8
    sizes: F8
    stds: F8


def fuse_boxes(views: BoxViews, partial: Bool) -> BoxViews:
    """Fuse the boxes of a track to one size, and while it stands still to one centre and yaw.

    Sizes are weighted medians, after the boxes were turned by quarters so that they agree best. A
    view whose centre is elsewhere keeps it, and its own yaw.

    Parameters
    ----------
    views : at least one.
    partial : (k,) whether the border of the image or something nearer cuts the object.
    """
    weights = view_weights(partial) / (0.01 + views.stds.sum(axis=1))
    yaws = _yaws(views.axes)
    yaw = _mean_yaw(yaws, views.sizes, weights)
    quarters = np.rint((yaws - yaw) / (np.pi / 2)).astype(np.int64)
    size = _median(_swapped(views.sizes, quarters), weights)
    std = _median(_swapped(views.stds, quarters), weights)
    std = std * np.sqrt(_COMMON + (1 - _COMMON) / len(weights))
    center = _median(views.centers, weights)
    still = np.linalg.norm(views.centers - center, axis=1) < _STILL_M
    turns = np.where(still, yaw, yaws - quarters * (np.pi / 2))
    return BoxViews(
        np.where(still[:, None], center, views.centers),
        _turned(views.axes[0], turns),
        np.tile(size, (len(weights), 1)),
        np.tile(std, (len(weights), 1)),
    )


def _yaws(axes: F8) -> F8:
    """Return the angles (k,) from the first axis of the first box to that of each."""
    x, y = axes[0, :, 0], axes[0, :, 1]
    return np.asarray(np.arctan2(axes[:, :, 0] @ y, axes[:, :, 0] @ x))


def _mean_yaw(yaws: F8, sizes: F8, weights: F8) -> float:
    """Return the mean of yaws that quarter turns do not change."""
    length, width = sizes[:, 0], sizes[:, 1]
    elongation = abs(length - width) / np.maximum(np.maximum(length, width), 1e-6)
    total = np.sum(weights * (_SQUARE + elongation) * np.exp(4j * yaws))
    return float(np.angle(total) / 4)


def _swapped(lengths: F8, quarters: I4) -> F8:
    """Return lengths (k, 3) along the axes of boxes that are turned back by quarters."""
    odd = (quarters % 2 == 1)[:, None]
    return np.asarray(np.where(odd, lengths[:, [1, 0, 2]], lengths))


def _median(values: F8, weights: F8) -> F8:
    """Return the weighted median (3,) of values (k, 3)."""
    order = np.argsort(values, axis=0, kind="stable")
    summed = np.cumsum(weights[order], axis=0)
    at = np.argmax(summed >= _SHARE * summed[-1], axis=0)
    return np.asarray(np.take_along_axis(values, np.take_along_axis(order, at[None], 0), 0)[0])


def _turned(axes: F8, yaws: F8) -> F8:
    """Return (k, 3, 3) the axes of a box, turned about its third one."""
    turns = np.zeros((len(yaws), 3, 3))
    c, s = np.cos(yaws), np.sin(yaws)
    turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1] = c, -s, s, c
    turns[:, 2, 2] = 1.0
    return np.asarray(axes @ turns)
