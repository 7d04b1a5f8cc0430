"""Poses, quaternions, boxes, the gravity frame, limits of depth: what the stages share."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8
from shapecat.jit import kernel
from shapecat.types import Box, Pose

__all__ = [
    "DISCONTINUITY",
    "IDENTITY",
    "NEAREST_M",
    "box_corners",
    "compose",
    "cross",
    "gravity_rotation",
    "inverse",
    "level_axes",
    "level_from_sensor",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "row_quaternion",
    "transform",
    "upright_box",
]

DISCONTINUITY = 0.012
"""Step in inverse depth that separates surfaces, 1/m: four steps of a Kinect, 1 cm at 0.9 m."""
NEAREST_M = 0.05
"""Nothing measures nearer; keeps inverse depth within bounds."""
IDENTITY = Pose(np.eye(3), np.zeros(3))
"""The pose that changes nothing."""


def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """Chain two poses into ``a_from_c``."""
    return Pose(
        a_from_b.rotation @ b_from_c.rotation,
        a_from_b.rotation @ b_from_c.translation + a_from_b.translation,
    )


def inverse(a_from_b: Pose) -> Pose:
    """Return ``b_from_a``."""
    return Pose(a_from_b.rotation.T, -a_from_b.rotation.T @ a_from_b.translation)


def transform(a_from_b: Pose, points: ArrayLike) -> F8:
    """Move points (n, 3) or one point (3,) from frame b to frame a."""
    return np.asarray(np.asarray(points, np.float64) @ a_from_b.rotation.T + a_from_b.translation)


def rotation_from_quaternion(quaternion: ArrayLike) -> F8:
    """Return the (3, 3) rotation of a quaternion (x, y, z, w) of any length but zero.

    Raises
    ------
    ValueError : the quaternion is zero or not finite.
    """
    q = np.asarray(quaternion, np.float64)
    norm = float(q @ q)
    if not (np.isfinite(norm) and norm > 1e-12):
        msg = f"not a rotation: quaternion {q.tolist()}"
        raise ValueError(msg)
    x, y, z, w = q
    s = 2.0 / norm
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: ArrayLike) -> F8:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation matrix.

    Source: Shepperd 1978, by the largest of the four squared components.
    """
    return np.array(_quaternion(*np.asarray(rotation, np.float64).tolist()))


_Row: TypeAlias = Sequence[float]


def _quaternion(first: _Row, second: _Row, third: _Row) -> tuple[float, float, float, float]:
    xx, xy, xz = first
    yx, yy, yz = second
    zx, zy, zz = third
    trace = xx + yy + zz
    if trace > max(xx, yy, zz):
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1 + trace
    elif xx >= max(yy, zz):
        x, y, z, w = 1 + 2 * xx - trace, xy + yx, xz + zx, zy - yz
    elif yy >= zz:
        x, y, z, w = xy + yx, 1 + 2 * yy - trace, yz + zy, xz - zx
    else:
        x, y, z, w = xz + zx, yz + zy, 1 + 2 * zz - trace, yx - xy
    norm = math.sqrt(x * x + y * y + z * z + w * w) * (-1 if w < 0 else 1)
    return x / norm, y / norm, z / norm, w / norm


row_quaternion = kernel(_quaternion)
"""`quaternion_from_rotation` for kernels: the three rows, as tuples, to (x, y, z, w)."""


def gravity_rotation(up: ArrayLike) -> F8:
    """Return ``level_from_sensor``: a (3, 3) rotation that turns ``up`` into +z.

    The level x axis is the sensor's x axis made horizontal, or its y axis where that is steeper
    than about 45 degrees, so that the result changes smoothly with ``up``.

    Examples
    --------
    >>> gravity_rotation([0, -1, 0]) @ [0, -1, 0]
    array([0., 0., 1.])
    """
    return np.array(_level_axes(*np.asarray(up, np.float64).tolist()))


