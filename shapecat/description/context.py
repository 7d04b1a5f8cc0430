"""The context block: scale-free features of the whole object in its upright pose."""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.description.linear import principal_axes, solve
from shapecat.description.profile import VerticalAxis
from shapecat.description.surface import Surface
from shapecat.jit import kernel

__all__ = ["CONTEXT_NAMES", "context"]

CONTEXT_NAMES = (
    "height_to_across",  # a_to_b of two lengths is `_ratio`: a / (a + b)
    "along_to_across",  # widths along and across the line of sight
    "height_to_widest",
    "narrow_to_wide",  # smallest, mean and largest horizontal width
    "mean_to_wide",
    "spread_2_to_1",  # variance along the second principal axis of the neurons / the first
    "spread_3_to_1",
    "spread_1_vertical",  # absolute cosine between the first axis and up
    "spread_3_vertical",
    "normal_spread_2",  # second and third eigenvalue of the normals' second moments
    "normal_spread_3",
    "normal_axis_vertical",  # absolute cosine between the third eigenvector and up
    "yaw_harmonic_1",
    "yaw_harmonic_2",
    "yaw_harmonic_4",
    "share_up",
    "share_side",
    "share_down",
    "share_up_top",
    "share_up_bottom",
    "axis_radius",  # `_ratio` of the mean radius about the vertical axis to the height
    "axis_radius_spread",  # standard deviation of the radius / mean radius
    "axis_residual",  # `VerticalAxis.residual` / mean radius
    "axis_inward",  # fraction of the points that face the axis
    "axis_inward_top",  # the same in the upper and in the lower half
    "axis_inward_bottom",
    "axis_radius_top",  # `_ratio` of the mean radius of each half to that of the whole
    "axis_radius_bottom",
    "axis_radius_slope",  # change of the radius from bottom to top / mean radius, by regression
    "sphere_residual",  # standard deviation of the distance from the centre / radius
    "sphere_radius",  # 1 / (1 + radius)
    "sphere_height",  # height of the centre: 0 at the bottom, 1 at the top
    "height_mean",
    "height_deviation",
    "height_skew",
    "share_convex",
    "geodesic_to_straight",
    "geodesic_longest",
    "geodesic_spread",
    "base_gap",  # `_ratio` of the gap above the support to the height
)
_DIRECTIONS = 16  # in which the horizontal width is measured, over 180 degrees


@kernel(inner=True)
def _ratio(a: float, b: float) -> float:
    """Return a / (a + b), from 0 to 1, for lengths a and b; 0.5 if both are 0."""
    return a / (a + b) if a + b > 0 else 0.5


@kernel(fast=True, inner=True)
def _width(px: F4, py: F4, c: float, s: float) -> float:
    """Return the width of points (``px``, ``py``), (n,), along the direction (``c``, ``s``)."""
    low = high = c * px[0] + s * py[0]
    for k in range(px.size):
        value = c * px[k] + s * py[k]
        low = value if value < low else low
        high = value if value > high else high
    return float(high - low)


@kernel(inline=True)
def _sphere(x: F4, y: F4, z: F4, weight: F4) -> tuple[float, float, float]:
    """Fit a sphere, |p|^2 = 2 c.p + k; return residual / radius, radius and z of the centre.

    ``x``, ``y``, ``z`` are the neurons (k,), ``weight`` (k,) each neuron's fraction of the points.
    """
    A, solution = np.zeros((4, 4)), np.zeros(4)
    for i in range(x.size):
        w = weight[i]
        squared = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
        row = (2.0 * x[i], 2.0 * y[i], 2.0 * z[i], 1.0)
        for a in range(4):
            for b in range(4):
                A[a, b] += w * row[a] * row[b]
            solution[a] += w * row[a] * squared
    for a in range(4):
        A[a, a] += 1e-4
    solve(A, solution)
    cx, cy, cz = solution[0], solution[1], solution[2]
    mean = second = 0.0
    for i in range(x.size):
        d = np.sqrt((x[i] - cx) ** 2 + (y[i] - cy) ** 2 + (z[i] - cz) ** 2)
        mean += weight[i] * d
        second += weight[i] * d * d
    return np.sqrt(max(second - mean * mean, 0.0)) / max(mean, 1e-6), mean, cz


