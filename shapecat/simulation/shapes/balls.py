"""Balls: spheres and round fruit."""

import numpy as np
from numpy.random import Generator

from shapecat.geometry import rotation_from_quaternion
from shapecat.simulation.shapes.mesh import Mesh, join, moved, scaled, standing
from shapecat.simulation.shapes.primitives import lathe, tube
from shapecat.simulation.shapes.randomness import log_uniform
from shapecat.types import Pose

__all__ = ["make_ball"]


def make_ball(rng: Generator) -> Mesh:
    """Make a ball: a sphere, often stretched along each axis by 0.97 to 1.03, or a round fruit."""
    diameter = log_uniform(rng, 0.032, 0.24)
    scale = rng.uniform(0.97, 1.03, 3) if rng.random() < 0.6 else 1.0
    quaternion = np.round(rng.normal(size=4), 6)
    own = rng.spawn(1)[0]  # so that the other objects of a scene do not depend on the kind of ball
    if own.random() < 0.5:
        return _fruit(own, min(diameter, 0.12))
    t = np.linspace(-np.pi / 2, np.pi / 2, 25)
    mesh = lathe(np.stack([np.cos(t), np.sin(t)], -1) * diameter / 2, segments=36)
    turn = Pose(rotation_from_quaternion(quaternion), np.zeros(3))
    return standing(moved(scaled(mesh, scale), turn))


def _fruit(rng: Generator, diameter: float) -> Mesh:
    """Return a fruit that stands on a dimpled end (apple, tomato, peach) or lies (lemon, plum).

    It is 0.75 to 1.4 times as long as wide.
    """
    t = np.linspace(-np.pi / 2, np.pi / 2, 41)
    bottom, top = (np.exp(-(((np.pi / 2 + angle) / 0.35) ** 2)) for angle in (t, -t))
    taper = 1 + rng.uniform(0, 0.15) * np.sin(t)
    if lies := rng.random() < 0.4:
        length = rng.uniform(1.0, 1.4)
        radius = 1 + rng.uniform(0, 0.15) * (top + bottom)
    else:
        length, dimple = rng.uniform(0.75, 1.05), rng.uniform(0, 0.35)
        radius = 1 - dimple * (top + rng.uniform(0, 0.8) * bottom)
    profile = np.stack([radius * np.cos(t) * taper, length * radius * np.sin(t)], -1)
    mesh = lathe(profile * diameter / 2, segments=40)
    if rng.random() < 0.3:
        mesh = _ribbed(mesh, rng.uniform(0.01, 0.04))
    if rng.random() < 0.2:
        end = np.array([0, 0, profile[-1, 1] * diameter / 2 - 0.002])
        tip = end + [0, 0, rng.uniform(0.15, 0.3) * diameter] + 0.003 * rng.normal(size=3)
        mesh = join([mesh, tube(np.stack([end, tip]), rng.uniform(0.0012, 0.0025))])
    half = (np.pi / 2 if lies else rng.normal() * 0.25 + np.pi * (rng.random() < 0.2)) / 2
    turn = rotation_from_quaternion([np.sin(half), 0, 0, np.cos(half)])
    return standing(moved(mesh, Pose(turn, np.zeros(3))))


def _ribbed(mesh: Mesh, height: float) -> Mesh:
    """Add five ribs around the z axis, as high as ``height`` times the radius."""
    points = np.array(mesh.vertices, np.float64)
    ribs = np.cos(5 * np.arctan2(points[:, 1], points[:, 0]))
    points[:, :2] *= (1 + height * ribs)[:, None]
    return Mesh(points, mesh.triangles)
