"""Stable poses of a mesh on a horizontal surface."""

import numpy as np
from numpy.random import Generator
from scipy.spatial import ConvexHull

from shapecat.arrays import F8, Record
from shapecat.geometry import gravity_rotation
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.types import Pose

__all__ = ["StablePose", "choose_stable_pose", "stable_poses"]

_UPRIGHT = 0.966
"""Minimum cosine of the angle between the z axis of an upright mesh and up: 15 degrees."""


class StablePose(Record):
    """A stable pose of a mesh on a horizontal surface.

    Attributes
    ----------
    pose : ``level_from_mesh``; the lowest point is at z = 0, the centre of mass above the origin.
    name : ``upright``, ``upside_down`` or ``lying``.
    """

    pose: Pose
    name: str


def stable_poses(mesh: Mesh) -> tuple[StablePose, ...]:
    """Return the stable poses of a mesh on a horizontal surface.

    A mesh rests on a face of its convex hull if the hull's centre of mass lies above this face. A
    pose is upright or upside down if the mesh's z axis is within 15 degrees of the vertical.

    Returns
    -------
    One pose for each stable face, sorted by the normal of the face.
    """
    points = np.asarray(mesh.vertices, np.float64)
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    middle = _centre_of_mass(corners, points.mean(axis=0))
    normals = hull.equations[:, :3]
    height = -(normals @ middle) - hull.equations[:, 3]
    foot = middle + height[:, None] * normals
    stable = _inside(corners, normals, foot)
    faces = np.unique(np.round(normals[stable], 6), axis=0)
    poses = []
    for down in faces:
        rotation = np.round(gravity_rotation(-down), 9)
        z = points @ rotation[2]
        place = np.array([*-(rotation[:2] @ middle), -z.min()])
        tilt = rotation[2, 2]
        name = "upright" if tilt > _UPRIGHT else "upside_down" if tilt < -_UPRIGHT else "lying"
        poses.append(StablePose(Pose(rotation, np.round(place, 9)), name))
    return tuple(poses)


def choose_stable_pose(mesh: Mesh, name: str, rng: Generator) -> StablePose | None:
    """Draw one of the stable poses of a mesh that are called ``name``; None if it has none."""
    fitting = [stable for stable in stable_poses(mesh) if stable.name == name]
    return fitting[int(rng.integers(len(fitting)))] if fitting else None


def _centre_of_mass(corners: F8, origin: F8) -> F8:
    """Return the centre of mass (3,) of a convex solid with triangles (k, 3, 3).

    ``origin`` (3,) is a point inside the solid.
    """
    a = corners - origin
    volumes = np.abs(np.einsum("ij,ij->i", a[:, 0], np.cross(a[:, 1], a[:, 2])))
    centres = a.sum(axis=1) / 4
    return np.asarray(origin + (centres * volumes[:, None]).sum(axis=0) / volumes.sum())


def _inside(corners: F8, normals: F8, foot: F8) -> F8:
    """Return whether each point of ``foot`` (k, 3) lies in its triangle, with a small tolerance.

    ``corners`` (k, 3, 3) and ``normals`` (k, 3) are those of the triangles; the result is (k,).
    """
    signs = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        signs.append(np.einsum("ij,ij->i", np.cross(b - a, foot - a), normals))
    turned = np.array(signs)
    return np.asarray((turned >= -1e-9).all(axis=0) | (turned <= 1e-9).all(axis=0))
