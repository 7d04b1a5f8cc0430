"""The full box of an object, fused from its outlines in several views."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, Bool
from shapecat.completion.outline import COSINES, DIRECTIONS, SINES
from shapecat.completion.whole import faced, footprint

__all__ = ["BoxViews", "FusedBox", "fuse_boxes"]

_STILL_M = 0.05
"""While the centre moves less than this, metres, the object stands still."""
_TURNED_DEG = 20.0
"""Smallest turn of an object that counts, degrees."""
_ROUND = 0.2
"""Elongation below which neither side counts as the longer one."""
_STEADY = 0.7
"""Minimum length of the mean of unit vectors that agree."""
_NEIGHBOURS = 2
"""Number of views before a view, and after it, that must show the same yaw."""
_TRIED = 16
"""Maximum number of views whose yaw is tried."""
_NARROWEST = 0.5
"""Minimum width of the overlaid outline, as a fraction of the width in the narrowest view."""
_UNSEEN = 0.05
"""Weight of an outline in directions that do not face the sensor; in those that do it is 1."""
_SQUARE = 0.2
"""Weight of the yaw of a square footprint. The weight of any footprint is this plus its
elongation."""
_COMMON = 0.5
"""Fraction of a view's variance that all views have in common, as they see the same side."""


class BoxViews(NamedTuple):
    """The full boxes of one object in k views, in a common frame.

    Attributes
    ----------
    centers : (k, 3) metres.
    axes : (k, 3, 3) the columns are the axes of the boxes; the third one is up.
    sizes, stds : (k, 3) metres, the lengths along the axes and their standard deviations.
    outlines : (k, 96) metres, the visible outlines about the centres, as in
        `shapecat.types.FullBox`.
    sensors : (k, 3) metres, the position of the sensor in each view.
    """

    centers: F8
    axes: F8
    sizes: F8
    stds: F8
    outlines: F8
    sensors: F8


class FusedBox(NamedTuple):
    """The box of an object, fused from the views in which it stands in one place.

    Attributes
    ----------
    place : (3,) metres, the box centre of the most central view.
    center, axes, size, std : (3,), (3, 3), (3,), (3,) the fused box, as in `BoxViews`.
    round : whether the footprint is nearly a circle, so that its yaw means nothing.
    """

    place: F8
    center: F8
    axes: F8
    size: F8
    std: F8
    round: bool

    def in_views(self, centers: F8, axes: F8, sizes: F8) -> tuple[F8, F8]:
        """Return centre (k, 3) and axes (k, 3, 3) of the box in each view of the object.

        A view that shows the object elsewhere, or turned, keeps its own centre, and its yaw modulo
        90 degrees. The parameters are the boxes of the views, as in `BoxViews`.
        """
        still = _near(centers, self.place)
        if not self.round:
            elongation = float(_elongation(self.size[None])[0])
            still &= ~_turned_from(self.axes, elongation, axes, sizes)
        return (
            np.where(still[:, None], self.center, centers),
            np.where(still[:, None, None], self.axes, _alike(axes, sizes, self.size)),
        )


def fuse_boxes(views: BoxViews, weights: F8, posterior: F8, categories: Sequence[str]) -> FusedBox:
    """Estimate the size of an object, and its centre and yaw while it stands still.

    The outlines of the views that show it in the same place are overlaid, and the footprint is
    estimated from their median.

    Parameters
    ----------
    views : at least one.
    weights : (k,) the weight of each view.
    posterior : (c,) probabilities of the track, in the order of ``categories``.
    """
    first = _resting(views.centers, weights)
    still = np.flatnonzero(_near(views.centers, views.centers[first]))
    still = still[_not_turned(views.axes[still], views.sizes[still], weights[still])]
    selected, selected_weights = BoxViews(*(values[still] for values in views)), weights[still]
    base, origin = _mean_axes(selected.axes, selected.sizes, selected_weights), views.centers[first]
    outline, facing = _overlaid(selected, selected_weights, origin, base)
    plan = footprint(outline, facing, posterior, categories)
    positions = (selected.centers - origin) @ base
    height = float(_median(selected.sizes[:, 2:], selected_weights)[0])
    bottom = float(_median(positions[:, 2:] - selected.sizes[:, 2:] / 2, selected_weights)[0])
    size = np.array([*plan.size, height])
    std = np.array([*plan.std, _median(selected.stds[:, 2:], selected_weights)[0]])
    return FusedBox(
        origin,
        origin + base @ (*plan.center, bottom + height / 2),
        base @ _about_z(plan.side * 2 * np.pi / DIRECTIONS),
        size,
        std * np.sqrt(_COMMON + (1 - _COMMON) / len(selected_weights)),
        plan.oval and abs(float(_elongation(size[None])[0])) < _ROUND,
    )


