"""The context block: scale-free numbers about the whole object, upright in the world."""

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel

__all__ = ["CONTEXT_NAMES", "PROFILE_NAMES", "PROFILE_SLICES", "context", "profile"]

CONTEXT_NAMES = (
    "height_to_across",
    "along_to_across",
    "height_to_widest",
    "narrow_to_wide",
    "mean_to_wide",
    "spread_2_to_1",
    "spread_3_to_1",
    "spread_1_vertical",
    "spread_3_vertical",
    "normal_spread_2",
    "normal_spread_3",
    "normal_axis_vertical",
    "yaw_harmonic_1",
    "yaw_harmonic_2",
    "yaw_harmonic_4",
    "share_up",
    "share_side",
    "share_down",
    "share_up_top",
    "share_up_bottom",
    "axis_radius",
    "axis_radius_spread",
    "axis_residual",
    "axis_inward",
    "axis_inward_top",
    "axis_inward_bottom",
    "axis_radius_top",
    "axis_radius_bottom",
    "axis_radius_slope",
    "sphere_residual",
    "sphere_radius",
    "sphere_height",
    "height_mean",
    "height_deviation",
    "height_skew",
    "share_convex",
    "geodesic_to_straight",
    "geodesic_longest",
    "geodesic_spread",
    "base_gap",
)
PROFILE_SLICES = 8
_PROFILE = ("share", "radius", "spread", "inward", "up", "curvature")
PROFILE_NAMES = tuple(f"{i}_{name}" for i in range(PROFILE_SLICES) for name in _PROFILE)
_DIRECTIONS = 16


@kernel
def _ratio(a: float, b: float) -> float:
    """Return a / (a + b): a ratio of lengths between 0 and 1; one half where both are 0."""
    return a / (a + b) if a + b > 0 else 0.5


@kernel(fast=True)
def _width(px: F4, py: F4, c: float, s: float) -> float:
    low = high = c * px[0] + s * py[0]
    for k in range(px.size):
        value = c * px[k] + s * py[k]
        low = value if value < low else low
        high = value if value > high else high
    return float(high - low)


@kernel
def vertical_axis(x: F4, y: F4, normals: F4, weight: F4) -> tuple[float, float, float]:
    """Return the vertical line nearest to the horizontal lines along the normals.

    Its x and y, and the root mean square distance of the lines to it. A weak pull to the centre of
    the neurons makes the answer unique where all normals are parallel or vertical.
    """
    axx = axy = ayy = bx = by = total = 0.0
    for i in range(x.size):
        tx, ty = -normals[1, i], normals[0, i]
        w = weight[i]
        along = tx * x[i] + ty * y[i]
        axx += w * tx * tx
        axy += w * tx * ty
        ayy += w * ty * ty
        bx += w * tx * along
        by += w * ty * along
        total += w * (tx * tx + ty * ty)
    pull = 1e-2 * total + 1e-6
    axx += pull
    ayy += pull
    det = axx * ayy - axy * axy
    cx, cy = (ayy * bx - axy * by) / det, (axx * by - axy * bx) / det
    residual = 0.0
    for i in range(x.size):
        off = -normals[1, i] * (x[i] - cx) + normals[0, i] * (y[i] - cy)
        residual += weight[i] * off * off
    return cx, cy, np.sqrt(residual / max(total, 1e-6))


@kernel
def _sphere(x: F4, y: F4, z: F4, weight: F4) -> tuple[float, float, float]:
    """Fit |p|^2 = 2 c.p + k; return residual / radius, radius and height of the centre."""
    A = np.zeros((4, 5))
    for i in range(x.size):
        w = weight[i]
        squared = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
        row = (2.0 * x[i], 2.0 * y[i], 2.0 * z[i], 1.0)
        for a in range(4):
            for b in range(4):
                A[a, b] += w * row[a] * row[b]
            A[a, 4] += w * row[a] * squared
    for a in range(4):
        A[a, a] += 1e-4
    # Gauss elimination: the matrix is positive definite, no pivots needed
    for a in range(4):
        for b in range(a + 1, 4):
            f = A[b, a] / A[a, a]
            for c in range(a, 5):
                A[b, c] -= f * A[a, c]
    for a in range(3, -1, -1):
        for c in range(a + 1, 4):
            A[a, 4] -= A[a, c] * A[c, 4]
        A[a, 4] /= A[a, a]
    cx, cy, cz = A[0, 4], A[1, 4], A[2, 4]
    mean = second = 0.0
    for i in range(x.size):
        d = np.sqrt((x[i] - cx) ** 2 + (y[i] - cy) ** 2 + (z[i] - cz) ** 2)
        mean += weight[i] * d
        second += weight[i] * d * d
    return np.sqrt(max(second - mean * mean, 0.0)) / max(mean, 1e-6), mean, cz