@kernel
def context(
    surface: Surface,
    normals: F4,
    curvatures: F4,
    upright: VerticalAxis,
    low: float,
    high: float,
    out: F4,
) -> tuple[float, float, float]:
    """Write the features named by `CONTEXT_NAMES`, and return three widths of the object.

    Parameters
    ----------
    normals, curvatures : (3, k) and (2, k), from `fit_surfaces`.
    upright : from `vertical_axis`.
    low, high : 2nd and 98th percentiles of the heights of the points, in units of the surface.
    out : the block ``context`` of the descriptor, zeros on entry, written in place.

    Returns
    -------
    The largest horizontal width, and those across and along the line of sight, in the same units.
    """
    weight, base = surface.weight, -surface.center[2] / surface.unit
    x, y, z = surface.neurons[0], surface.neurons[1], surface.neurons[2]
    wide, across, along = _extents(surface.points, high - low, surface.eye, out[:5])
    _spreads(x, y, z, weight, normals, out[5:12])
    _harmonics(weight, normals, out[12:15])
    rise = np.zeros(x.size)
    for i in range(x.size):
        rise[i] = (z[i] - low) / (high - low) if high > low else 0.5
    _facing(rise, weight, normals, out[15:20])
    _axis(x, y, upright, rise, high - low, weight, normals, out[20:29])
    residual, size, middle = _sphere(x, y, z, weight)
    out[29] = min(residual, 1.0)
    out[30] = 1.0 / (1.0 + size)
    out[31] = min(max((middle - low) / max(high - low, 1e-3), -2.0), 3.0)
    _heights(rise, weight, curvatures, out[32:36])
    _distance_ratios(surface.euclidean, surface.geodesic, out[36:39])
    out[39] = _ratio(max(low - base, 0.0), high - low)
    return wide, across, along


@kernel(inline=True)
def _extents(points: F4, height: float, eye: F4, out: F4) -> tuple[float, float, float]:
    """Write ratios of the height and of horizontal widths to ``out`` (5,); return three widths.

    The widths are the largest one, and those across and along the line of sight. ``points`` (3, n)
    and ``eye`` (3,) are as in `Surface`; ``height`` is that of the points.
    """
    ex, ey = eye[0], eye[1]
    length = np.sqrt(ex * ex + ey * ey)
    ex, ey = (ex / length, ey / length) if length > 1e-6 else (1.0, 0.0)
    along = across = wide = mean = 0.0
    narrow = np.inf
    for d in range(_DIRECTIONS):
        c, s = np.cos(d * np.pi / _DIRECTIONS), np.sin(d * np.pi / _DIRECTIONS)
        width = _width(
            points[0], points[1], np.float32(c * ex - s * ey), np.float32(s * ex + c * ey)
        )
        along = width if d == 0 else along
        across = width if d == _DIRECTIONS // 2 else across
        wide = max(wide, width)
        narrow = min(narrow, width)
        mean += width / _DIRECTIONS
    out[0] = _ratio(height, across)
    out[1] = _ratio(along, across)
    out[2] = _ratio(height, wide)
    out[3] = _ratio(narrow, wide)
    out[4] = _ratio(mean, wide)
    return wide, across, along


@kernel(inline=True)
def _spreads(x: F4, y: F4, z: F4, weight: F4, normals: F4, out: F4) -> None:
    """Write features of the principal axes of the neurons, and of the normals, to ``out`` (7,).

    They are variances (those of the neurons relative to the largest) and how vertical the axes are.
    Inputs: ``x``, ``y``, ``z`` and ``weight`` of `_sphere`; ``normals`` (3, k) of `fit_surfaces`.
    """
    spread, bend = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(x.size):
        p = (x[i], y[i], z[i])
        for a in range(3):
            for b in range(3):
                spread[a, b] += weight[i] * p[a] * p[b]
                bend[a, b] += weight[i] * normals[a, i] * normals[b, i]
    values, vectors = principal_axes(spread)
    out[0] = values[1] / max(values[2], 1e-9)
    out[1] = values[0] / max(values[2], 1e-9)
    out[2] = abs(vectors[2, 2])
    out[3] = abs(vectors[2, 0])
    values, vectors = principal_axes(bend)
    out[4] = values[1]
    out[5] = values[0]
    out[6] = abs(vectors[2, 0])


@kernel(inline=True)
def _harmonics(weight: F4, normals: F4, out: F4) -> None:
    """Write the magnitudes of harmonics 1, 2 and 4 of the normals' distribution over yaw.

    Harmonic 4 is high for boxes. ``weight`` (k,) and ``normals`` (3, k) are as in `_spreads`;
    ``out`` is (3,).
    """
    total = 1e-6
    c, s = np.zeros(3), np.zeros(3)
    for i in range(weight.size):
        flat = normals[0, i] ** 2 + normals[1, i] ** 2
        if flat > 1e-6:
            w = weight[i] * flat
            total += w
            c1, s1 = normals[0, i] / np.sqrt(flat), normals[1, i] / np.sqrt(flat)
            c2, s2 = c1 * c1 - s1 * s1, 2 * s1 * c1
            c[0] += w * c1
            s[0] += w * s1
            c[1] += w * c2
            s[1] += w * s2
            c[2] += w * (c2 * c2 - s2 * s2)
            s[2] += w * 2 * s2 * c2
    for k in range(3):
        out[k] = np.sqrt(c[k] * c[k] + s[k] * s[k]) / total


