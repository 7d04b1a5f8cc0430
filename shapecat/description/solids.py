"""A box and a ball fitted to the points: how well each fits, and where it does not."""

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.description.linear import solve
from shapecat.description.ranges import inner_range
from shapecat.jit import kernel

__all__ = ["SOLID_NAMES", "solids"]

SOLID_NAMES = (
    "box_sides",  # mean distance of steep surface from the nearer side / horizontal size
    "box_faces",  # mean distance of the points from the nearest visible face / size
    "box_narrow_to_wide",  # shorter / longer horizontal length
    "box_height",  # height / (height + horizontal size)
    "corner_upright",  # gap at the upright edge between the sides: 0 if points reach it, up to 1
    "corner_level_1",  # the same for the edges between top and sides, the smaller gap first
    "corner_level_2",
    "share_side_1",  # fraction of the points nearest to a face; side 1 has more than side 2
    "share_side_2",
    "share_top",
    "off_side_1",  # their mean distance from that face / size
    "off_side_2",
    "off_top",
    "box_to_revolution",  # log-ratio of box_faces to the residual of the solid of revolution
    "box_to_upright",  # log-ratio of box_sides to the residual of the upright one
    "ball_residual",  # mean distance of the points from the ball / radius
    "ball_radius",  # radius / (radius + height of the object)
    "ball_height",  # height of the centre: 0 at the bottom of the object, 1 at its top
    "ball_to_box",  # log-ratio of ball_residual to box_faces
)
"""The features of a box and a ball; sizes of the box are root mean squares of its lengths."""
_YAWS = 36
"""Number of yaws tried, 2.5 degrees apart."""


@kernel
def solids(
    cloud: F4,
    owner: I4,
    x: F4,
    y: F4,
    normals: F4,
    eye: F4,
    low: float,
    high: float,
    revolved: F4,
    out: F4,
) -> None:
    """Write the features named by `SOLID_NAMES`.

    Lengths are in units of the mean distance between neurons.

    Parameters
    ----------
    cloud : (3, n) points.
    owner : (n,) the nearest neuron of each point.
    x, y : (k,) positions of the neurons.
    normals : (3, k) unit vectors.
    eye : (3,) position of the sensor.
    low, high : 2nd and 98th percentiles of the heights of the points.
    revolved : the block ``revolution``, already written.
    out : the block ``solids`` of the descriptor, written in place.
    """
    u, v = _box_frame(cloud, x, y, normals, eye)
    _box(u, v, cloud[2], owner, normals, low, high, out[:13])
    out[13] = _log_ratio(out[1], revolved[2])
    out[14] = _log_ratio(out[0], revolved[0])
    _ball(cloud, low, high, out[15:18])
    out[18] = _log_ratio(out[15], out[1])


@kernel(inner=True)
def _log_ratio(a: float, b: float) -> float:
    """Return the logarithm of the ratio of two residuals; those far below 0.001 count as equal."""
    return float(np.log((a + 1e-3) / (b + 1e-3)))


@kernel(inline=True)
def _box_frame(cloud: F4, x: F4, y: F4, normals: F4, eye: F4) -> tuple[F4, F4]:
    """Return the points' coordinates (n,) along both horizontal axes of the best upright box.

    Both axes point towards the sensor. The parameters are as in `solids`. The fit minimises the sum
    of the neurons' distances from the nearer of the two visible walls, weighted by how vertical the
    surface is (Zhang et al. 2017, "L-shape fitting", the closeness criterion).
    """
    u, v = np.zeros(x.size, np.float32), np.zeros(x.size, np.float32)
    start = np.arctan2(eye[1], eye[0])  # so that the result turns with the scene
    one, zero = np.float32(1.0), np.float32(0.0)
    best, turn = np.inf, (one, zero, one, one)
    for k in range(_YAWS):
        angle = start + k * (0.5 * np.pi / _YAWS)
        c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        toward_u = np.float32(1.0 if c * eye[0] + s * eye[1] >= 0 else -1.0)
        toward_v = np.float32(1.0 if c * eye[1] - s * eye[0] >= 0 else -1.0)
        for i in range(x.size):
            u[i] = toward_u * (c * x[i] + s * y[i])
            v[i] = toward_v * (c * y[i] - s * x[i])
        wall_u, wall_v = inner_range(u)[1], inner_range(v)[1]
        cost = 0.0
        for i in range(x.size):
            side = 1.0 - normals[2, i] * normals[2, i]
            cost += side * min(abs(wall_u - u[i]), abs(wall_v - v[i]))
        if cost < best:
            best, turn = cost, (c, s, toward_u, toward_v)
    c, s, toward_u, toward_v = turn
    count = cloud.shape[1]
    u, v = np.zeros(count, np.float32), np.zeros(count, np.float32)
    for i in range(count):
        u[i] = toward_u * (c * cloud[0, i] + s * cloud[1, i])
        v[i] = toward_v * (c * cloud[1, i] - s * cloud[0, i])
    return u, v


