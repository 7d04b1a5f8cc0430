"""Outlines of objects seen from above, and tests whether they overlap."""

import numpy as np
from scipy.spatial import ConvexHull

from shapecat.arrays import F8, Record, array
from shapecat.geometry import transform
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.types import Pose

__all__ = ["Footprint", "footprint", "inside", "overlap"]


class Footprint(Record):
    """Outline and height range of an object; metres, world frame.

    Attributes
    ----------
    outline : (k, 2) convex outline seen from above, counter-clockwise.
    contact : (c, 2) convex outline of the vertices within 1 mm of the lowest.
    top : (t, 2) convex outline of the vertices within 1 mm of the highest.
    low, high : z of the lowest and highest vertex.
    """

    outline: F8 = array("k 2", "f8")
    contact: F8 = array("c 2", "f8")
    top: F8 = array("t 2", "f8")
    low: float
    high: float

    def moved(self, turn: Pose) -> "Footprint":
        """Return the footprint after the motion ``turn``, which may rotate it about z only."""
        about_z, (x, y, z) = turn.rotation[:2, :2].T, turn.translation
        outline, contact, top = (
            flat @ about_z + (x, y) for flat in (self.outline, self.contact, self.top)
        )
        return Footprint(outline, contact, top, self.low + z, self.high + z)


def footprint(mesh: Mesh, world_from_mesh: Pose) -> Footprint:
    """Return the footprint of a mesh at a pose ``world_from_mesh``."""
    points = transform(world_from_mesh, mesh.vertices)
    low, high = float(points[:, 2].min()), float(points[:, 2].max())
    contact = points[points[:, 2] < low + 0.001, :2]
    top = points[points[:, 2] > high - 0.001, :2]
    return Footprint(_hull(points[:, :2]), _hull(contact), _hull(top), low, high)


def overlap(a: F8, b: F8, gap: float) -> bool:
    """Return whether two convex outlines, (k, 2) and (m, 2), are closer than ``gap``, metres.

    Outlines that are nearest at two corners may count as closer than they are.

    Source: separating axis theorem.
    """
    for one, other in ((a, b), (b, a)):
        normals = _normals(one)
        upper = (one @ normals.T).max(axis=0)
        lower = (other @ normals.T).min(axis=0)
        if np.any(lower - upper >= gap):
            return False
    return True


def inside(points: F8, outline: F8, margin: float) -> bool:
    """Return whether all points (n, 2) lie in a convex outline, at least ``margin`` from its edge.

    An outline that is a point or a line contains nothing.
    """
    if len(outline) < 3:
        return False
    normals = _normals(outline)
    upper = (outline @ normals.T).max(axis=0)
    return bool(np.all(points @ normals.T <= upper - margin))


def _normals(outline: F8) -> F8:
    """Return the outward unit normals (m, 2) of the sides of an outline (k, 2) that have a length.

    The corners are counter-clockwise.
    """
    edge = np.roll(outline, -1, axis=0) - outline
    normals = np.stack([edge[:, 1], -edge[:, 0]], -1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    keep = length[:, 0] > 1e-9
    return np.asarray(normals[keep] / length[keep])


def _hull(points: F8) -> F8:
    """Return the corners (k, 2) of the convex hull of points (n, 2), counter-clockwise.

    If the points are on a line, return its two ends; for a single point, these are equal.
    """
    spread = (
        np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) > 2 else [0]
    )
    if len(points) < 3 or spread[-1] < 1e-6:  # a point or a line
        along = np.argsort(points @ [0.8, 0.6])
        return points[along[[0, -1]]]
    return np.asarray(points[ConvexHull(points).vertices])