def _resting(centers: F8, weights: F8) -> int:
    """Return the index of the most central view at the place where the object stands longest.

    ``centers`` (k, 3), metres, are those of the views' boxes, ``weights`` (k,) the views' weights.
    Views of a carried object are avoided: the estimate of a box assumes an object on its support.
    """
    distances = np.linalg.norm(centers - _median(centers, weights), axis=1)
    first = int(distances.argmin())
    total = weights.sum()
    if weights[_near(centers, centers[first])].sum() >= 0.5 * total:
        return first
    around = [weights[_near(centers, center)].sum() for center in centers]
    return int(np.lexsort((distances, -np.array(around)))[0])


def _near(centers: F8, place: F8) -> Bool:
    """Return which centres (k, 3) are near enough to a place (3,) for a still object: (k,)."""
    return np.asarray(np.linalg.norm(centers - place, axis=1) < _STILL_M)


def _not_turned(axes: F8, sizes: F8, weights: F8) -> Bool:
    """Return which views (k,), in order of time, show the yaw with the largest total weight.

    They are all views if the yaw is never steady. The object stands in one place; ``axes``
    (k, 3, 3) and ``sizes`` (k, 3) are as in `BoxViews`, ``weights`` (k,) are those of the views.
    """
    result = np.ones(len(axes), np.bool_)
    best_weight, elongation = 0.0, _elongation(sizes)
    for k in np.unique(np.linspace(0, len(axes) - 1, _TRIED).astype(np.int64)).tolist():
        window = slice(max(0, k - _NEIGHBOURS), k + _NEIGHBOURS + 1)
        base = _mean_axes(axes[window], sizes[window], weights[window])
        angle, local_elongation = _yaws(base, axes[window]), elongation[window]
        along, most_along = (
            np.mean(local_elongation * np.cos(2 * angle)),
            np.mean(abs(local_elongation)),
        )
        turning = np.mean(np.cos(4 * angle)) < _STEADY or (
            most_along > _ROUND and abs(along) < _STEADY * most_along
        )
        unturned = ~_turned_from(base, float(along), axes, sizes)
        if not turning and weights[unturned].sum() > best_weight:
            result, best_weight = unturned, weights[unturned].sum()
    return result


def _turned_from(base: F8, elongation: float, axes: F8, sizes: F8) -> Bool:
    """Return in which views (k,) an object has turned from a box with the axes ``base``.

    Neighbouring views must agree, as a single one may err. ``elongation`` is that of the box, as
    from `_elongation`; ``axes`` and ``sizes`` are as in `_not_turned`.
    """
    angle, longer, count = _yaws(base, axes), _elongation(sizes), np.ones(len(axes))
    weights = _SQUARE + abs(longer)
    around = count[: 2 * _NEIGHBOURS + 1]
    yaw = np.convolve(weights * np.exp(4j * angle), around, "same")
    along = np.convolve(longer * np.cos(2 * angle), around, "same")
    agree = abs(yaw) > _STEADY * np.convolve(weights, around, "same")
    off = abs(np.angle(yaw)) > np.radians(4 * _TURNED_DEG)
    across = -np.sign(elongation) * along > _ROUND * np.convolve(count, around, "same")
    return np.asarray(agree & (off | (across & (abs(elongation) > _ROUND))))


def _yaws(base: F8, axes: F8) -> F8:
    """Return yaws (k,), radians, of boxes with ``axes`` (k, 3, 3), relative to ``base`` (3, 3)."""
    x, y, _ = (axes[:, :, 0] @ base).T
    return np.asarray(np.arctan2(y, x))