def _level_axes(x: float, y: float, z: float) -> tuple[tuple[float, float, float], ...]:
    norm = math.sqrt(x * x + y * y + z * z)
    a, b, c = x / norm, y / norm, z / norm
    d, e, f = (1 - a * a, -a * b, -a * c) if abs(a) < 0.7 else (-a * b, 1 - b * b, -b * c)
    norm = math.sqrt(d * d + e * e + f * f)
    d, e, f = d / norm, e / norm, f / norm
    return (d, e, f), (b * f - c * e, c * d - a * f, a * e - b * d), (a, b, c)


level_axes = kernel(_level_axes)
"""`gravity_rotation` for kernels: (x, y, z) to its three rows."""


@kernel
def cross(a: F8, b: F8) -> F8:
    """Return the cross product of two vectors (3,)."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def level_from_sensor(up: ArrayLike, offset: float, points: ArrayLike) -> Pose:
    """Return the pose that stands an object upright on z = 0.

    In the level frame z is the height above the support and the points are centred on the z axis;
    the translation of the pose is the place of the sensor.

    Parameters
    ----------
    up : (3,) vector, sensor frame.
    offset : distance of the support from the sensor along ``up``, metres: ``up @ p`` of its points.
    points : (n, 3) points of the object, metres, sensor frame, finite, at least one.

    Raises
    ------
    ValueError : there is no point.
    """
    points = np.asarray(points, np.float64)
    if len(points) == 0:
        msg = "an object needs at least one point"
        raise ValueError(msg)
    rotation = gravity_rotation(up)
    x, y, _ = rotation @ _mean(np.ascontiguousarray(points))
    return Pose(rotation, np.array([-x, -y, -offset]))


def upright_box(points: F4, up: ArrayLike) -> Box:
    """Return the smallest box around ``points`` (n, 3) with its z axis along ``up``.

    Its yaw is the one of 60 (every 1.5 degrees) with the smallest horizontal area, the first on
    ties. A single point gives a box of size 0.

    Raises
    ------
    ValueError : there is no point.
    """
    if len(points) == 0:
        msg = "a box needs at least one point"
        raise ValueError(msg)
    level = gravity_rotation(up)
    local = np.ascontiguousarray((points @ level.T.astype(np.float32)).T)
    angles = np.arange(60) * (np.pi / 120)
    c, s = np.cos(angles), np.sin(angles)
    along = _range_along(local[0], local[1], c, s)
    across = _range_along(local[0], local[1], -s, c)
    best = int(np.argmin((along[:, 1] - along[:, 0]) * (across[:, 1] - across[:, 0])))
    low = np.array([along[best, 0], across[best, 0], local[2].min()])
    high = np.array([along[best, 1], across[best, 1], local[2].max()])
    box_from_level = np.array([[c[best], s[best], 0.0], [-s[best], c[best], 0.0], [0.0, 0.0, 1.0]])
    sensor_from_box = (box_from_level @ level).T
    return Box(
        sensor_from_box @ ((low + high) / 2), high - low, quaternion_from_rotation(sensor_from_box)
    )


def box_corners(box: Box) -> F8:
    """Return (8, 3) the corners of a box, sensor frame: the lower four around, then the upper."""
    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    unit = np.array([[x, y, z] for z in (-1, 1) for x, y in signs.tolist()], np.float64)
    rotation = rotation_from_quaternion(box.orientation)
    return np.asarray(box.center + (unit * box.size / 2) @ rotation.T)


@kernel
def _mean(points: F8) -> F8:
    """Return the mean of points (n, 3): as numpy's, without its cost for so few columns."""
    x = y = z = 0.0
    for i in range(points.shape[0]):
        x += points[i, 0]
        y += points[i, 1]
        z += points[i, 2]
    mean: F8 = np.array([x, y, z]) / points.shape[0]
    return mean


@kernel(fast=True)
def _range_along(x: F4, y: F4, dx: F8, dy: F8) -> F8:
    """Return (k, 2) the least and greatest ``x * dx + y * dy`` for each of k directions."""
    result = np.zeros((dx.size, 2), np.float64)
    for k in range(dx.size):
        a, b = np.float32(dx[k]), np.float32(dy[k])
        low = high = a * x[0] + b * y[0]
        for i in range(x.size):
            value = a * x[i] + b * y[i]
            low = value if value < low else low
            high = value if value > high else high
        result[k] = low, high
    return result
