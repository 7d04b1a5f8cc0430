"""Partial views of objects, as behind an occluder."""

from dataclasses import replace

import numpy as np

from shapecat.arrays import F8, Bool
from shapecat.evaluation import View

__all__ = ["cut_fragment", "image_plane_points", "remove_base"]

_FEWEST_POINTS = 60
_KEPT = (0.3, 0.85)
"""Minimum and maximum fraction of the points that remain."""
_LOW = 0.3
"""A fragment must have points in this lowest fraction of the height, near the support."""
_TRIES = 8


def cut_fragment(view: View, rng: np.random.Generator) -> View | None:
    """Occlude a part of a view by a straight edge, a bar, or a corner.

    Returns
    -------
    A view with 30 to 85 % of the points: at least 60, some of them near the support. None after
    eight failed attempts.
    """
    across = image_plane_points(view)
    height = view.points[:, 2]
    low = height < height.min() + _LOW * np.ptp(height)
    for _ in range(_TRIES):
        kind = rng.choice(3, p=[0.55, 0.25, 0.2])
        inside = (_beside_edge, _around_bar, _outside_corner)[kind](across, rng)
        share = inside.mean()
        if (
            _KEPT[0] <= share <= _KEPT[1]
            and inside.sum() >= _FEWEST_POINTS
            and np.any(inside & low)
        ):
            return replace(view, points=view.points[inside])
    return None


def remove_base(view: View, rng: np.random.Generator) -> View:
    """Remove the points near the support, as plane removal does.

    The removed layer is 4 to 9 mm thick at 1 m, and thicker at larger distances. A view that has
    no other points is returned unchanged.
    """
    distance = float(np.linalg.norm(view.eye - view.points.mean(axis=0)))
    cut = rng.uniform(0.003, 0.006) + 0.003 * distance**2 * rng.uniform(0.3, 1.0)
    inside = view.points[:, 2] > cut
    return replace(view, points=view.points[inside]) if inside.any() else view


def image_plane_points(view: View) -> F8:
    """Project a view's points onto a plane perpendicular to its line of sight; (n, 2), metres."""
    centre = view.points.mean(axis=0, dtype=np.float64)
    sight = view.eye - centre
    sight /= np.linalg.norm(sight)
    right = np.cross([0.0, 0.0, 1.0], sight)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0, 0])
    return np.asarray((view.points - centre) @ np.stack([right, np.cross(sight, right)], axis=1))


def _direction(rng: np.random.Generator) -> F8:
    """Return a random unit vector (2,)."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _beside_edge(across: F8, rng: np.random.Generator) -> Bool:
    """Return which points (n,) are on one side of a straight edge.

    ``across`` (n, 2) are the points, from `image_plane_points`.
    """
    along = across @ _direction(rng)
    return np.asarray(along <= np.quantile(along, rng.uniform(0.35, 0.8)))


def _around_bar(across: F8, rng: np.random.Generator) -> Bool:
    """Return which points (n,) are not behind a bar; ``across`` is as in `_beside_edge`."""
    along = across @ _direction(rng)
    width = rng.uniform(0.15, 0.4)
    start = rng.uniform(0.15, 0.85 - width)
    low, high = np.quantile(along, [start, start + width])
    return np.asarray((along <= low) | (along >= high))


def _outside_corner(across: F8, rng: np.random.Generator) -> Bool:
    """Return which points (n,) are outside a corner; ``across`` is as in `_beside_edge`."""
    first = _direction(rng)
    second = np.array([-first[1], first[0]])
    a, b = across @ first, across @ second
    at_a, at_b = np.quantile(a, rng.uniform(0.3, 0.7)), np.quantile(b, rng.uniform(0.3, 0.7))
    return np.asarray((a <= at_a) | (b <= at_b))
