"""Structure rejection: segments that are background, of shelves, walls or noise."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, Bool
from shapecat.detection.depth_grid import PinholeIntrinsics, count_at_range_limit, row_and_column
from shapecat.detection.foreground.walls import CLEARED, ON_WALL
from shapecat.detection.merging.segment_features import top_band
from shapecat.detection.merging.segments import (
    FEW,
    Segments,
    depth_of,
    is_root,
)
from shapecat.detection.planes.height_map import HEIGHT_NOISE, MIN_HEIGHT_M
from shapecat.geometry import DISCONTINUITY, NEAREST_M
from shapecat.jit import kernel

__all__ = ["LabelledGrid", "Limits", "is_background"]

THROUGH, BEYOND, TO_WALL, ON, LAST, BORDER = range(6)
"""Counts of cells of each region: from which it goes on through the level of a board; of their
neighbours on the same surface beyond every plane and in walls; on walls; at the end of the range;
at the border of the image.
"""
SHELF_EDGE_LINKS, SHELF_EDGE_SHARE = 8, 0.1
"""Links with a higher plane, from below, of the edge of a board or its legs; share of the boundary.
"""
BLOB, BLOB_NOISE, BLOB_M2, BLOB_CELLS = 2.5, 3.5, 3e-3, 250
"""A segment this small must rise so many times above the least height of an object cell, and of the
noise in it: spots of noise gather where there is much of a plane far away."""
POST_M = 0.06
"""A post goes on for so far above and below the level of a board."""
REMAINS = 0.8
"""Share of the cells of a segment on a wall."""
UNBOUNDED, WALLED = 0.1, 0.45
"""Share of the boundary of a segment across which its surface goes on to where no plane reaches,
and in a wall: of the front of the side of a shelf half does, of a bowl that stands against one
less."""
CUT = 0.2
"""Share of the cells of a segment that are the last before the end of the range."""
CUT_OFF, LARGE, MARGIN = 0.25, 0.02, 0.08
"""Share of its outline, taken for a square, at which the border of the image cuts a segment of so
large a share of the image, as it cuts robot arms, furniture and bent ends of tables; sensors leave
so much of an image empty at most."""
STEP_M, STEPS, MISSES = 0.02, 64, 2.0
"""A surface is followed up or down in at most so many steps, until it was not seen in more than
two; where something hides it, half a step counts."""
TALL_SHARE = 0.5
"""Share of a segment below surface that goes on beyond the greatest height."""
EDGE_ON, SPECKLED, SPECKS = 3.0, 2.3, 100
"""Surface by what it covers of the view from which it is seen edge on, whether or not many readings
fail there: the square of its boundary by its cells is 16 for a square."""
UPRIGHT, SLENDER, COVERED = 0.03, 0.65, 0.5
"""What is seen edge on: share that faces up; width by height; and the share of its boundary behind
other things from which they may hide the rest."""


class LabelledGrid(NamedTuple):
    """What is known of the samples: see `DepthGrid`, `HeightMap` and `OverSegmentation`."""

    inverse_depth: F4
    intrinsics: PinholeIntrinsics
    planes: F8
    plane_id: I4
    walls: U1
    labels: I4
    spans: I4


class Limits(NamedTuple):
    """Of objects, metres: how high above a plane, how wide, and how far away they are at most."""

    highest_m: float
    largest_m: float
    range_m: float


def is_background(
    field: LabelledGrid, segments: Segments, up: F8, known: Bool, limits: Limits
) -> Bool:
    """Return for each segment whether it is no object, (n + 1,) bool.

    What has been merged into another is left out. What is ``known`` to be an object is no noise.
    """
    n = segments.parent.size
    counts = np.zeros((6, n), np.int64)
    counts[LAST] = count_at_range_limit(field.inverse_depth, field.labels, n, limits.range_m)
    counts[BORDER] = _count_at_border(field, n)
    _count_posts(field, up, counts[THROUGH])
    _count_leaving(field, counts)
    rejected: Bool = _is_rejected(field, segments, counts, up, known, limits)
    return rejected


def _count_at_border(field: LabelledGrid, count: int) -> I4:
    """Count the cells of each region at the border of what the sensor's image shows."""
    counts = np.zeros(count, np.int64)
    for lines, across in ((field.labels, 1), (field.labels.T, 0)):
        seen = np.flatnonzero((field.inverse_depth > 0).any(axis=across))
        margin = MARGIN * len(lines)
        if seen.size and seen[0] <= margin:
            counts += np.bincount(lines[seen[0]], minlength=count)
        if seen.size and seen[-1] >= len(lines) - 1 - margin:
            counts += np.bincount(lines[seen[-1]], minlength=count)
    return counts


