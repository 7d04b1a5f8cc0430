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
    "level_box",
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
    return Box(*level_box(np.ascontiguousarray((points @ level.T.astype(np.float32)).T), level))


@kernel
def level_box(points: F4, level: F8) -> tuple[F8, F8, F8]:
    """Return centre, size and orientation of the box of `upright_box`, sensor frame.

    Parameters
    ----------
    points : (3, n) in the level frame, float32.
    level : (3, 3) the axes of that frame, from `level_axes`.
    """
    yaw, low, high = _smallest_rectangle(points[0], points[1])
    low[2] = high[2] = points[2, 0]
    for k in range(points.shape[1]):
        low[2], high[2] = min(low[2], points[2, k]), max(high[2], points[2, k])
    cos, sin = math.cos(yaw), math.sin(yaw)
    axes, middle = np.zeros((3, 3)), (low + high) / 2
    for d in range(3):
        axes[d, 0] = cos * level[0, d] + sin * level[1, d]
        axes[d, 1] = cos * level[1, d] - sin * level[0, d]
        axes[d, 2] = level[2, d]
    center = np.zeros(3)
    for d in range(3):
        center[d] = axes[d, 0] * middle[0] + axes[d, 1] * middle[1] + axes[d, 2] * middle[2]
    a, b, c = axes
    turned = row_quaternion((a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2]))
    return center, high - low, np.array(turned)


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


_YAWS = np.arange(60) * (np.pi / 120)
_COS, _SIN = np.cos(_YAWS).astype(np.float32), np.sin(_YAWS).astype(np.float32)


@kernel(fast=True)
def _smallest_rectangle(x: F4, y: F4) -> tuple[float, F8, F8]:
    """Return yaw, least and greatest corner (3,) of the smallest rectangle around points.

    All yaws are turned to at once, one point after the other: this vectorises.
    """
    n = _YAWS.size
    left, back = np.full(n, np.float32(np.inf)), np.full(n, np.float32(np.inf))
    right, front = np.full(n, np.float32(-np.inf)), np.full(n, np.float32(-np.inf))
    for k in range(x.size):
        for t in range(n):
            u, v = _COS[t] * x[k] + _SIN[t] * y[k], _COS[t] * y[k] - _SIN[t] * x[k]
            left[t], right[t] = u if u < left[t] else left[t], u if u > right[t] else right[t]
            back[t], front[t] = v if v < back[t] else back[t], v if v > front[t] else front[t]
    best = int(np.argmin((right - left) * (front - back)))
    low, high = np.zeros(3), np.zeros(3)
    low[0], low[1], high[0], high[1] = left[best], back[best], right[best], front[best]
    return _YAWS[best], low, high
