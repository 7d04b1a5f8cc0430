"""Solids of revolution fitted to an object, upright or tilted, and the profile along the axis."""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.description.linear import solve
from shapecat.description.surface import Surface
from shapecat.jit import kernel

__all__ = ["REVOLUTION_NAMES", "fit_axis", "revolution"]

_REVOLUTION_SLICES = 8
_SLICE = ("share", "radius", "residual", "inward")
REVOLUTION_NAMES = (
    "upright_residual",  # root mean square deviation of the radius in a slice / mean radius
    "upright_radius",  # radius / (radius + length)
    "residual",  # the same about the tilted axis, which all others describe
    "length",  # length / (length + radius)
    "axis_vertical",  # absolute cosine between the axis and up
    "axis_moved",  # absolute cosine between the axis and its first guess
    "axis_to_eye",  # cosine between the axis, towards the narrow end, and the way to the sensor
    *(f"{i}_{name}" for i in range(_REVOLUTION_SLICES) for name in _SLICE),
)
_ROUNDS = 4
"""Number of Gauss-Newton steps."""
_OUTLIER = 3.0
"""Huber threshold of the fit, in root mean square residuals."""
_DAMPING = 0.02
"""Damping of the steps, relative to the mean diagonal element of the normal matrix for shifts."""
_INWARD = -0.3
"""A point faces the axis if its normal has a smaller component than this away from the axis."""
_SHIFTS, _SHIFTS_AND_TILTS = np.int64(2), np.int64(4)  # numba compiles a version per literal


@kernel
def revolution(surface: Surface, normals: F4, axis: F8, point: F8, foot: F8, out: F4) -> None:
    """Write the features named by `REVOLUTION_NAMES`.

    Two solids of revolution are fitted to the neurons and measured on the points: one with a
    vertical axis, and one whose axis may tilt. The second is cut into slices, from its wide to its
    narrow end. The features of a slice are its fraction of the points, the mean radius and its
    standard deviation (relative to the largest mean radius), and the fraction of the points that
    face the axis.

    Parameters
    ----------
    normals : (3, k) from `fit_surfaces`.
    axis, point : (3,) first guess of the tilted axis, from `rotation_axis`; overwritten.
    foot : (3,) a point on the vertical axis, the first guess; overwritten.
    out : the block ``revolution`` of the descriptor, written in place.
    """
    cloud, owner, neurons = surface.points, surface.nearest, surface.neurons
    weight, eye = surface.weight, surface.eye
    slices = np.zeros((_REVOLUTION_SLICES, 4))
    upright, before = np.zeros(3), np.zeros(3)
    upright[2] = 1.0
    for j in range(3):
        before[j] = axis[j]
    fit_axis(neurons, weight, normals, upright, foot, _SHIFTS)
    rms, length, radius = _measure(cloud, owner, normals, upright, foot, slices)
    out[0] = min(rms / radius, 2.0)
    out[1] = radius / (radius + length)
    fit_axis(neurons, weight, normals, axis, point, _SHIFTS_AND_TILTS)
    rms, length, radius = _measure(cloud, owner, normals, axis, point, slices)
    out[2] = min(rms / radius, 2.0)
    out[3] = length / (length + radius)
    out[4] = abs(axis[2])
    out[5] = abs(axis[0] * before[0] + axis[1] * before[1] + axis[2] * before[2])
    lean = 0.0
    widest = 1e-6
    for k in range(_REVOLUTION_SLICES):
        lean += slices[k, 0] * (k - 0.5 * (_REVOLUTION_SLICES - 1)) * (slices[k, 1] - radius)
        widest = max(widest, slices[k, 1])
    distance = np.sqrt(eye[0] * eye[0] + eye[1] * eye[1] + eye[2] * eye[2])
    facing = (axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2]) / max(distance, 1e-6)
    out[6] = -facing if lean > 0 else facing
    for k in range(_REVOLUTION_SLICES):
        slice_id = _REVOLUTION_SLICES - 1 - k if lean > 0 else k
        at = 7 + 4 * k
        out[at], out[at + 1] = slices[slice_id, 0], slices[slice_id, 1] / widest
        out[at + 2], out[at + 3] = min(slices[slice_id, 2] / widest, 2.0), slices[slice_id, 3]