@kernel
def context(
    points: F4,
    x: F4,
    y: F4,
    z: F4,
    base: float,
    weight: F4,
    normals: F4,
    curvatures: F4,
    straight: F4,
    paths: F4,
    eye: F4,
    low: float,
    high: float,
    out: F4,
) -> tuple[float, float, float]:
    """Write the numbers named by `CONTEXT_NAMES`; return widths: greatest, across, along the view.

    All lengths are in units of the mean distance between neurons, with the origin at their mean.

    Parameters
    ----------
    points : (3, m) the points; base : height of the support; low, high : of the object.
    x, y, z, weight : (k,) neurons and their share of the points.
    normals, curvatures : as `fit_surfaces` returns them.
    straight, paths : (k, k) distances between the neurons.
    eye : (3,) the sensor.
    """
    count = x.size
    n = 0
    height = high - low
    # extents; directions are counted from the line of sight, so that yaw does not matter
    ex, ey = eye[0], eye[1]
    length = np.sqrt(ex * ex + ey * ey)
    ex, ey = (ex / length, ey / length) if length > 1e-6 else (1.0, 0.0)
    along = across = wide = mean_width = 0.0
    narrow = np.inf
    for d in range(_DIRECTIONS):
        angle = d * np.pi / _DIRECTIONS
        c, s = np.cos(angle), np.sin(angle)
        width = _width(
            points[0], points[1], np.float32(c * ex - s * ey), np.float32(s * ex + c * ey)
        )
        along = width if d == 0 else along
        across = width if d == _DIRECTIONS // 2 else across
        wide = max(wide, width)
        narrow = min(narrow, width)
        mean_width += width / _DIRECTIONS
    out[n] = _ratio(height, across)
    out[n + 1] = _ratio(along, across)
    out[n + 2] = _ratio(height, wide)
    out[n + 3] = _ratio(narrow, wide)
    out[n + 4] = _ratio(mean_width, wide)
    n += 5
    # spread of the neurons and of the normals
    spread = np.zeros((3, 3))
    bend = np.zeros((3, 3))
    for i in range(count):
        p = (x[i], y[i], z[i])
        for a in range(3):
            for b in range(3):
                spread[a, b] += weight[i] * p[a] * p[b]
                bend[a, b] += weight[i] * normals[a, i] * normals[b, i]
    values, vectors = np.linalg.eigh(spread)
    out[n] = values[1] / max(values[2], 1e-9)
    out[n + 1] = values[0] / max(values[2], 1e-9)
    out[n + 2] = abs(vectors[2, 2])
    out[n + 3] = abs(vectors[2, 0])
    values, vectors = np.linalg.eigh(bend)
    out[n + 4] = values[1]
    out[n + 5] = values[0]
    out[n + 6] = abs(vectors[2, 0])
    n += 7
    # how the horizontal normals are spread over yaw: 4 is for boxes
    total = 1e-6
    harmonics = np.zeros((3, 2))
    for i in range(count):
        a, b = normals[0, i], normals[1, i]
        flat = a * a + b * b
        if flat > 1e-6:
            w = weight[i]
            total += w * flat
            c1, s1 = a / np.sqrt(flat), b / np.sqrt(flat)
            c2, s2 = c1 * c1 - s1 * s1, 2 * s1 * c1
            harmonics[0, 0] += w * flat * c1
            harmonics[0, 1] += w * flat * s1
            harmonics[1, 0] += w * flat * c2
            harmonics[1, 1] += w * flat * s2
            harmonics[2, 0] += w * flat * (c2 * c2 - s2 * s2)
            harmonics[2, 1] += w * flat * 2 * s2 * c2
    for a in range(3):
        out[n + a] = np.sqrt(harmonics[a, 0] ** 2 + harmonics[a, 1] ** 2) / total
    n += 3
    # which way the surface looks, and where
    cx, cy, residual = vertical_axis(x, y, normals, weight)
    radius = radius2 = top = bottom = top_weight = bottom_weight = 0.0
    slope_rz = mean_z = convex = 0.0
    for i in range(count):
        w = weight[i]
        level = (z[i] - low) / height if height > 0 else 0.5
        up = normals[2, i]
        out[n] += w * (up > 0.8)
        out[n + 1] += w * (abs(up) < 0.4)
        out[n + 2] += w * (up < -0.25)
        out[n + 3] += w * (up > 0.7 and level > 0.75)
        out[n + 4] += w * (up > 0.7 and level < 0.3)
        rx, ry = x[i] - cx, y[i] - cy
        r = np.sqrt(rx * rx + ry * ry)
        flat = np.sqrt(normals[0, i] ** 2 + normals[1, i] ** 2)
        inward = w if rx * normals[0, i] + ry * normals[1, i] < 0 and flat > 0.3 else 0.0
        out[n + 8] += inward
        if level > 0.5:
            out[n + 9] += inward
            top += w * r
            top_weight += w
        else:
            out[n + 10] += inward
            bottom += w * r
            bottom_weight += w
        radius += w * r
        radius2 += w * r * r
        mean_z += w * level
        convex += w * (curvatures[0, i] + curvatures[1, i] > 0)
    second = third = 0.0
    for i in range(count):
        level = (z[i] - low) / height if height > 0 else 0.5
        r = np.sqrt((x[i] - cx) ** 2 + (y[i] - cy) ** 2)
        slope_rz += weight[i] * (level - mean_z) * (r - radius)
        second += weight[i] * (level - mean_z) ** 2
        third += weight[i] * (level - mean_z) ** 3
    out[n + 5] = _ratio(radius, height)
    out[n + 6] = np.sqrt(max(radius2 - radius * radius, 0.0)) / max(radius, 1e-6)
    out[n + 7] = min(residual / max(radius, 1e-6), 2.0)
    out[n + 11] = _ratio(top / max(top_weight, 1e-6), radius)
    out[n + 12] = _ratio(bottom / max(bottom_weight, 1e-6), radius)
    out[n + 13] = slope_rz / max(second, 1e-4) / max(radius, 1e-6)
    n += 14
    residual, size, middle = _sphere(x, y, z, weight)
    out[n] = min(residual, 1.0)
    out[n + 1] = 1.0 / (1.0 + size)
    out[n + 2] = min(max((middle - low) / max(height, 1e-3), -2.0), 3.0)
    n += 3
    out[n] = mean_z
    out[n + 1] = np.sqrt(second)
    out[n + 2] = third / max(second**1.5, 1e-6)
    out[n + 3] = convex
    n += 4
    # how far it is around the surface
    sum_paths = sum_straight = longest = 0.0
    least, most = np.inf, 0.0
    for i in range(count):
        row = 0.0
        for j in range(count):
            row += paths[i, j]
            sum_straight += straight[i, j]
            longest = max(longest, paths[i, j])
        sum_paths += row
        least, most = min(least, row), max(most, row)
    pairs = max(count * (count - 1), 1)
    out[n] = min(sum_paths / max(sum_straight, 1e-9), 4.0)
    out[n + 1] = longest / max(sum_paths / pairs, 1e-9)
    out[n + 2] = _ratio(least, most)
    n += 3
    out[n] = _ratio(max(low - base, 0.0), height)
    return wide, across, along


