"""The axis about which an object is most nearly a surface of revolution."""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.description.linear import principal_axes
from shapecat.jit import kernel

__all__ = ["rotation_axis"]


@kernel
def rotation_axis(x: F4, y: F4, z: F4, weight: F4, normals: F4) -> tuple[F8, F8]:
    """Find the line that comes closest to meeting all normals of a surface.

    Source: Pottmann and Randrup 1998, restricted to rotations. A line with direction a and moment
    b meets the normal n at the point p if ``n . b + (p x n) . a`` is 0. The weighted sum of
    squares of this term is minimised over unit vectors a, with b eliminated.

    Parameters
    ----------
    x, y, z : (n,) positions of the neurons, in any unit of length.
    weight : (n,) each neuron's fraction of the points.
    normals : (3, n) unit vectors.

    Returns
    -------
    The unit direction (3,), and a point (3,) on the line.
    """
    N, B, C = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(x.size):
        a, b, c = (np.float64(normals[0, i]), np.float64(normals[1, i]), np.float64(normals[2, i]))
        n = (a, b, c)
        m = (y[i] * c - z[i] * b, z[i] * a - x[i] * c, x[i] * b - y[i] * a)
        for j in range(3):
            for k in range(3):
                N[j, k] += weight[i] * n[j] * n[k]
                B[j, k] += weight[i] * n[j] * m[k]
                C[j, k] += weight[i] * m[j] * m[k]
    for j in range(3):
        N[j, j] += 1e-2  # if the normals do not determine it, the axis passes near the origin
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
    _, vectors = principal_axes(C)
    axis, foot = np.zeros(3), np.zeros(3)
    for i in range(3):
        axis[i] = vectors[i, 0]
        for j in range(3):
            foot[i] += moment[i, j] * vectors[j, 0]
    point = np.zeros(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        point[i] = axis[j] * foot[k] - axis[k] * foot[j]
    return axis, point


@kernel(inline=True)
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
