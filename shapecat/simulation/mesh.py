"""Triangle meshes, and how they are joined, stretched and moved."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, I4, Record, array
from shapecat.types import Pose

__all__ = ["Mesh", "join", "moved", "scaled", "standing"]


class Mesh(Record):
    """A surface of triangles; which side of a triangle is outside does not matter.

    Coordinates are whole micrometres, so that the last bit of a sine, which differs between
    machines, never reaches a simulated recording.

    Attributes
    ----------
    vertices : (n, 3) metres, z up; an object stands on z = 0.
    triangles : (m, 3) rows of ``vertices``.
    """

    vertices: F4 = array("n 3", "f4")
    triangles: I4 = array("m 3", "i4")

    def __post_init__(self) -> None:
        """Round the coordinates."""
        object.__setattr__(self, "vertices", np.round(np.asarray(self.vertices, np.float64), 6))
        super().__post_init__()

    @property
    def extents(self) -> F4:
        """(3,) lengths of the axis-aligned bounding box, metres."""
        return np.asarray(np.ptp(self.vertices, axis=0), np.float32)


def join(parts: Sequence[Mesh]) -> Mesh:
    """Put meshes into one; what overlaps stays."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([p.triangles + s for p, s in zip(parts, starts, strict=True)]),
    )


def scaled(mesh: Mesh, factors: ArrayLike) -> Mesh:
    """Stretch by one factor, or by (3,), one for each axis."""
    return Mesh(mesh.vertices * np.asarray(factors, np.float64), mesh.triangles)


def moved(mesh: Mesh, pose: Pose) -> Mesh:
    """Move by a pose ``a_from_mesh``."""
    points = np.asarray(mesh.vertices, np.float64)
    turned = sum(points[:, k, None] * pose.rotation[:, k] for k in range(3))
    return Mesh(turned + pose.translation, mesh.triangles)


def standing(mesh: Mesh) -> Mesh:
    """Centre over the origin and put the lowest vertex on z = 0."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle = (np.asarray(low, np.float64) + high) / 2
    return Mesh(mesh.vertices - np.array([middle[0], middle[1], low[2]]), mesh.triangles)