@kernel
def fit_axis(neurons: F4, weight: F4, normals: F4, axis: F8, point: F8, free: int) -> None:
    """Fit an axis such that the radius of the neurons is constant in each slice along it.

    Gauss-Newton steps reduce the deviations of the radii from the mean radius of their slice. The
    mean radii are eliminated from the unknowns (Golub and Pereyra 1973). Neurons whose normal is
    along the axis have no weight.

    Parameters
    ----------
    neurons, normals : (3, k) positions, in any unit of length, and unit vectors.
    weight : (k,) each neuron's fraction of the points.
    axis, point : (3,) direction and point of the first guess, overwritten by the result.
    free : 2 to shift the axis, 4 to tilt it as well.
    """
    limit = np.inf
    for _ in range(_ROUNDS):
        limit = _OUTLIER * _improve(neurons, weight, normals, axis, point, free, limit)


@kernel
def _perpendicular_axes(axis: F8) -> tuple[F8, F8]:
    """Return two unit vectors (3,) that form a right-handed frame with ``axis`` (3,)."""
    small = 0
    for j in range(1, 3):
        small = j if abs(axis[j]) < abs(axis[small]) else small
    first, second = np.zeros(3), np.zeros(3)
    length = np.sqrt(max(1.0 - axis[small] * axis[small], 1e-12))
    for j in range(3):
        first[j] = ((1.0 if j == small else 0.0) - axis[small] * axis[j]) / length
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        second[i] = axis[j] * first[k] - axis[k] * first[j]
    return first, second


@kernel
def _cylindrical_coordinates(
    cloud: F4, owner: I4, normals: F4, axis: F8, point: F8, first: F8, second: F8
) -> tuple[F8, F8]:
    """Return cylindrical coordinates (5, n) about the axis, and the range (2,) along it.

    The rows of the coordinates are the position along the axis, the radius, two components (along
    ``first`` and ``second``, from `_perpendicular_axes`) of the radial unit vector, and a weight,
    the fourth power of the sine of the angle between normal and axis. ``owner`` (n,) is the neuron
    of each point of ``cloud`` (3, n), ``normals`` (3, k) are those of the neurons. The axis has the
    unit direction ``axis`` and contains ``point``.
    """
    rows = np.zeros((5, cloud.shape[1]))
    extent = np.zeros(2)
    extent[0], extent[1] = np.inf, -np.inf
    for i in range(cloud.shape[1]):
        x, y, z = cloud[0, i] - point[0], cloud[1, i] - point[1], cloud[2, i] - point[2]
        along = x * axis[0] + y * axis[1] + z * axis[2]
        u = x * first[0] + y * first[1] + z * first[2]
        v = x * second[0] + y * second[1] + z * second[2]
        radius = np.sqrt(u * u + v * v)
        rows[0, i], rows[1, i] = along, radius
        rows[2, i], rows[3, i] = u / max(radius, 1e-6), v / max(radius, 1e-6)
        o = owner[i]
        cosine = normals[0, o] * axis[0] + normals[1, o] * axis[1] + normals[2, o] * axis[2]
        rows[4, i] = max(1.0 - cosine * cosine, 0.0) ** 2
        extent[0], extent[1] = min(extent[0], along), max(extent[1], along)
    return rows, extent


@kernel
def _slice(along: float, extent: F8) -> int:
    """Return the slice at a position ``along`` an axis; ``extent`` (2,) is the whole range."""
    share = (along - extent[0]) / max(extent[1] - extent[0], 1e-6)
    return min(int(share * _REVOLUTION_SLICES), _REVOLUTION_SLICES - 1)


@kernel(inline=True)
def _improve(
    neurons: F4, weight: F4, normals: F4, axis: F8, point: F8, free: int, limit: float
) -> float:
    """Move the axis by one Gauss-Newton step; return the root mean square residual before it.

    The parameters are as in `fit_axis`; residuals beyond ``limit`` get less weight.
    """
    first, second = _perpendicular_axes(axis)
    owner = np.arange(neurons.shape[1])
    rows, extent = _cylindrical_coordinates(neurons, owner, normals, axis, point, first, second)
    for i in range(owner.size):
        rows[4, i] *= weight[i]
    means = np.zeros((_REVOLUTION_SLICES, 6))  # weight, radius, derivatives
    row = np.zeros(6)
    for i in range(rows.shape[1]):
        _derivatives(rows, i, row)
        k = _slice(rows[0, i], extent)
        for j in range(6):
            means[k, j] += rows[4, i] * row[j]
    for k in range(_REVOLUTION_SLICES):
        for j in range(1, 6):
            means[k, j] /= max(means[k, 0], 1e-9)
    A, b = np.zeros((free, free)), np.zeros(free)
    total = cost = size = 0.0
    for i in range(rows.shape[1]):
        _derivatives(rows, i, row)
        slice_id = _slice(rows[0, i], extent)
        residual = row[1] - means[slice_id, 1]
        point_weight = rows[4, i]
        if abs(residual) > limit:
            point_weight *= limit / abs(residual)
        total += rows[4, i]
        size += rows[4, i] * row[1]
        cost += point_weight * residual * residual
        for j in range(free):
            slope = row[2 + j] - means[slice_id, 2 + j]
            b[j] -= point_weight * slope * residual
            for k in range(free):
                A[j, k] += point_weight * slope * (row[2 + k] - means[slice_id, 2 + k])
    damping = 0.5 * _DAMPING * (A[0, 0] + A[1, 1]) + 1e-6
    for j in range(free):
        A[j, j] += damping if j < 2 else damping * (extent[1] - extent[0]) ** 2 / 12
    solve(A, b)
    _move(axis, point, first, second, b, 0.5 * size / max(total, 1e-6))
    return float(np.sqrt(cost / max(total, 1e-6)))