@kernel
def _is_rejected(
    field: LabelledGrid, segments: Segments, counts: I4, up: F8, known: Bool, limits: Limits
) -> Bool:
    """Return what `is_background` does, from the counts (6, n + 1) of cells."""
    n = segments.parent.size
    rejected = np.zeros(n, np.bool_)
    for p in range(n):
        for what in range(6 if not is_root(segments, p) else 0):
            counts[what, segments.parent[p]] += counts[what, p]
    for p in range(1, n):
        if not is_root(segments, p):
            continue
        size, boundary = segments.statistics[p].count, segments.statistics[p].boundary
        rejected[p] = (
            _is_shelf_edge(segments, p)
            or segments.statistics[p].right - segments.statistics[p].left > limits.largest_m
            or (not known[p] and _is_noise_blob(segments, p))
            or counts[THROUGH, p] >= FEW
            or counts[ON, p] > REMAINS * size
            or counts[LAST, p] > CUT * size
            or (
                size > LARGE * field.labels.size and counts[BORDER, p] > CUT_OFF * 4 * np.sqrt(size)
            )
            or counts[BEYOND, p] > UNBOUNDED * boundary
            or counts[TO_WALL, p] > WALLED * boundary
            or _is_edge_on_panel(segments, p, field.intrinsics)
            or _is_tall_structure(field, segments, p, up, limits.highest_m)
        )
    return rejected


@kernel
def _is_shelf_edge(segments: Segments, p: int) -> bool:
    """Whether a segment meets a board from below, as its edge and the legs below it do."""
    rim = segments.statistics[p].shelf_edge
    return bool(
        rim >= SHELF_EDGE_LINKS and rim >= SHELF_EDGE_SHARE * segments.statistics[p].boundary
    )


@kernel
def _is_noise_blob(segments: Segments, p: int) -> bool:
    """Whether a segment is as small and low as noise of the plane."""
    shape = segments.statistics[p]
    if shape.top >= BLOB * MIN_HEIGHT_M + BLOB_NOISE * HEIGHT_NOISE * depth_of(segments, p) ** 2:
        return False
    return bool(shape.area < BLOB_M2 or shape.count < BLOB_CELLS)


@kernel
def _is_edge_on_panel(segments: Segments, p: int, intrinsics: PinholeIntrinsics) -> bool:
    """Whether a segment is upright and seen only edge on, as sides of shelves are.

    An object has a front too, unless something hides it.
    """
    shape, boundary = segments.statistics[p], segments.statistics[p].boundary
    covered = shape.count * depth_of(segments, p) ** 2 / (intrinsics.fx * intrinsics.fy)
    speckled = boundary * boundary > SPECKS * shape.count
    if shape.area <= (SPECKLED if speckled else EDGE_ON) * covered:
        return False
    if shape.right - shape.left >= SLENDER * (shape.top - shape.bottom):
        return False
    upward, touching, hidden = 0.0, 0.0, segments.statistics[p].hidden
    for band in range(top_band(shape) + 1):
        upward += segments.top_area[p, band]
    for q in range(segments.parent.size):
        touching += segments.pairs[p, q].contact
        hidden += segments.pairs[q, p].in_front
    upright = upward < UPRIGHT * shape.area
    return bool(upright and touching < FEW and hidden < COVERED * boundary)


@kernel
def _count_leaving(field: LabelledGrid, counts: I4) -> None:
    """Count the cells of each region on walls, and the neighbours on the same surface beyond.

    Walls and floors are cut off where no plane reaches, or go on in a wall; an object ends where
    it ends.
    """
    inv_depth, plane_id, labels = field.inverse_depth, field.plane_id, field.labels
    rows, columns = inv_depth.shape
    out = np.zeros(columns, np.bool_)
    for i in range(rows):
        first, end = field.spans[i]
        some = False
        for j in range(first, end):
            some |= field.walls[i, j] == ON_WALL  # few rows have any, and this vectorises
        if some:
            for j in range(first, end):
                if field.walls[i, j] == ON_WALL:
                    counts[ON, labels[i, j]] += 1
        first, end = max(first, 1), min(end, columns - 1)
        if i == 0 or i == rows - 1 or not _find_out(plane_id, labels, i, first, end, out):
            continue
        for j in range(first, end):
            if not out[j]:
                continue
            plane = field.planes[plane_id[i, j] - 1]
            for y, x in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)):
                if (
                    plane_id[y, x] == 0
                    and inv_depth[y, x] > max(plane[0] * x + plane[1] * y + plane[2], 0)
                    and abs(inv_depth[y, x] - inv_depth[i, j]) < DISCONTINUITY
                ):
                    which = TO_WALL if field.walls[y, x] == CLEARED else BEYOND
                    counts[which, labels[i, j]] += 1