@kernel(inline=True)
def _facing(rise: F8, weight: F4, normals: F4, out: F4) -> None:
    """Write to ``out`` (5,) the fractions of the surface that face up, sideways and down.

    They are followed by the fractions that face up near the top and near the bottom. ``rise`` (k,)
    is the height of each neuron, about 0 at the bottom and 1 at the top; ``weight`` and ``normals``
    are as in `_spreads`.
    """
    for i in range(rise.size):
        w, up = weight[i], normals[2, i]
        out[0] += w * (up > 0.8)
        out[1] += w * (abs(up) < 0.4)
        out[2] += w * (up < -0.25)
        out[3] += w * (up > 0.7 and rise[i] > 0.75)
        out[4] += w * (up > 0.7 and rise[i] < 0.3)


@kernel(inline=True)
def _axis(
    x: F4,
    y: F4,
    upright: VerticalAxis,
    rise: F8,
    height: float,
    weight: F4,
    normals: F4,
    out: F4,
) -> None:
    """Compare the surface with a surface of revolution about an upright axis.

    ``upright`` is from `vertical_axis`, ``rise`` is as in `_facing`, ``height`` is that of the
    object; the other parameters are as in `_spreads`. Writes the nine ``axis`` features to ``out``.
    """
    cx, cy, residual = upright
    radius = radius2 = middle = 0.0
    parts = np.zeros((2, 2))  # lower and upper half: weight, weighted radius
    for i in range(x.size):
        w = weight[i]
        rx, ry = x[i] - cx, y[i] - cy
        r = np.sqrt(rx * rx + ry * ry)
        flat = np.sqrt(normals[0, i] ** 2 + normals[1, i] ** 2)
        half = 1 if rise[i] > 0.5 else 0
        parts[half, 0] += w
        parts[half, 1] += w * r
        if flat > 0.3 and rx * normals[0, i] + ry * normals[1, i] < 0:
            out[3] += w
            out[5 - half] += w
        radius += w * r
        radius2 += w * r * r
        middle += w * rise[i]
    slope = spread = 0.0
    for i in range(x.size):
        r = np.sqrt((x[i] - cx) ** 2 + (y[i] - cy) ** 2)
        slope += weight[i] * (rise[i] - middle) * (r - radius)
        spread += weight[i] * (rise[i] - middle) ** 2
    out[0] = _ratio(radius, height)
    out[1] = np.sqrt(max(radius2 - radius * radius, 0.0)) / max(radius, 1e-6)
    out[2] = min(residual / max(radius, 1e-6), 2.0)
    out[6] = _ratio(parts[1, 1] / max(parts[1, 0], 1e-6), radius)
    out[7] = _ratio(parts[0, 1] / max(parts[0, 0], 1e-6), radius)
    out[8] = slope / max(spread, 1e-4) / max(radius, 1e-6)


@kernel(inline=True)
def _heights(rise: F8, weight: F4, curvatures: F4, out: F4) -> None:
    """Write mean, deviation and skew of the heights, and the convex fraction of the surface.

    ``rise`` (k,) is as in `_facing`, ``weight`` (k,) as in `_sphere`; ``curvatures`` (2, k) is from
    `fit_surfaces`; ``out`` is (4,).
    """
    mean = second = third = 0.0
    for i in range(rise.size):
        mean += weight[i] * rise[i]
        out[3] += weight[i] * (curvatures[0, i] + curvatures[1, i] > 0)
    for i in range(rise.size):
        off = rise[i] - mean
        second += weight[i] * off * off
        third += weight[i] * off * off * off
    out[0] = mean
    out[1] = np.sqrt(second)
    out[2] = third / max(second**1.5, 1e-6)


@kernel(inline=True)
def _distance_ratios(euclidean: F4, geodesic: F4, out: F4) -> None:
    """Write ratios of the distances between neurons to ``out`` (3,).

    They are mean geodesic to mean Euclidean distance, at most 4; largest to mean geodesic distance;
    and, by `_ratio`, the smallest to the largest sum of a neuron's geodesic distances.
    ``euclidean`` and ``geodesic`` (k, k) are as in `Surface`.
    """
    count = geodesic.shape[0]
    total = direct = longest = max_sum = 0.0
    min_sum = np.inf
    for i in range(count):
        row_sum = 0.0
        for j in range(count):
            row_sum += geodesic[i, j]
            direct += euclidean[i, j]
            longest = max(longest, geodesic[i, j])
        total += row_sum
        min_sum, max_sum = min(min_sum, row_sum), max(max_sum, row_sum)
    out[0] = min(total / max(direct, 1e-9), 4.0)
    out[1] = longest / max(total / (count * (count - 1)), 1e-9)
    out[2] = _ratio(min_sum, max_sum)
