"""Planes found by height alone: boards and tables of which only narrow strips are visible.

A strip is too narrow to determine its tilt. Examples are a table between the flat boxes that cover
it, and a board just below the camera that fills a few rows of the image. But the heights of its
samples agree to millimetres, so if up is known, only the height has to be found.
"""

import math
from collections.abc import Iterator

import numpy as np

from shapecat.arrays import F4, F8, Bool
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics
from shapecat.detection.planes.extent import (
    COS,
    SIN,
    PlaneCandidate,
    SupportingPlane,
    measure_candidate,
    outline_corners,
)
from shapecat.detection.planes.oriented_points import OrientedPoints
from shapecat.detection.planes.plane_fit import DepthSamples, horizontal_plane
from shapecat.detection.planes.settings import PLANES, STRIPS
from shapecat.geometry import gravity_rotation
from shapecat.jit import kernel, unset

__all__ = ["add_strip_planes", "may_have_strips"]

COLUMN_STRIDE = 2
"""Step between the columns that are searched for samples on level surface."""
AREA_STRIDE = 4
"""One in this many samples on level surface is used to measure the area above a plane."""
ARM = 2
"""Distance, in cells, to the neighbours that show whether a sample is on level surface."""
BINS = 600
"""Number of bins of `StripSettings.bin_m`. Farther below the camera than these 3 m, noise blurs the
height of a strip."""


def may_have_strips(
    grid: DepthGrid, points: OrientedPoints, candidates: list[PlaneCandidate]
) -> bool:
    """Return whether a plane may be visible as strips only; quicker than `add_strip_planes`.

    There must be many points at its height, but few just below, and no large candidate (see
    `_may_be_strips`). ``candidates`` are parallel planes, at least one.
    """
    count = _count_by_height(points, candidates[0].plane.up)
    return any(_may_be_strips(grid, candidates, *peak) for peak in _peaks(count, STRIPS.min_points))


def _may_be_strips(
    grid: DepthGrid, candidates: list[PlaneCandidate], height: float, above: float
) -> bool:
    """Return whether a plane at a height may be seen as strips: at a grazing angle, or covered.

    A plane at a grazing angle must have no large candidate at its height, a covered plane also none
    up to `PlaneSettings.max_object_m` below it. ``height`` is above the sensor, metres; ``above``
    is the level area just above the plane, relative to the area of the plane, as `_peaks` yields
    it. ``candidates`` are parallel planes.
    """
    large = [plane.offset for plane, *_ in candidates if plane.area_m2 > PLANES.likely_m2]
    up = candidates[0].plane.up
    slope = math.hypot(up[0] / grid.intrinsics.fx, up[1] / grid.intrinsics.fy)
    if -height < slope / STRIPS.grazing:
        return all(abs(offset - height) > STRIPS.same_m for offset in large)
    below = any(-STRIPS.same_m < height - offset < PLANES.max_object_m for offset in large)
    return above > STRIPS.covers and not below


def add_strip_planes(grid: DepthGrid, candidates: list[PlaneCandidate]) -> list[PlaneCandidate]:
    """Add the planes of which only narrow strips are visible.

    Hardly any surface lies just below such a plane. A board shows some surface at its own height; a
    covered table shows more just above, on the objects that cover it. ``candidates`` are parallel
    planes, lowest first, at least one. The result is in the same order; a candidate at the height
    of strips may be extended or replaced.
    """
    up = max(candidates, key=lambda candidate: candidate.plane.area_m2).plane.up
    strips, area = _level_strips(grid.inverse_depth, grid.intrinsics, up)
    planes = list(candidates)
    for height, above in _peaks(area, STRIPS.min_area_m2):
        if not _may_be_strips(grid, candidates, height, above):
            continue
        added = _plane_at(grid, strips, up, height)
        if added.plane.area_m2 == 0 or _is_at_range_end(grid.inverse_depth, added.inliers):
            continue
        duplicates = [k for k in planes if abs(k.plane.offset - added.plane.offset) < STRIPS.same_m]
        if above > STRIPS.covers:
            added = _with_covered_area(added, strips, grid.intrinsics)
        if added.covered_m2 > 0:
            added = _widened(duplicates[0], added) if duplicates else added
        elif added.plane.area_m2 < max(
            [PLANES.min_area_m2, *(k.plane.area_m2 for k in duplicates)]
        ):
            continue
        planes = [k for k in planes if not any(k is m for m in duplicates)] + [added]
    return sorted(planes, key=lambda candidate: candidate.plane.offset)


