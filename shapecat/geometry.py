"""Geometry that the stages share: poses, quaternions, boxes, the level frame, depth limits."""

import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8
from shapecat.jit import kernel
from shapecat.types import Box, Pose

__all__ = [
    "AGREE",
    "BOX_EDGES",
    "DISCONTINUITY",
    "IDENTITY",
    "LINK_FROM_OPTICAL",
    "NEAREST_M",
    "box_around",
    "box_corners",
    "compose",
    "cross",
    "gravity_rotation",
    "inverse",
    "level_axes",
    "level_box",
    "level_from_sensor",
    "levelled",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "row_quaternion",
    "transform",
    "unit_direction",
    "upright_box",
]

AGREE = 0.006
"""Largest difference in inverse depth between two measurements of one point, 1/m: two disparity
steps of a Kinect, and twice its noise; 6 mm at 1 m, 24 mm at 2 m."""
DISCONTINUITY = 0.012
"""Step in inverse depth that separates two surfaces, 1/m: twice `AGREE`, 1 cm at 0.9 m."""
NEAREST_M = 0.05
"""Smallest depth considered, metres: no sensor measures nearer, and inverse depth stays bounded."""
IDENTITY = Pose(np.eye(3), np.zeros(3))
"""The pose that changes nothing."""
LINK_FROM_OPTICAL = Pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""Pose of an optical frame (x right, z forward) in a camera's link (x forward, z up; REP 103)."""
BOX_EDGES = np.array(
    [(k, (k + 1) % 4) for k in range(4)]
    + [(k + 4, (k + 1) % 4 + 4) for k in range(4)]
    + [(k, k + 4) for k in range(4)]
)
"""The edges of a box (12, 2): pairs of indices into the corners from `box_corners`."""


def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """Chain two poses into ``a_from_c``."""
    return Pose(
        a_from_b.rotation @ b_from_c.rotation,
        a_from_b.rotation @ b_from_c.translation + a_from_b.translation,
    )


def inverse(a_from_b: Pose) -> Pose:
    """Return ``b_from_a``, the inverse of a pose."""
    return Pose(a_from_b.rotation.T, -a_from_b.rotation.T @ a_from_b.translation)


def transform(a_from_b: Pose, points: ArrayLike) -> F8:
    """Transform points (n, 3) or one point (3,) from frame b to frame a."""
    return np.asarray(np.asarray(points, np.float64) @ a_from_b.rotation.T + a_from_b.translation)


def unit_direction(vector: ArrayLike) -> F8:
    """Return a vector (3,) scaled to length 1.

    Raises
    ------
    ValueError : it is not three finite numbers, or they are all zero.
    """
    v = np.asarray(vector, np.float64)
    norm = float(np.linalg.norm(v))
    if v.shape != (3,) or not 1e-9 < norm < math.inf:
        msg = f"expected a direction of three numbers, not all zero; got {v.tolist()}"
        raise ValueError(msg)
    return np.asarray(v / norm)


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
"""`quaternion_from_rotation` for kernels: takes the three rows as tuples, returns (x, y, z, w)."""


def gravity_rotation(up: ArrayLike) -> F8:
    """Return ``level_from_sensor``: a (3, 3) rotation that turns ``up`` into +z.

    ``up`` (3,) is a vector of any length but zero, in the sensor frame.

    The level x axis is the horizontal part of the sensor's x axis, or of its y axis if the x axis
    is steeper than about 45 degrees, so that this part is never small.

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
"""`gravity_rotation` for kernels: takes x, y, z of ``up``, returns the three rows as tuples."""


@kernel(inner=True)
def cross(a: F8, b: F8) -> F8:
    """Return the cross product of two vectors (3,)."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def level_from_sensor(up: ArrayLike, offset: float, points: ArrayLike) -> Pose:
    """Return the pose ``level_from_sensor`` for the level frame of an object.

    In that frame z is the height above the support, and the mean of the points lies on the z axis;
    the translation of the pose is the position of the sensor.

    Parameters
    ----------
    up : (3,) unit vector, sensor frame.
    offset : metres, ``up @ p`` for the points p of the support.
    points : (n, 3) points of the object, metres, sensor frame, finite.

    Raises
    ------
    ValueError : ``points`` is empty.
    """
    points = np.asarray(points, np.float64)
    if len(points) == 0:
        msg = "an object needs at least one point"
        raise ValueError(msg)
    rotation = gravity_rotation(up)
    x, y, _ = rotation @ _mean(np.ascontiguousarray(points))
    return Pose(rotation, np.array([-x, -y, -offset]))


