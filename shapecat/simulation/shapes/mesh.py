"""Triangle meshes, and functions that join, scale and move them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, I4, Record, array
from shapecat.types import Pose

__all__ = ["Mesh", "join", "moved", "scaled", "standing"]


class Mesh(Record):
    """A triangle mesh; the winding order of its triangles does not matter.

    Coordinates are rounded to 1 um: the last bit of a sine differs between machines, and must not
    change a simulated recording.

    Attributes
    ----------
    vertices : (n, 3) metres, z up. Objects stand on z = 0; the meshes of supports are in the world
        frame.
    triangles : (m, 3) indices into ``vertices``.
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
    """Concatenate meshes into one; overlapping surfaces are kept."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([p.triangles + s for p, s in zip(parts, starts, strict=True)]),
    )


def scaled(mesh: Mesh, factors: ArrayLike) -> Mesh:
    """Scale a mesh by one factor, or by one factor per axis (3,)."""
    return Mesh(mesh.vertices * np.asarray(factors, np.float64), mesh.triangles)


def moved(mesh: Mesh, pose: Pose) -> Mesh:
    """Transform a mesh by a pose ``frame_from_mesh``."""
    points = np.asarray(mesh.vertices, np.float64)
    turned = sum(points[:, k, None] * pose.rotation[:, k] for k in range(3))
    return Mesh(turned + pose.translation, mesh.triangles)


def standing(mesh: Mesh) -> Mesh:
    """Centre a mesh over the origin, with its lowest vertex at z = 0."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle = (np.asarray(low, np.float64) + high) / 2
    return Mesh(mesh.vertices - np.array([middle[0], middle[1], low[2]]), mesh.triangles)
