"""Moving least squares: points move onto a surface fitted to their neighbourhood."""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.config import SurfaceSettings
from shapecat.geometry import cross
from shapecat.jit import kernel
from shapecat.surface.voxels import read_only, voxelize

__all__ = ["smooth", "thin"]

_MOST_CELLS = 1 << 20
"""Maximum number of cells along an axis: three indices fit in 63 bits."""
_FEWEST_PLANE, _FEWEST_QUADRIC = 4, 9
"""Minimum numbers of neighbours, including the point itself, for a plane and for a quadric: a few
more than their unknowns."""
_RIDGE = 1e-4
"""Ridge penalty on the coefficients of the quadric, relative to the weight of the neighbours."""
_SQUARINGS = 6
"""Number of squarings in `_least_direction`."""


def thin(points: F4, *, settings: SurfaceSettings) -> F4:
    """Thin the points of an object for the gas: return (m, 3) metres, at most one per voxel.

    The points of each voxel are averaged, and the averages are smoothed (differs: the thesis
    smooths the whole cloud before thinning). Smoothing the thinned points of an object takes a
    hundredth of the time, and removes the noise that the averages leave.

    Parameters
    ----------
    points : (n, 3) metres, finite, in any frame.
    settings : ``voxel_m`` and ``smooth_radius_m`` are used; a radius of 0 means no smoothing.

    Raises
    ------
    ValueError : as for `voxelize` and `smooth`.
    """
    cloud = voxelize(points, voxel_m=settings.voxel_m)
    radius = settings.smooth_radius_m
    return smooth(cloud, radius_m=radius) if radius > 0 else cloud


def smooth(points: F4, *, radius_m: float) -> F4:
    """Move each point onto a quadric fitted to the points around it.

    For the neighbours p_i of a point p within the radius h, weighted by
    ``w_i = exp(-|p_i - p|**2 / (h / 2)**2)``:

    1. fit a plane through their weighted mean; its normal n is the direction of least weighted
       variance, and q is the projection of p onto the plane;
    2. fit the polynomial g of degree 2 over the plane, with origin q, that minimises
       ``sum_i w_i (n . (p_i - q) - g(u_i, v_i))**2``;
    3. move p to ``q + g(0, 0) n``.

    Parameters
    ----------
    points : (n, 3) metres, finite, in any frame.
    radius_m : h, metres. Smaller detail is lost; three to five spacings of the points are usual.

    Returns
    -------
    (m, 3) the moved points, in their order. With 4 to 8 points within the radius, or if
    ``|g(0, 0)|`` is h or more, only the plane is used. Points with fewer than 4 are dropped, since
    they belong to no surface.

    Raises
    ------
    ValueError : the points are not (n, 3) or not finite, the radius is not positive, or the cloud
        spans 2**20 radii or more.

    Notes
    -----
    Time grows with the number of points times the number of neighbours. Sources: Levin 2003; Alexa
    et al. 2003, section 3; thesis 4.2.
    """
    points = read_only(points)
    if not radius_m > 0:
        msg = f"radius_m must be positive, got {radius_m}"
        raise ValueError(msg)
    if len(points) == 0:
        return points
    cells = (np.ptp(points.astype(np.float64), axis=0) / radius_m).max()
    if not cells < _MOST_CELLS:
        msg = f"points must be finite and within 2**20 times {radius_m} m of each other"
        raise ValueError(msg)
    cells, size = _cells(points, radius_m)
    moved: F4 = _smooth(points, float(radius_m), cells, size, np.argsort(cells, kind="stable"))
    return moved


def _cells(points: F4, radius: float) -> tuple[I4, I4]:
    """Return the cell (n,) of each point in a grid of spacing ``radius``, and the grid's size (3,).

    Cells are numbered with z fastest. The grid has an empty border, so that the cells with the next
    lower and the next higher number are always neighbours along z. ``points`` (n, 3) and ``radius``
    are in metres.
    """
    place = ((points - points.min(axis=0).astype(np.float64)) / radius).astype(np.int64) + 1
    size = place.max(axis=0) + 2
    return (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2], size


@kernel
def _smooth(points: F4, radius: float, cells: I4, size: I4, order: I4) -> F4:
    """Return the moved points (m, 3), metres; ``points`` and ``radius`` are as in `smooth`.

    ``cells`` (n,) and ``size`` (3,) are from `_cells`; ``order`` (n,) sorts the points by cell.
    """
    count = points.shape[0]
    keys = cells[order]
    moved = np.zeros((count, 3), np.float32)
    offsets = np.zeros((count, 4))  # of the neighbours from the point, in radii; and weights
    n = 0
    for i in range(count):
        k = _neighbours(points, i, radius, cells[i], size, keys, order, offsets)
        if k < _FEWEST_PLANE:
            continue
        # 1.
        normal, height = _plane(offsets, k)
        # 2.
        bend = _quadric(offsets, k, normal, height) if k >= _FEWEST_QUADRIC else 0.0
        # 3. differs: a fit that leaves the neighbourhood is ignored
        height += bend if abs(bend) < 1.0 else 0.0
        for axis in range(3):
            moved[n, axis] = points[i, axis] + height * radius * normal[axis]
        n += 1
    return moved[:n].copy()