def _elongation(sizes: F8) -> F8:
    """Return how much longer boxes (k, 3) are along their first axis than along the second: (k,).

    The difference is a fraction of the longer side: -1 to 1, and 0 for a square.
    """
    length, width = sizes[:, 0], sizes[:, 1]
    return np.asarray((length - width) / np.maximum(np.maximum(length, width), 1e-6))


def _mean_axes(axes: F8, sizes: F8, weights: F8) -> F8:
    """Return the mean axes (3, 3): the first of ``axes``, turned to the mean yaw modulo 90 degrees.

    The parameters are as in `_not_turned`.
    """
    first = axes[0]
    total = np.sum(weights * (_SQUARE + abs(_elongation(sizes))) * np.exp(4j * _yaws(first, axes)))
    return np.asarray(first @ _about_z(float(np.angle(total)) / 4))


def _overlaid(views: BoxViews, weights: F8, origin: F8, base: F8) -> tuple[F8, F8]:
    """Return the median outline about ``origin``, and the share of views seeing each direction.

    Both are (96,), and use the views' ``weights`` (k,). ``origin`` (3,) is in metres. Directions
    begin at the first of the axes ``base``, and turn towards the second.
    """
    around = _turned(views.outlines, _yaws(base, views.axes))
    positions = (views.centers - origin) @ base
    outlines = around + positions[:, :1] * COSINES + positions[:, 1:2] * SINES
    facing = faced(((views.sensors - origin) @ base)[:, :2])
    view_weights = weights[:, None] * np.where(facing, 1.0, _UNSEEN)
    # The outline of a partial view is smaller: it must not outvote complete views.
    complete = weights >= weights.max()
    complete_outline = _median(outlines[complete], view_weights[complete])
    outlines = np.where(complete[:, None], outlines, np.maximum(outlines, complete_outline))
    share = (weights[:, None] * facing).sum(axis=0) / weights.sum()
    median = _median(outlines, view_weights)
    # If a thin object moves a little, its opposite sides may come from views whose outlines do not
    # overlap.
    min_width = _NARROWEST * _widths(outlines).min(axis=0)
    return median + np.maximum(min_width - _widths(median), 0.0) / 2, share


def _widths(outlines: F8) -> F8:
    """Return the width of outlines (..., 96) in each direction, metres."""
    return np.asarray(outlines + np.roll(outlines, DIRECTIONS // 2, axis=-1))


def _turned(outlines: F8, angles: F8) -> F8:
    """Return outlines (k, 96), each turned by its angle (k,), radians, with interpolation."""
    rows = np.arange(len(outlines))[:, None]
    steps = np.arange(DIRECTIONS) - angles[:, None] * (DIRECTIONS / (2 * np.pi))
    before = np.floor(steps).astype(np.int64)
    share = steps - before
    first, second = (outlines[rows, at % DIRECTIONS] for at in (before, before + 1))
    return np.asarray(first + share * (second - first))


def _alike(axes: F8, sizes: F8, size: F8) -> F8:
    """Return axes (k, 3, 3), turned by 90 degrees where the other side is longer in ``size``.

    ``sizes`` (k, 3) are the lengths along these axes, ``size`` (3,) those of the fused box.
    """
    swapped = (sizes[:, 0] < sizes[:, 1]) != (size[0] < size[1])
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    return np.where(swapped[:, None, None], axes @ quarter, axes)


def _about_z(angle: float) -> F8:
    """Return the rotation (3, 3) about z by an angle, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _median(values: F8, weights: F8) -> F8:
    """Return the weighted median (n,) of values (k, n) for weights (k,) or (k, n)."""
    weights = np.broadcast_to(weights if weights.ndim == 2 else weights[:, None], values.shape)
    order = np.argsort(values, axis=0, kind="stable")
    summed = np.cumsum(np.take_along_axis(weights, order, 0), axis=0)
    at = np.argmax(summed >= 0.5 * summed[-1], axis=0)
    chosen = np.take_along_axis(order, at[None], 0)
    return np.asarray(np.take_along_axis(values, chosen, 0)[0])
