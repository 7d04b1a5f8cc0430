"""Normals and principal curvatures of the surface at each neuron, from the nearby points."""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.jit import kernel

__all__ = ["assign", "fit_surfaces"]

_RIDGE = 1e-3
"""Ridge penalty on the coefficients of the quadric, per point of the neighbourhood."""


@kernel(fast=True)
def assign(points: F4, x: F4, y: F4, z: F4, max_distance: float) -> tuple[F4, I4]:
    """Sort points by their nearest neuron.

    Parameters
    ----------
    points : (3, n) coordinates.
    x, y, z : (k,) positions of the neurons.
    max_distance : largest distance of a point from its neuron, in the same unit. Farther points are
        dropped: they belong to a part of the object that the graph does not cover.

    Returns
    -------
    (3, m) the sorted points, and (k + 1,) the index at which the points of each neuron begin, with
    m at the end.
    """
    total, count = points.shape[1], x.size
    mask = np.int32(1)
    while mask < count:
        mask = np.int32(mask << 1)
    mask = np.int32(mask - 1)
    keep = np.int32(~mask)
    lane = np.arange(count).astype(np.int32)
    limit = np.float32(max_distance * max_distance)
    nearest = np.zeros(total, np.int32)
    starts = np.zeros(count + 1, np.int64)
    for k in range(total):
        px, py, pz = points[0, k], points[1, k], points[2, k]
        best = np.int32(0x7FFFFFFF)
        for i in range(count):
            dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
            # squared distance with the index in its lowest bits; positive floats order as integers
            bits = np.float32(dx * dx + dy * dy + dz * dz).view(np.int32)
            key = np.int32((bits & keep) | lane[i])
            best = key if key < best else best
        winner = np.int64(best & mask)
        dx, dy, dz = x[winner] - px, y[winner] - py, z[winner] - pz
        if dx * dx + dy * dy + dz * dz <= limit:
            nearest[k] = winner
            starts[winner + 1] += 1
        else:
            nearest[k] = -1
    for i in range(count):
        starts[i + 1] += starts[i]
    place = starts[:count].copy()
    result = np.zeros((3, starts[count]), np.float32)
    for k in range(total):
        if nearest[k] >= 0:
            slot = place[nearest[k]]
            place[nearest[k]] += 1
            result[0, slot] = points[0, k]
            result[1, slot] = points[1, k]
            result[2, slot] = points[2, k]
    return result, starts


@kernel(fast=True)
def fit_surfaces(
    points: F4, starts: I4, x: F4, y: F4, z: F4, euclidean: F4, radius: float, eye: F4
) -> tuple[F4, F4]:
    """Fit a quadric around each neuron.

    The neighbourhood is all points within a radius of the neuron. A full quadric is fitted to the
    heights of these points along the normal of their least-squares plane (ridge regression). The
    curvatures follow from the first and second fundamental forms.

    Parameters
    ----------
    points, starts : (3, n) points sorted by neuron, and (k + 1,) the index at which the points of
        each neuron begin, from `assign`.
    x, y, z : (k,) positions of the neurons.
    euclidean : (k, k) Euclidean distances between the neurons.
    radius : radius of the neighbourhoods, in the unit of the positions.
    eye : (3,) position of the sensor, in the frame of the points.

    Returns
    -------
    normals : (3, k) unit vectors that point to the sensor's side.
    curvatures : (2, k) largest and smallest principal curvature, 1 / length; positive where the
        surface bulges towards the sensor. They are clipped to ±``4 / radius``, the most that a
        neighbourhood can show, and 0 if it has fewer than 6 points.
    """
    count, total = x.size, points.shape[1]
    normals = np.zeros((3, count), np.float32)
    curvatures = np.zeros((2, count), np.float32)
    cell_radius = np.zeros(count, np.float32)
    for i in range(count):
        for k in range(starts[i], starts[i + 1]):
            dx, dy, dz = points[0, k] - x[i], points[1, k] - y[i], points[2, k] - z[i]
            squared = dx * dx + dy * dy + dz * dz
            cell_radius[i] = squared if squared > cell_radius[i] else cell_radius[i]
    for i in range(count):
        cell_radius[i] = np.sqrt(cell_radius[i])
    u = np.zeros(total, np.float32)
    v = np.zeros(total, np.float32)
    w = np.zeros(total, np.float32)
    scale = np.float32(1.0 / radius)
    zero, one = np.uint64(0), np.uint64(1)
    for i in range(count):
        px, py, pz = x[i], y[i], z[i]
        written = zero  # unsigned: no check for negative indices
        for j in range(count):
            if euclidean[i, j] >= radius + cell_radius[j]:
                continue
            for k in range(np.uint64(starts[j]), np.uint64(starts[j + 1])):
                du = (points[0, k] - px) * scale
                dv = (points[1, k] - py) * scale
                dw = (points[2, k] - pz) * scale
                u[written], v[written], w[written] = du, dv, dw
                written += one if du * du + dv * dv + dw * dw < np.float32(1) else zero
        n = np.int64(written)
        ex, ey, ez = eye[0] - x[i], eye[1] - y[i], eye[2] - z[i]
        a, b, c = _normal(u, v, w, n, ex, ey, ez)
        first, second = np.float32(0), np.float32(0)
        if n >= 6:
            first, second, a, b, c = _quadric(u, v, w, n, a, b, c)
        if a * ex + b * ey + c * ez < 0:
            a, b, c, first, second = -a, -b, -c, -second, -first
        normals[0, i], normals[1, i], normals[2, i] = a, b, c
        curvatures[0, i], curvatures[1, i] = first * scale, second * scale
    return normals, curvatures


