"""The axis about which the surface turns best, upright or not, and the profile along it."""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.jit import kernel

__all__ = ["REVOLUTION_NAMES", "REVOLUTION_SLICES", "revolution", "rotation_axis"]

REVOLUTION_SLICES = 6
_SLICE = ("share", "radius", "inward", "along")
REVOLUTION_NAMES = (
    "residual_1",
    "residual_2",
    "residual_3",
    "axis_vertical",
    "radius_to_length",
    "radius_spread",
    "radius_slope",
    "inward",
    *(f"{i}_{name}" for i in range(REVOLUTION_SLICES) for name in _SLICE),
)


@kernel
def rotation_axis(x: F4, y: F4, z: F4, weight: F4, normals: F4) -> tuple[F8, F8, F8]:
    """Find the line that the normals of the surface meet best.

    Source: Pottmann and Randrup 1998, for rotations alone. The line with direction a and moment b
    meets the normal n at the point p when ``n . b + (p x n) . a`` is 0; the sum of its squares is
    minimal over unit a, with b eliminated.

    Returns
    -------
    A unit direction, a point, and (3,) the root mean squares along the three principal
    directions of a, ascending: all small for a sphere, one for a cylinder.
    """
    N, B, C = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(x.size):
        a, b, c = np.float64(normals[0, i]), np.float64(normals[1, i]), np.float64(normals[2, i])
        n = (a, b, c)
        m = (y[i] * c - z[i] * b, z[i] * a - x[i] * c, x[i] * b - y[i] * a)
        for j in range(3):
            for k in range(3):
                N[j, k] += weight[i] * n[j] * n[k]
                B[j, k] += weight[i] * n[j] * m[k]
                C[j, k] += weight[i] * m[j] * m[k]
    for j in range(3):
        N[j, j] += 1e-2  # where the normals do not tell, the axis passes near the middle
    _invert(N)
    # b = -N^-1 B a leaves a . (C - B^T N^-1 B) a to minimise.
    moment = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                moment[i, j] -= N[i, k] * B[k, j]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                C[i, j] += B[k, i] * moment[k, j]
    values, vectors = np.linalg.eigh(C)
    axis, foot, rest = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(3):
        axis[i] = vectors[i, 0]
        for j in range(3):
            foot[i] += moment[i, j] * vectors[j, 0]
        rest[i] = np.sqrt(max(values[i], 0.0))
    point = np.zeros(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        point[i] = axis[j] * foot[k] - axis[k] * foot[j]
    return axis, point, rest


@kernel
def _invert(A: F8) -> None:
    """Invert a symmetric positive definite (3, 3) matrix in place."""
    xx, xy, xz = A[0, 0], A[0, 1], A[0, 2]
    yy, yz, zz = A[1, 1], A[1, 2], A[2, 2]
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * a + xy * b + xz * c
    A[0, 0] = a / det
    A[0, 1] = A[1, 0] = b / det
    A[0, 2] = A[2, 0] = c / det
    A[1, 1] = (xx * zz - xz * xz) / det
    A[1, 2] = A[2, 1] = (xy * xz - xx * yz) / det
    A[2, 2] = (xx * yy - xy * xy) / det


@kernel
def revolution(x: F4, y: F4, z: F4, weight: F4, normals: F4, out: F4) -> None:
    """Write the numbers named by `REVOLUTION_NAMES`; lengths in units of the object's size.

    The axis points to the narrow end: of each slice along it the share of the points, the mean
    radius over the largest, the share facing the axis, and the mean of normal times axis.
    """
    axis, point, residual = rotation_axis(x, y, z, weight, normals)
    out[0], out[1], out[2] = residual[0], residual[1], residual[2]
    out[3] = abs(axis[2])
    count = x.size
    t = np.zeros(count)
    r = np.zeros(count)
    inward = np.zeros(count)
    mean_t = mean_r = 0.0
    for i in range(count):
        dx, dy, dz = x[i] - point[0], y[i] - point[1], z[i] - point[2]
        t[i] = dx * axis[0] + dy * axis[1] + dz * axis[2]
        dx, dy, dz = dx - t[i] * axis[0], dy - t[i] * axis[1], dz - t[i] * axis[2]
        r[i] = np.sqrt(dx * dx + dy * dy + dz * dz)
        if dx * normals[0, i] + dy * normals[1, i] + dz * normals[2, i] < -0.3 * r[i]:
            inward[i] = 1.0
        mean_t += weight[i] * t[i]
        mean_r += weight[i] * r[i]
    slope = spread_t = spread_r = 0.0
    for i in range(count):
        slope += weight[i] * (t[i] - mean_t) * (r[i] - mean_r)
        spread_t += weight[i] * (t[i] - mean_t) ** 2
        spread_r += weight[i] * (r[i] - mean_r) ** 2
        out[7] += weight[i] * inward[i]
    low, high = t.min(), t.max()
    out[4] = mean_r / (mean_r + high - low) if mean_r + high - low > 0 else 0.5
    out[5] = np.sqrt(spread_r) / max(mean_r, 1e-6)
    out[6] = -abs(slope) / max(spread_t, 1e-4)
    turn = 1.0 if slope <= 0 else -1.0
    for i in range(count):
        level = (t[i] - low) / (high - low) if high > low else 0.5
        level = level if turn > 0 else 1.0 - level
        place = min(max(level * REVOLUTION_SLICES - 0.5, 0.0), REVOLUTION_SLICES - 1.0)
        first = min(int(place), REVOLUTION_SLICES - 2)
        up = normals[0, i] * axis[0] + normals[1, i] * axis[1] + normals[2, i] * axis[2]
        for k in range(2):
            share = weight[i] * (place - first if k == 1 else first + 1 - place)
            at = 8 + (first + k) * 4
            out[at] += share
            out[at + 1] += share * r[i]
            out[at + 2] += share * inward[i]
            out[at + 3] += share * up * turn
    widest = 1e-6
    for k in range(REVOLUTION_SLICES):
        at = 8 + k * 4
        for m in range(1, 4):
            out[at + m] = out[at + m] / out[at] if out[at] > 1e-4 else 0.0
        widest = max(widest, out[at + 1])
    for k in range(REVOLUTION_SLICES):
        out[8 + k * 4 + 1] /= widest