@kernel(inner=True)
def _derivatives(rows: F8, i: int, out: F8) -> None:
    """Write 1, the radius, and its derivatives with respect to two shifts and two tilts.

    The point is column i of ``rows``, from `_cylindrical_coordinates`; ``out`` is (6,).
    """
    out[0], out[1] = 1.0, rows[1, i]
    out[2], out[3] = -rows[2, i], -rows[3, i]
    out[4], out[5] = -rows[2, i] * rows[0, i], -rows[3, i] * rows[0, i]


@kernel(inline=True)
def _move(axis: F8, point: F8, first: F8, second: F8, move: F8, farthest: float) -> None:
    """Shift the axis by at most ``farthest``, and tilt it by at most 0.3 rad.

    ``move`` is two shifts and, if it has four elements, two tilts, along ``first`` and ``second``
    from `_perpendicular_axes`. ``axis`` and ``point`` (3,) are changed in place.
    """
    length = np.sqrt(move[0] ** 2 + move[1] ** 2)
    share = min(1.0, farthest / max(length, 1e-9))
    for j in range(3):
        point[j] += share * (move[0] * first[j] + move[1] * second[j])
    if move.size == 4:
        tilt = np.sqrt(move[2] ** 2 + move[3] ** 2)
        share = min(1.0, 0.3 / max(tilt, 1e-9))
        squared = 0.0
        for j in range(3):
            axis[j] += share * (move[2] * first[j] + move[3] * second[j])
            squared += axis[j] * axis[j]
        for j in range(3):
            axis[j] /= np.sqrt(squared)


@kernel(inner=True)
def _measure(
    cloud: F4, owner: I4, normals: F4, axis: F8, point: F8, slices: F8
) -> tuple[float, float, float]:
    """Write the profile of all points about an axis, one row of ``slices`` (k, 4) per slice.

    The other parameters are as in `_cylindrical_coordinates`. A row is the slice's fraction of all
    points, the mean and the standard deviation of the radius (0 where all normals are along the
    axis), and the fraction of its points that face the axis. Returns the root mean square of the
    deviations in all slices, the length along the axis, and the mean radius.
    """
    first, second = _perpendicular_axes(axis)
    rows, extent = _cylindrical_coordinates(cloud, owner, normals, axis, point, first, second)
    count = rows.shape[1]
    slices[:] = 0.0
    weights = np.zeros(_REVOLUTION_SLICES)
    for i in range(count):
        k = _slice(rows[0, i], extent)
        weights[k] += rows[4, i]
        slices[k, 0] += 1.0
        slices[k, 1] += rows[4, i] * rows[1, i]
    total = radius = 0.0
    for k in range(_REVOLUTION_SLICES):
        total += weights[k]
        radius += slices[k, 1]
    radius /= max(total, 1e-9)
    enough = 1e-3 * count
    for k in range(_REVOLUTION_SLICES):
        slices[k, 1] = slices[k, 1] / weights[k] if weights[k] > enough else 0.0
    cost = 0.0
    for i in range(count):
        k = _slice(rows[0, i], extent)
        off = (rows[1, i] - slices[k, 1]) ** 2 * rows[4, i]
        if weights[k] > enough:
            slices[k, 2] += off / weights[k]
            cost += off / total
        o = owner[i]
        outward = 0.0
        for j in range(3):
            outward += normals[j, o] * (rows[2, i] * first[j] + rows[3, i] * second[j])
        slices[k, 3] += outward < _INWARD
    for k in range(_REVOLUTION_SLICES):
        slices[k, 2] = np.sqrt(slices[k, 2])
        slices[k, 3] /= max(slices[k, 0], 1.0)
        slices[k, 0] /= count
    return np.sqrt(cost), extent[1] - extent[0], max(radius, 1e-3)