@kernel(inline=True)
def _box(u: F4, v: F4, z: F4, owner: I4, normals: F4, low: float, high: float, out: F4) -> None:
    """Compare the points with the three faces of a box that the sensor can see.

    ``u`` and ``v`` (n,) are from `_box_frame`, ``z`` (n,) is the height; the other parameters are
    as in `solids`. Writes the first 13 features of `SOLID_NAMES` to ``out``.
    """
    count = u.size
    low_u, high_u = inner_range(u)
    low_v, high_v = inner_range(v)
    long_u, long_v = max(high_u - low_u, 1e-3), max(high_v - low_v, 1e-3)
    tall = max(high - low, 1e-3)
    flat = np.sqrt((long_u * long_u + long_v * long_v) / 2)
    size = np.sqrt((long_u * long_u + long_v * long_v + tall * tall) / 3)
    corners = np.zeros((3, count), np.float32)
    on_face, off = np.zeros(3), np.zeros(3)
    sides = total = 0.0
    for i in range(count):
        du, dv, dz = abs(high_u - u[i]), abs(high_v - v[i]), abs(high - z[i])
        up = normals[2, owner[i]]
        total += 1.0 - up * up
        sides += (1.0 - up * up) * min(du, dv)
        face = 2 if dz <= du and dz <= dv else (0 if du <= dv else 1)
        on_face[face] += 1
        off[face] += min(du, dv, dz)
        # 0 on the edge where two faces meet, 1 on the opposite edges
        corners[0, i] = max(du / long_u, dv / long_v)
        corners[1, i] = max(du / long_u, dz / tall)
        corners[2, i] = max(dv / long_v, dz / tall)
    out[0] = sides / max(total, 1e-6) / flat
    out[1] = (off[0] + off[1] + off[2]) / count / size
    out[2] = min(long_u, long_v) / max(long_u, long_v)
    out[3] = tall / (tall + flat)
    out[4] = inner_range(corners[0])[0]
    first, second = inner_range(corners[1])[0], inner_range(corners[2])[0]
    out[5], out[6] = min(first, second), max(first, second)
    a = 0 if on_face[0] >= on_face[1] else 1
    for k in range(3):
        face = 2 if k == 2 else (a if k == 0 else 1 - a)
        out[7 + k] = on_face[face] / count
        out[10 + k] = off[face] / max(on_face[face], 1.0) / size


@kernel(inline=True)
def _ball(cloud: F4, low: float, high: float, out: F4) -> None:
    """Compare the points with the ball fitted to them by least squares.

    The parameters are as in `solids`. Writes the features ``ball_residual``, ``ball_radius`` and
    ``ball_height`` to ``out``.
    """
    A, b = np.zeros((4, 4)), np.zeros(4)
    row = np.zeros(4)
    row[3] = 1.0
    for i in range(cloud.shape[1]):
        square = 0.0
        for j in range(3):
            row[j] = cloud[j, i]
            square += row[j] * row[j]
        for j in range(4):
            b[j] += row[j] * square
            for k in range(4):
                A[j, k] += row[j] * row[k]
    for j in range(4):
        A[j, j] += 1e-3 * cloud.shape[1]
    solve(A, b)
    middle = np.zeros(3)
    squared = b[3]
    for j in range(3):
        middle[j] = b[j] / 2
        squared += middle[j] * middle[j]
    radius = np.sqrt(max(squared, 1e-6))
    cost = 0.0
    for i in range(cloud.shape[1]):
        square = 0.0
        for j in range(3):
            square += (cloud[j, i] - middle[j]) ** 2
        cost += min(abs(np.sqrt(square) - radius), radius)
    out[0] = min(cost / cloud.shape[1] / radius, 2.0)
    out[1] = radius / (radius + high - low)
    out[2] = min(max((middle[2] - low) / max(high - low, 1e-3), -3.0), 3.0)