@kernel(inline=True)
def _neighbours(
    points: F4, i: int, radius: float, cell: int, size: I4, keys: I4, order: I4, offsets: F8
) -> int:
    """Write the neighbours of point i, itself included, to ``offsets``; return their number.

    A row of ``offsets`` (n, 4) is the offset of a neighbour from the point, in radii, and the
    weight of the neighbour. ``cell`` is the cell of point i, ``keys`` (n,) are the cells of all
    points, sorted; the other parameters are as in `_smooth`.
    """
    n = 0
    for side in range(9):
        middle = cell + ((side // 3 - 1) * size[1] + side % 3 - 1) * size[2]
        at = np.searchsorted(keys, middle - 1)
        while at < keys.size and keys[at] <= middle + 1:
            square = 0.0
            for axis in range(3):
                step = (np.float64(points[order[at], axis]) - points[i, axis]) / radius
                offsets[n, axis] = step
                square += step * step
            offsets[n, 3] = np.exp(-4.0 * square)
            n += 1 if square < 1.0 else 0
            at += 1
    return n


@kernel(inline=True)
def _plane(offsets: F8, n: int) -> tuple[F8, float]:
    """Return the plane fitted to weighted points: normal (3,), and height above the origin, radii.

    The height is along the normal. The points are the first ``n`` rows of ``offsets``, from
    `_neighbours`.
    """
    mean, spread = np.zeros(3), np.zeros((3, 3))
    total = 0.0
    for k in range(n):
        total += offsets[k, 3]
        for a in range(3):
            mean[a] += offsets[k, 3] * offsets[k, a]
    mean /= total
    for k in range(n):
        for a in range(3):
            for b in range(3):
                spread[a, b] += (
                    offsets[k, 3] * (offsets[k, a] - mean[a]) * (offsets[k, b] - mean[b])
                )
    normal = _least_direction(spread / total)
    return normal, normal[0] * mean[0] + normal[1] * mean[1] + normal[2] * mean[2]


@kernel(inline=True)
def _least_direction(spread: F8) -> F8:
    """Return the unit eigenvector of the smallest eigenvalue of a symmetric (3, 3) matrix.

    This vector belongs to the largest eigenvalue of the adjugate, whose powers converge to it. The
    diagonal of ``spread`` is changed in place.
    """
    power = np.zeros((3, 3))
    for a in range(3):
        spread[a, a] += 1e-12
    for a in range(3):
        i, j = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            k, m = (b + 1) % 3, (b + 2) % 3
            power[b, a] = spread[i, k] * spread[j, m] - spread[i, m] * spread[j, k]
    for _ in range(_SQUARINGS):
        power /= max(power[0, 0] + power[1, 1] + power[2, 2], 1e-300)
        square = np.zeros((3, 3))
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    square[a, b] += power[a, c] * power[c, b]
        power = square
    best = 0
    for a in range(1, 3):
        best = a if power[a, a] > power[best, best] else best
    length = np.sqrt((power[best] ** 2).sum())
    return power[best] / length if length > 0 else np.array([0.0, 0.0, 1.0])


@kernel(inline=True)
def _quadric(offsets: F8, n: int, normal: F8, height: float) -> float:
    """Return the height of the fitted quadric over the plane, at the projection of the origin.

    The result is in radii. ``normal`` and ``height`` are from `_plane`, the other parameters as
    there.
    """
    small = 0
    for axis in range(1, 3):
        small = axis if abs(normal[axis]) < abs(normal[small]) else small
    first = -normal[small] * normal
    first[small] += 1.0
    first /= np.sqrt((first**2).sum())
    second = cross(normal, first)
    A, row = np.zeros((6, 7)), np.ones(7)
    total = 0.0
    for k in range(n):
        x, y, z, weight = offsets[k]
        u = first[0] * x + first[1] * y + first[2] * z
        v = second[0] * x + second[1] * y + second[2] * z
        row[1], row[2], row[3], row[4], row[5] = u, v, u * u, u * v, v * v
        row[6] = normal[0] * x + normal[1] * y + normal[2] * z - height
        total += weight
        for a in range(6):
            for b in range(7):
                A[a, b] += weight * row[a] * row[b]
    for a in range(6):
        A[a, a] += _RIDGE * total  # keeps the fit to points on a line or two from running away
    # Gaussian elimination from the end: A is positive definite, and only unknown 0 is needed
    for a in range(5, 0, -1):
        for b in range(a):
            factor = A[b, a] / A[a, a]
            for c in range(7):
                A[b, c] -= factor * A[a, c]
    return float(A[0, 6] / A[0, 0])
