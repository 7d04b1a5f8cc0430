"""Random sizes and rotations of objects."""

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.geometry import rotation_from_quaternion
from shapecat.simulation.shapes.mesh import Mesh, moved
from shapecat.types import Pose

__all__ = ["log_uniform", "random_rotation", "with_random_yaw"]


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """Draw a number between ``low`` and ``high`` with a uniformly distributed logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_rotation(rng: Generator) -> F8:
    """Draw a uniformly distributed rotation (3, 3)."""
    quaternion = rng.normal(size=4)
    return rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))


def with_random_yaw(mesh: Mesh, rng: Generator) -> Mesh:
    """Turn a mesh by a random angle about z."""
    half = rng.uniform(0, np.pi)
    turn = rotation_from_quaternion([0, 0, np.sin(half), np.cos(half)])
    return moved(mesh, Pose(turn, np.zeros(3)))