def upright_box(points: F4, up: ArrayLike) -> Box:
    """Return the smallest box around points with its z axis along ``up``.

    Of 60 yaws, every 1.5 degrees, the one with the smallest footprint is chosen, the first on a
    tie. A single point gives a box of size 0.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame.
    up : (3,) vector, sensor frame.

    Raises
    ------
    ValueError : ``points`` is empty.
    """
    turned, level = levelled(points, up)
    return Box(*level_box(np.ascontiguousarray(turned.T), level))


def levelled(points: F4, up: ArrayLike) -> tuple[F4, F8]:
    """Return the points rotated so that ``up`` becomes z, (n, 3), and the rotation (3, 3).

    The parameters are as for `upright_box`.

    Raises
    ------
    ValueError : ``points`` is empty.
    """
    if len(points) == 0:
        msg = "a box needs at least one point"
        raise ValueError(msg)
    level = gravity_rotation(up)
    return points @ level.T.astype(np.float32), level


@kernel
def level_box(points: F4, level: F8) -> tuple[F8, F8, F8]:
    """Return centre, size and orientation (x, y, z, w), sensor frame, of an `upright_box`.

    Parameters
    ----------
    points : (3, n) float32, metres, in the level frame.
    level : (3, 3) the axes of the level frame in the sensor frame, row by row.
    """
    yaw, low, high = _smallest_rectangle(points[0], points[1])
    low[2] = high[2] = points[2, 0]
    for k in range(points.shape[1]):
        low[2], high[2] = min(low[2], points[2, k]), max(high[2], points[2, k])
    cos, sin = math.cos(yaw), math.sin(yaw)
    axes, size = np.zeros((3, 3)), np.zeros(3)
    for d in range(3):
        size[d] = high[d] - low[d]
        axes[d, 0] = cos * level[0, d] + sin * level[1, d]
        axes[d, 1] = cos * level[1, d] - sin * level[0, d]
        axes[d, 2] = level[2, d]
    center = np.zeros(3)
    x, y, z = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2
    for d in range(3):
        center[d] = axes[d, 0] * x + axes[d, 1] * y + axes[d, 2] * z
    turned = row_quaternion(
        (axes[0, 0], axes[0, 1], axes[0, 2]),
        (axes[1, 0], axes[1, 1], axes[1, 2]),
        (axes[2, 0], axes[2, 1], axes[2, 2]),
    )
    return center, size, np.array(turned)


def box_corners(box: Box) -> F8:
    """Return the corners (8, 3) of a box, metres, sensor frame: the lower four, then the upper."""
    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    unit = np.array([[x, y, z] for z in (-1, 1) for x, y in signs.tolist()], np.float64)
    rotation = rotation_from_quaternion(box.orientation)
    return np.asarray(box.center + (unit * box.size / 2) @ rotation.T)


def box_around(boxes: Iterable[Box], up: ArrayLike) -> Box:
    """Return the `upright_box` around the corners of one or more boxes."""
    corners = np.concatenate([box_corners(box) for box in boxes])
    return upright_box(corners.astype(np.float32), up)


@kernel
def _mean(points: F8) -> F8:
    """Return the mean of points (n, 3), faster than numpy, which is slow for three columns."""
    x = y = z = 0.0
    for i in range(points.shape[0]):
        x += points[i, 0]
        y += points[i, 1]
        z += points[i, 2]
    mean: F8 = np.array([x, y, z]) / points.shape[0]
    return mean


_YAWS = np.arange(60) * (np.pi / 120)
_COS, _SIN = np.cos(_YAWS).astype(np.float32), np.sin(_YAWS).astype(np.float32)


@kernel(fast=True, inner=True)
def _smallest_rectangle(x: F4, y: F4) -> tuple[float, F8, F8]:
    """Return the yaw (radians) of the smallest rectangle around points, and its corners.

    ``x`` and ``y`` (n,) are those of the points. The low and the high corner (3,) are in the axes
    of the rectangle, with z = 0. The inner loop is over the yaws, so that it vectorises.
    """
    n = _YAWS.size
    left, back = np.full(n, np.float32(np.inf)), np.full(n, np.float32(np.inf))
    right, front = np.full(n, np.float32(-np.inf)), np.full(n, np.float32(-np.inf))
    for k in range(x.size):
        for t in range(n):
            u, v = _COS[t] * x[k] + _SIN[t] * y[k], _COS[t] * y[k] - _SIN[t] * x[k]
            left[t], right[t] = u if u < left[t] else left[t], u if u > right[t] else right[t]
            back[t], front[t] = v if v < back[t] else back[t], v if v > front[t] else front[t]
    best, smallest_area = 0, np.float32(np.inf)
    for t in range(n):
        area = (right[t] - left[t]) * (front[t] - back[t])
        if area < smallest_area:
            best, smallest_area = t, area
    low, high = np.zeros(3), np.zeros(3)
    low[0], low[1], high[0], high[1] = left[best], back[best], right[best], front[best]
    return _YAWS[best], low, high
