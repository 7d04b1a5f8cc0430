"""Thinning a cloud to the centroids of a voxel grid."""

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel

__all__ = ["read_only", "voxelize"]

_FRACTION_BITS = 16
"""Coordinates are summed as integers, in units of 2**-16 voxels, so that the order of the points
does not matter."""
_RADIX_BITS = 11
"""Number of bits of the keys that one pass of the radix sort compares."""
_LARGEST = np.int64(1 << 62)


def voxelize(points: F4, *, voxel_m: float) -> F4:
    """Average the points of each cubic voxel.

    The grid is anchored at the origin. Centroids are sorted by voxel (x slowest, z fastest), so
    the result depends on the set of points and not on their order, to the last bit. The time is
    linear in the number of points.

    Parameters
    ----------
    points : (n, 3) metres, finite.
    voxel_m : edge of a voxel, metres.

    Returns
    -------
    (m, 3) one centroid for each voxel that holds a point; m <= n.

    Raises
    ------
    ValueError : the points are not (n, 3) or not finite, the edge is not positive, or a point is
        2**19 voxels or more from the origin along an axis.

    Examples
    --------
    >>> voxelize(np.array([[0.25, 0, 0], [0.75, 0, 0], [1.5, 0, 0]], "f4"), voxel_m=1.0)
    array([[0.5, 0. , 0. ],
           [1.5, 0. , 0. ]], dtype=float32)
    """
    points = read_only(points)
    if not voxel_m > 0:
        msg = f"voxel_m must be positive, got {voxel_m}"
        raise ValueError(msg)
    centroids: F4
    centroids, valid = _voxelize(points, float(voxel_m))
    if not valid:
        msg = f"points must be finite and within 2**19 voxels of {voxel_m} m from the origin"
        raise ValueError(msg)
    return centroids


def read_only(points: F4) -> F4:
    """Return points (n, 3) as a read-only float32 array, so that kernels are compiled only once.

    Raises
    ------
    ValueError : the points are not (n, 3).
    """
    points = np.ascontiguousarray(points, np.float32).view()
    if points.ndim != 2 or points.shape[1] != 3:
        msg = f"expected points of shape (n, 3), got {points.shape}"
        raise ValueError(msg)
    points.flags.writeable = False
    return points


@kernel
def _voxelize(points: F4, voxel: float) -> tuple[F4, bool]:
    """Return the centroids (m, 3), and whether every point was finite and in range.

    The voxels of the points (n, 3) are ``voxel`` metres wide.
    """
    count = points.shape[0]
    scale = float(1 << _FRACTION_BITS) / voxel
    limit = float(1 << (19 + _FRACTION_BITS))
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    low[:], high[:] = _LARGEST, -_LARGEST
    fixed = np.zeros((count, 3), np.int64)
    for i in range(count):
        for axis in range(3):
            value = np.rint(points[i, axis] * scale)
            if not abs(value) < limit:  # also true for NaN
                return np.zeros((0, 3), np.float32), False
            fixed[i, axis] = np.int64(value)
            index = fixed[i, axis] >> _FRACTION_BITS
            low[axis] = min(low[axis], index)
            high[axis] = max(high[axis], index)
    if count == 0:
        return np.zeros((0, 3), np.float32), True
    # Neighbours in the input mostly share a voxel: sum such runs first, then sort the few runs.
    size_y, size_z = high[1] - low[1] + 1, high[2] - low[2] + 1
    keys = np.zeros(count, np.int64)
    sums = np.zeros((count, 4), np.int64)
    runs = 0
    for i in range(count):
        x = (fixed[i, 0] >> _FRACTION_BITS) - low[0]
        y = (fixed[i, 1] >> _FRACTION_BITS) - low[1]
        z = (fixed[i, 2] >> _FRACTION_BITS) - low[2]
        key = (x * size_y + y) * size_z + z
        if runs == 0 or key != keys[runs - 1]:
            keys[runs] = key
            runs += 1
        for axis in range(3):
            sums[runs - 1, axis] += fixed[i, axis]
        sums[runs - 1, 3] += 1
    order = _radix_order(keys[:runs], (high[0] - low[0] + 1) * size_y * size_z)
    result = np.zeros((runs, 3), np.float32)
    n = 0
    i = 0
    while i < runs:
        key = keys[order[i]]
        total_x = total_y = total_z = members = 0
        while i < runs and keys[order[i]] == key:
            run = order[i]
            total_x += sums[run, 0]
            total_y += sums[run, 1]
            total_z += sums[run, 2]
            members += sums[run, 3]
            i += 1
        result[n, 0] = total_x / members / scale
        result[n, 1] = total_y / members / scale
        result[n, 2] = total_z / members / scale
        n += 1
    return result[:n].copy(), True


@kernel(inline=True)
def _radix_order(keys: np.ndarray, bound: int) -> np.ndarray:
    """Return the stable order (n,) that sorts ``keys`` (n,), which are >= 0 and below ``bound``."""
    order = np.arange(keys.size)
    buffer = np.zeros(keys.size, np.int64)
    shift = 0
    while (bound - 1) >> shift > 0:
        starts = np.zeros((1 << _RADIX_BITS) + 1, np.int64)
        for i in range(keys.size):
            starts[((keys[i] >> shift) & ((1 << _RADIX_BITS) - 1)) + 1] += 1
        for digit in range(1 << _RADIX_BITS):
            starts[digit + 1] += starts[digit]
        for i in range(keys.size):
            digit = (keys[order[i]] >> shift) & ((1 << _RADIX_BITS) - 1)
            buffer[starts[digit]] = order[i]
            starts[digit] += 1
        order, buffer = buffer, order
        shift += _RADIX_BITS
    return order
