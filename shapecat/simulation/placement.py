"""How a thing can lie still on a level surface."""

import numpy as np
from numpy.random import Generator
from scipy.spatial import ConvexHull

from shapecat.arrays import F8, Record
from shapecat.geometry import gravity_rotation
from shapecat.simulation.mesh import Mesh
from shapecat.types import Pose

__all__ = ["Rest", "choose_rest", "rests", "turn_about_z"]


class Rest(Record):
    """A way to rest on a level surface.

    Attributes
    ----------
    pose : ``level_from_mesh``: what touches the surface is at z = 0, the middle over the origin.
    manner : ``upright``, ``upside_down`` or ``lying``.
    """

    pose: Pose
    manner: str


def rests(mesh: Mesh) -> tuple[Rest, ...]:
    """Find the faces of its convex hull that a thing does not roll off from.

    A thing rests on a face if its centre of mass, taken as that of its hull, lies above it. Manners
    are told by how far the thing's own z axis is from the vertical: up to 15 degrees.

    Returns
    -------
    One for each triangle of the hull it can rest on, in the order of their normals.
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
    found = []
    for down in faces:
        rotation = np.round(gravity_rotation(-down), 9)
        z = points @ rotation[2]
        place = np.array([*-(rotation[:2] @ middle), -z.min()])
        tilt = rotation[2, 2]
        manner = "upright" if tilt > 0.966 else "upside_down" if tilt < -0.966 else "lying"
        found.append(Rest(Pose(rotation, np.round(place, 9)), manner))
    return tuple(found)


def turn_about_z(pose: Pose, angle: float, place: F8) -> Pose:
    """Turn what stands on the origin about z, by radians, and move it to ``place`` (3,), metres."""
    c, s = np.round(np.cos(angle), 9), np.round(np.sin(angle), 9)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Pose(turn @ pose.rotation, turn @ pose.translation + place)


def choose_rest(found: tuple[Rest, ...], manner: str, rng: Generator) -> Rest | None:
    """Draw one of the rests of a manner; None if there is none."""
    fitting = [rest for rest in found if rest.manner == manner]
    return fitting[int(rng.integers(len(fitting)))] if fitting else None


def _centre_of_mass(corners: F8, origin: F8) -> F8:
    """Return the centre of a convex solid given by its triangles (k, 3, 3)."""
    a = corners - origin
    volumes = np.abs(np.einsum("ij,ij->i", a[:, 0], np.cross(a[:, 1], a[:, 2])))
    centres = a.sum(axis=1) / 4
    return np.asarray(origin + (centres * volumes[:, None]).sum(axis=0) / volumes.sum())


def _inside(corners: F8, normals: F8, foot: F8) -> F8:
    """Tell which points lie in their triangles, a little margin included."""
    signs = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        signs.append(np.einsum("ij,ij->i", np.cross(b - a, foot - a), normals))
    turned = np.array(signs)
    return np.asarray((turned >= -1e-9).all(axis=0) | (turned <= 1e-9).all(axis=0))