@kernel
def profile(
    x: F4,
    y: F4,
    z: F4,
    weight: F4,
    normals: F4,
    curvatures: F4,
    low: float,
    high: float,
    out: F4,
) -> None:
    """Write the radial profile about the vertical axis, named by `PROFILE_NAMES`.

    For each of 8 slices of the height: share of the points, mean and deviation of the radius over
    the largest slice's, shares facing the axis and facing up, mean curvature.
    """
    cx, cy, _ = vertical_axis(x, y, normals, weight)
    widest = 1e-6
    for i in range(x.size):
        level = (z[i] - low) / (high - low) if high > low else 0.5
        place = min(max(level * PROFILE_SLICES - 0.5, 0.0), PROFILE_SLICES - 1.0)
        first = min(int(place), PROFILE_SLICES - 2)
        rx, ry = x[i] - cx, y[i] - cy
        r = np.sqrt(rx * rx + ry * ry)
        inward = rx * normals[0, i] + ry * normals[1, i] < 0
        curvature = curvatures[0, i] + curvatures[1, i]
        for k in range(2):
            share = weight[i] * (place - first if k == 1 else first + 1 - place)
            at = (first + k) * 6
            out[at] += share
            out[at + 1] += share * r
            out[at + 2] += share * r * r
            out[at + 3] += share * (1.0 - abs(normals[2, i])) * inward
            out[at + 4] += share * normals[2, i]
            out[at + 5] += share * curvature / (1 + abs(curvature))
    for k in range(PROFILE_SLICES):
        at = k * 6
        share = out[at]
        for m in range(1, 6):
            out[at + m] = out[at + m] / share if share > 1e-4 else 0.0
        out[at + 2] = np.sqrt(max(out[at + 2] - out[at + 1] ** 2, 0.0))
        widest = max(widest, out[at + 1])
    for k in range(PROFILE_SLICES):
        out[k * 6 + 1] /= widest
        out[k * 6 + 2] /= widest