@kernel
def _find_out(plane_id: I4, labels: I4, i: int, first: int, end: int, out: Bool) -> bool:
    """Mark the cells of a part of a row next to what no plane is below; whether there are any."""
    above, below, mine = (
        plane_id[i - 1, first:end],
        plane_id[i + 1, first:end],
        labels[i, first:end],
    )
    left, right = plane_id[i, first - 1 : end - 1], plane_id[i, first + 1 : end + 1]
    part, some = out[first:end], False
    for j in range(mine.size):
        beside = (above[j] == 0) | (below[j] == 0) | (left[j] == 0) | (right[j] == 0)
        part[j] = beside & (mine[j] > 0)
    for j in range(mine.size):
        some |= part[j]
    return some


@kernel
def _is_tall_structure(
    field: LabelledGrid, segments: Segments, p: int, up: F8, highest: float
) -> bool:
    """Whether the surface of a segment goes straight up and down for ``highest`` metres.

    The sides of shelves, door frames and whatever stands before the table reach higher above a
    plane than objects on it, or down below it, also where only segments of them are seen.
    """
    inv_depth, intrinsics = field.inverse_depth, field.intrinsics
    columns = inv_depth.shape[1]
    if segments.plane_id[p] <= 0:
        return False
    plane = field.planes[segments.plane_id[p] - 1]
    n = high = 0
    for s in segments.samples[p]:
        if s < 0:
            break
        i, j = row_and_column(s, columns)
        h = (1 - (plane[0] * j + plane[1] * i + plane[2]) / inv_depth[i, j]) * plane[3]
        n += 1
        rise = _rise(inv_depth, intrinsics, i, j, up, 1.0, highest)
        if h + rise > highest - STEP_M:
            high += 1
        else:
            high += (
                rise + _rise(inv_depth, intrinsics, i, j, up, -1.0, highest - rise)
                > highest - STEP_M
            )
    return bool(high > TALL_SHARE * n)


@kernel
def _rise(
    inv_depth: F4, intrinsics: PinholeIntrinsics, i: int, j: int, up: F8, sign: float, most: float
) -> float:
    """Return how far the surface of a cell goes straight on upwards, up to about ``most``.

    With ``sign`` -1 downwards.
    """
    z = 1 / inv_depth[i, j]
    x, y = (j - intrinsics.cx) / intrinsics.fx * z, (i - intrinsics.cy) / intrinsics.fy * z
    reach = misses = 0.0
    for k in range(1, STEPS):
        d = STEP_M * k
        along = sign * d
        depth = z + along * up[2]
        if d > most + STEP_M or depth <= NEAREST_M:
            break
        inverse = 1 / depth
        v = int(intrinsics.cy + intrinsics.fy * (y + along * up[1]) * inverse + 0.5)
        u = int(intrinsics.cx + intrinsics.fx * (x + along * up[0]) * inverse + 0.5)
        if v < 0 or u < 0 or v >= inv_depth.shape[0] or u >= inv_depth.shape[1]:
            break
        ahead = inv_depth[v, u] - inverse
        if abs(ahead) < DISCONTINUITY:
            reach, misses = d, 0.0
            continue
        misses += 0.5 if ahead > 0 else 1.0  # something in front of it hides it
        if misses > MISSES:
            break
    return reach


@kernel
def _count_posts(field: LabelledGrid, up: F8, through: I4) -> None:
    """Count where each region goes on through the level of a board, as posts do.

    What is above and below the level is one upright surface there.
    """
    inv_depth, intrinsics, plane_id, labels = (
        field.inverse_depth,
        field.intrinsics,
        field.plane_id,
        field.labels,
    )
    columns = inv_depth.shape[1]
    if len(field.planes) < 2:
        return
    for i in range(inv_depth.shape[0]):
        for j in range(field.spans[i, 0], field.spans[i, 1]):
            if labels[i, j] == 0:
                continue
            above = _followed(inv_depth, intrinsics, i, j, up, POST_M)
            if above < 0:
                continue
            y, x = above // columns, above % columns
            if labels[y, x] == 0 or plane_id[y, x] == plane_id[i, j]:
                continue
            if _followed(inv_depth, intrinsics, i, j, up, -POST_M) >= 0:
                through[labels[i, j]] += 1
                through[labels[y, x]] += 1


@kernel
def _followed(
    inv_depth: F4, intrinsics: PinholeIntrinsics, i: int, j: int, up: F8, rise: float
) -> int:
    """Return the flat cell ``rise`` metres above a cell if the surface is seen there, else -1."""
    z = 1 / inv_depth[i, j]
    x = (j - intrinsics.cx) / intrinsics.fx * z + rise * up[0]
    y = (i - intrinsics.cy) / intrinsics.fy * z + rise * up[1]
    z += rise * up[2]
    if z <= NEAREST_M:
        return -1
    v = int(intrinsics.cy + intrinsics.fy * y / z + 0.5)
    u = int(intrinsics.cx + intrinsics.fx * x / z + 0.5)
    rows, columns = inv_depth.shape
    if v < 0 or u < 0 or v >= rows or u >= columns:
        return -1
    return int(v * columns + u) if abs(inv_depth[v, u] - 1 / z) < DISCONTINUITY else -1