def _is_at_range_end(inv_depth: F4, strips: DepthSamples) -> bool:
    """Return whether strips lie at the end of the range, where nothing below them is visible.

    ``inv_depth`` is (rows, columns), 1/m.
    """
    subset = inv_depth[::4, ::4]  # enough to show where the range ends
    valid = subset[subset > 0]
    return bool(np.median(strips.inverse_depth) < STRIPS.end * valid.min(initial=np.inf))


def _widened(candidate: PlaneCandidate, covered: PlaneCandidate) -> PlaneCandidate:
    """Return ``candidate``, extended to the outline of ``covered``, and with its covered area."""
    extent = np.maximum(candidate.plane.extent, covered.plane.extent)
    plane = candidate.plane._replace(extent=extent)
    return candidate._replace(plane=plane, covered_m2=covered.covered_m2)


def _plane_at(grid: DepthGrid, strips: F4, up: F8, height: float) -> PlaneCandidate:
    """Measure the level plane through the strips at a height.

    ``strips`` (4, n) are from `_level_strips`; ``up`` (3,) is a unit vector; ``height`` is above
    the sensor, metres.
    """
    near = np.ascontiguousarray(strips[:, abs(strips[3] - height) < 1.5 * STRIPS.bin_m])
    offset = float(np.median(near[3])) if near.size else height
    samples = DepthSamples(near[0], near[1], near[2], COLUMN_STRIDE)
    return measure_candidate(grid, samples, horizontal_plane(grid.intrinsics, up, offset))


def _with_covered_area(
    candidate: PlaneCandidate, strips: F4, intrinsics: PinholeIntrinsics
) -> PlaneCandidate:
    """Return the candidate with its ``covered_m2``.

    This is the area of its outline plus that of the level tops above it, or 0 if the outline is
    mostly visible or hardly covered. ``strips`` (4, n) are from `_level_strips`.
    """
    plane = candidate.plane
    corners = outline_corners(plane.up, plane.offset, plane.extent)
    area_vector = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    outline_m2 = abs(float(area_vector @ plane.up)) / 2
    borne_m2 = _area_over(strips, intrinsics, plane)
    covers = plane.area_m2 < STRIPS.max_visible * outline_m2
    covers &= borne_m2 >= max(PLANES.min_area_m2, plane.area_m2 / 2)
    return candidate._replace(covered_m2=borne_m2 + outline_m2 if covers else 0.0)


def _area_over(strips: F4, intrinsics: PinholeIntrinsics, plane: SupportingPlane) -> float:
    """Return the area, m², of the level surfaces above a plane and within its outline.

    Only those `STRIPS.same_m` to `STRIPS.tallest_m` above it count. ``strips`` (4, n) are from
    `_level_strips`.
    """
    subset = strips[:, ::AREA_STRIDE]
    above = subset[3] - plane.offset
    tops = subset[:, (above > STRIPS.same_m) & (above < STRIPS.tallest_m)]
    j, i, inv_depth, _ = tops.astype(np.float64)
    x, y = (j - intrinsics.cx) / intrinsics.fx, (i - intrinsics.cy) / intrinsics.fy
    level = gravity_rotation(plane.up) @ (np.stack([x, y, np.ones(j.size)]) / inv_depth)
    over = (COS[:, None] * level[0] + SIN[:, None] * level[1] < plane.extent[:, None]).all(axis=0)
    facing = np.maximum(-level[2] * inv_depth, STRIPS.min_rise)
    area = AREA_STRIDE * COLUMN_STRIDE / (intrinsics.fx * intrinsics.fy)
    return float((area / (facing * inv_depth**2))[over].sum())


def _peaks(amount: F8, threshold: float) -> Iterator[tuple[float, float]]:
    """Find the heights with a peak of level surface and almost no surface just below.

    Parameters
    ----------
    amount : (BINS,) level surface at each height, as points or area, the lowest first.
    threshold : minimum amount of a peak together with the two bins beside it.

    Yields
    ------
    Height of a peak above the sensor, metres, ascending; and the amount just above it, where the
    tops of covering objects are, relative to the peak.
    """
    total = amount[:-2] + amount[1:-1] + amount[2:]
    peaks = (total > threshold) & (amount[1:-1] >= amount[:-2]) & (amount[1:-1] >= amount[2:])
    first = STRIPS.below - 1
    for k in (np.flatnonzero(peaks[first:-2]) + STRIPS.below).tolist():
        below = amount[k - STRIPS.below : k - 2]
        lower = sum((3 * below / below.size).tolist())
        falls = amount[k + 1 : k + 4].min() < STRIPS.dip * amount[k]
        if falls and total[k - 1] > STRIPS.contrast * lower:
            upper = sum(amount[k + 3 : k + STRIPS.above].tolist())
            yield (k + 0.5 - BINS) * STRIPS.bin_m, upper / float(total[k - 1])