@kernel(fast=True, inline=True)
def _normal(
    u: F4, v: F4, w: F4, n_points: int, ex: float, ey: float, ez: float
) -> tuple[float, float, float]:
    """Return the unit direction of smallest variance of the points; its sign is arbitrary.

    If it is undefined, return the direction to the sensor, (ex, ey, ez), or, if the points are on a
    line, the component of that direction perpendicular to the line. The first ``n_points`` elements
    of ``u``, ``v`` and ``w`` are the offsets of the points from the neuron, in radii.
    """
    su = sv = sw = suu = suv = suw = svv = svw = sww = np.float32(0)
    for k in range(n_points):
        a, b, c = u[k], v[k], w[k]
        su += a
        sv += b
        sw += c
        suu += a * a
        suv += a * b
        suw += a * c
        svv += b * b
        svw += b * c
        sww += c * c
    n = max(n_points, 1)
    xx, xy, xz = suu / n - su * su / n / n, suv / n - su * sv / n / n, suw / n - su * sw / n / n
    yy, yz, zz = svv / n - sv * sv / n / n, svw / n - sv * sw / n / n, sww / n - sw * sw / n / n
    # Smallest eigenvalue of a symmetric 3x3 matrix in closed form (Smith 1961).
    mean = (xx + yy + zz) / 3
    off = xy * xy + xz * xz + yz * yz
    p = np.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6)
    if p > 1e-9:
        bx, by, bz = (xx - mean) / p, (yy - mean) / p, (zz - mean) / p
        cxy, cxz, cyz = xy / p, xz / p, yz / p
        det = (
            bx * (by * bz - cyz * cyz) - cxy * (cxy * bz - cyz * cxz) + cxz * (cxy * cyz - by * cxz)
        )
        half = min(1.0, max(-1.0, det / 2))
        smallest = mean + 2 * p * np.cos(np.arccos(half) / 3 + 2 * np.pi / 3)
        # Its eigenvector is the longest cross product of two rows of matrix - smallest * identity.
        xx, yy, zz = (xx - smallest) / p, (yy - smallest) / p, (zz - smallest) / p
        xy, xz, yz = cxy, cxz, cyz
        a1, b1, c1 = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
        a2, b2, c2 = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz
        a3, b3, c3 = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
        l1, l2 = a1 * a1 + b1 * b1 + c1 * c1, a2 * a2 + b2 * b2 + c2 * c2
        l3 = a3 * a3 + b3 * b3 + c3 * c3
        if l2 > l1 and l2 >= l3:
            a1, b1, c1, l1 = a2, b2, c2, l2
        elif l3 > l1:
            a1, b1, c1, l1 = a3, b3, c3, l3
        if l1 > 1e-6:
            length = np.sqrt(l1)
            return a1 / length, b1 / length, c1 / length
        # Points on a line: the normal is the line of sight's component perpendicular to it.
        if xx + yy + zz > 0:
            lx, ly, lz = xx, xy, xz
            if yy > xx and yy >= zz:
                lx, ly, lz = xy, yy, yz
            elif zz > xx:
                lx, ly, lz = xz, yz, zz
            along = (ex * lx + ey * ly + ez * lz) / max(lx * lx + ly * ly + lz * lz, 1e-12)
            ax, ay, az = ex - along * lx, ey - along * ly, ez - along * lz
            if ax * ax + ay * ay + az * az > 1e-6 * (ex * ex + ey * ey + ez * ez):
                ex, ey, ez = ax, ay, az
    length = np.sqrt(ex * ex + ey * ey + ez * ez)
    if length > 0:
        return ex / length, ey / length, ez / length
    return 0.0, 0.0, 1.0


