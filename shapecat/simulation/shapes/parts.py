"""Simple solids from which distractors are assembled."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from shapecat.geometry import rotation_from_quaternion
from shapecat.simulation.shapes.mesh import Mesh, moved, scaled
from shapecat.simulation.shapes.primitives import lathe, smooth_path
from shapecat.types import Pose

__all__ = ["ellipsoid", "placed", "rod", "turned_body"]


def placed(
    mesh: Mesh, place: ArrayLike = (0, 0, 0), *, about: str = "", degrees: float = 0.0
) -> Mesh:
    """Turn a mesh by ``degrees``, then move it by ``place`` (3,), in metres.

    ``about`` is the axis of the turn: ``x``, ``y`` or ``z``.
    """
    half = np.radians(degrees) / 2
    quaternion = [0.0, 0.0, 0.0, float(np.cos(half))]
    if about:
        quaternion["xyz".index(about)] = float(np.sin(half))
    return moved(mesh, Pose(rotation_from_quaternion(quaternion), np.asarray(place, np.float64)))


def rod(length: float, radius: float) -> Mesh:
    """Return an upright cylinder that stands on z = 0; metres."""
    return lathe([[0, 0], [radius, 0], [radius, length], [0, length]], segments=16)


def ellipsoid(axes: ArrayLike) -> Mesh:
    """Return an ellipsoid centred on the origin; ``axes`` (3,) are its semi-axes, metres."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 17)
    return scaled(
        lathe(np.stack([np.cos(t), np.sin(t)], -1) * 0.1, segments=24), np.asarray(axes) * 10
    )


def turned_body(knots: Sequence[tuple[float, float]], count: int = 26) -> Mesh:
    """Return a solid of revolution about z with a smooth profile through (radius, z) knots.

    ``count`` is the number of rings of the mesh; lengths are in metres.
    """
    path = smooth_path(knots, count)
    path[:, 0] = np.maximum(path[:, 0], 0)
    return lathe(path, segments=36)