@kernel
def _count_by_height(points: OrientedPoints, up: F8) -> F8:
    """Count the points below the sensor by height, except those that face sideways.

    Points without a normal count too. The result is (BINS,); a bin is `STRIPS.bin_m` high, and the
    last one ends at the sensor. ``up`` (3,) is a unit vector, sensor frame.
    """
    x, y, z = np.float32(up[0]), np.float32(up[1]), np.float32(up[2])
    xs, ys, zs = points.positions[0], points.positions[1], points.positions[2]
    nx, ny, nz = points.normals[0], points.normals[1], points.normals[2]
    count, scale = np.zeros(BINS), np.float32(-1 / STRIPS.bin_m)
    for k in range(xs.size):
        below = scale * (x * xs[k] + y * ys[k] + z * zs[k])
        facing = x * nx[k] + y * ny[k] + z * nz[k]  # 0 where the surface is not smooth
        aside = (facing < np.float32(0.7)) & (nz[k] < 0)
        if (below > 0) & (below < BINS) & (not aside):
            count[BINS - 1 - int(below)] += 1
    return count


@kernel
def _level_strips(inv_depth: F4, intrinsics: PinholeIntrinsics, up: F8) -> tuple[F4, F8]:
    """Find the samples on level surfaces in ``inv_depth`` (rows, columns); ``up`` (3,) is vertical.

    A sample is level if at least three of the four samples `ARM` cells away are closer to a level
    surface through it than to a vertical one; every `COLUMN_STRIDE`-th column is tested. Returns
    their columns, rows, inverse depths and heights above the sensor, metres, (4, n), and the area
    of their surface in each band of height, (BINS,) m², the lowest first.
    """
    rows, columns = inv_depth.shape
    across, down = np.float32(up[0] / intrinsics.fx), np.float32(up[1] / intrinsics.fy)
    ahead = up[2] - intrinsics.cx * across - intrinsics.cy * down
    level, area = np.zeros(columns, np.bool_), np.zeros(BINS)
    strips = unset((4, inv_depth.size // COLUMN_STRIDE + rows), np.float32)
    n = 0
    for i in range(ARM, rows - ARM):
        start = np.float32(ahead + i * down)
        _find_level(inv_depth, i, (start, across, down), level)
        for j in range(ARM, columns - ARM, COLUMN_STRIDE):
            if level[j]:
                w, rise = inv_depth[i, j], start + across * np.float32(j)
                strips[0, n], strips[1, n], strips[2, n], strips[3, n] = j, i, w, rise / w
                facing = max(float(-rise), STRIPS.min_rise) * intrinsics.fx * intrinsics.fy
                area[BINS - 1 - int(-rise / w / STRIPS.bin_m)] += COLUMN_STRIDE / (facing * w * w)
                n += 1
    return strips[:, :n].copy(), area


@kernel(fast=True, inner=True)
def _find_level(inv_depth: F4, i: int, slope: tuple[float, float, float], level: Bool) -> None:
    """Mark the cells of row i that are on level surface. The loop vectorises.

    ``slope`` holds the component along up of the ray (x, y, 1) through column 0 of the row, and its
    change from one column to the next and from one row to the next. ``inv_depth`` is (rows,
    columns), 1/m. ``level`` (columns,) is written, except for `ARM` columns at each end.
    """
    start, across, down = slope
    steep = np.float32(0.5 * ARM) * np.sqrt(across * across + down * down)
    side, along = np.float32(ARM) * across, np.float32(ARM) * down
    max_rise, gate = np.float32(-STRIPS.min_slope), np.float32(-PLANES.tolerance / 2)
    deepest = np.float32((1 - BINS) * STRIPS.bin_m)
    row, row_above, row_below = inv_depth[i], inv_depth[i - ARM], inv_depth[i + ARM]
    for j in range(ARM, level.size - ARM):
        # On a level surface w / rise is the same everywhere.
        w, rise = row[j], start + across * np.float32(j)
        straight, flat, product = steep * w, gate * rise, w * rise
        limit = straight if straight > flat else flat
        neighbours = np.uint8(abs(row_above[j] * rise - (product - w * along)) < limit)
        neighbours += np.uint8(abs(row_below[j] * rise - (product + w * along)) < limit)
        neighbours += np.uint8(abs(row[j - ARM] * rise - (product - w * side)) < limit)
        neighbours += np.uint8(abs(row[j + ARM] * rise - (product + w * side)) < limit)
        level[j] = (neighbours >= 3) & (rise < max_rise) & (rise > deepest * w)