@kernel(fast=True, inline=True)
def _quadric(
    u: F4, v: F4, w: F4, n_points: int, a: float, b: float, c: float
) -> tuple[float, float, float, float, float]:
    """Return both principal curvatures, largest first, and the normal (x, y, z), at the neuron.

    Curvatures are in 1 / radii, from -4 to 4, and positive where the surface bends away from the
    normal. (a, b, c) is the normal from `_normal`; the other parameters are as there.
    """
    # Tangent vectors without a branch on the direction (Duff et al. 2017).
    sign = 1.0 if c >= 0 else -1.0
    d = -1.0 / (sign + c)
    e = a * b * d
    t1x, t1y, t1z = np.float32(1 + sign * a * a * d), np.float32(sign * e), np.float32(-sign * a)
    t2x, t2y, t2z = np.float32(e), np.float32(sign + b * b * d), np.float32(-b)
    nx, ny, nz = np.float32(a), np.float32(b), np.float32(c)
    m10 = m01 = m20 = m11 = m02 = m30 = m21 = m12 = m03 = np.float32(0)
    m40 = m31 = m22 = m13 = m04 = np.float32(0)
    h00 = h10 = h01 = h20 = h11 = h02 = np.float32(0)
    for k in range(n_points):
        p = t1x * u[k] + t1y * v[k] + t1z * w[k]
        q = t2x * u[k] + t2y * v[k] + t2z * w[k]
        h = nx * u[k] + ny * v[k] + nz * w[k]
        pp, pq, qq = p * p, p * q, q * q
        m10 += p
        m01 += q
        m20 += pp
        m11 += pq
        m02 += qq
        m30 += pp * p
        m21 += pp * q
        m12 += qq * p
        m03 += qq * q
        m40 += pp * pp
        m31 += pp * pq
        m22 += pp * qq
        m13 += pq * qq
        m04 += qq * qq
        h00 += h
        h10 += h * p
        h01 += h * q
        h20 += h * pp
        h11 += h * pq
        h02 += h * qq
    # Normal equations of h = c0 + c1 p + c2 q + c3 p^2 + c4 pq + c5 q^2. The ridge on c4 is half
    # the others, as c3^2 + c4^2/2 + c5^2 does not depend on the choice of tangents.
    n = np.float64(n_points)
    ridge = _RIDGE * n
    A = np.zeros((6, 7))
    A[0, 0] = n + ridge
    A[1, 0], A[1, 1] = m10, m20 + ridge
    A[2, 0], A[2, 1], A[2, 2] = m01, m11, m02 + ridge
    A[3, 0], A[3, 1], A[3, 2], A[3, 3] = m20, m30, m21, m40 + ridge
    A[4, 0], A[4, 1], A[4, 2], A[4, 3], A[4, 4] = m11, m21, m12, m31, m22 + ridge / 2
    A[5, 0], A[5, 1], A[5, 2], A[5, 3], A[5, 4] = m02, m12, m03, m22, m13
    A[5, 5] = m04 + ridge
    A[0, 6], A[1, 6], A[2, 6], A[3, 6], A[4, 6], A[5, 6] = h00, h10, h01, h20, h11, h02
    _solve(A)
    p, q, r, s, t = A[1, 6], A[2, 6], 2 * A[3, 6], A[4, 6], 2 * A[5, 6]
    # Fundamental forms of a height function; curvature is positive away from the normal.
    root = np.sqrt(1 + p * p + q * q)
    E, F, G = 1 + p * p, p * q, 1 + q * q
    L, M, N = -r / root, -s / root, -t / root
    mean = (E * N - 2 * F * M + G * L) / (2 * root * root)
    gauss = (L * N - M * M) / (root * root)
    spread = np.sqrt(max(mean * mean - gauss, 0.0))
    first = min(4.0, max(-4.0, mean + spread))
    second = min(4.0, max(-4.0, mean - spread))
    return (
        first,
        second,
        (nx - p * t1x - q * t2x) / root,
        (ny - p * t1y - q * t2y) / root,
        (nz - p * t1z - q * t2z) / root,
    )


@kernel(fast=True, inline=True)
def _solve(A: F8) -> None:
    """Solve a positive definite system in place (Cholesky).

    ``A`` (n, n + 1) holds the lower half of the matrix, and the right side, which becomes the
    solution.
    """
    size = A.shape[0]
    for j in range(size):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k]
        A[j, j] = np.sqrt(A[j, j])
        for i in range(j + 1, size):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    for i in range(size):
        for k in range(i):
            A[i, size] -= A[i, k] * A[k, size]
        A[i, size] /= A[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            A[i, size] -= A[k, i] * A[k, size]
        A[i, size] /= A[i, i]
