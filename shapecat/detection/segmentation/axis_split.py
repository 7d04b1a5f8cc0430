"""Axes: stacked round objects whose sides are flush, parted where their axes differ.

A can on a can shows no edge where their sides are nearly one surface. But whatever is turned about
a vertical axis is so at all heights about the same one, be it bottle, cup or ball; and two things
hardly ever stand on each other axis on axis.
"""

import math

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import Cells
from shapecat.detection.merging.segment_features import slope_of
from shapecat.detection.merging.segments import (
    BAND_M,
    BANDS,
    COUNT,
    Pieces,
    is_cut,
    note_cut,
    side_of,
)
from shapecat.detection.planes.height_map import Heights
from shapecat.detection.segmentation.connectivity import Surfaces
from shapecat.detection.segmentation.watershed import cut_above
from shapecat.geometry import cross
from shapecat.jit import kernel

__all__ = ["cut_at_axes"]

STEEP = 0.35
"""Largest cosine between up and the normals of a side; on shoulders only a part would be below."""
ROUND = 0.8
"""`slope_of` from which a piece may be round."""
LEAST_CELLS, LEAST_BANDS = 60, 3
"""Of either part; an axis fitted to less is not sure."""
APART_M, BEHIND_M, BETTER = 0.004, 0.01, 0.4
"""Distance of the axes, across the view a cell, along it more, for only one half of a circle is
seen; by how much two axes explain the sides better than one."""
OFF_M = 0.0035
"""Standard deviation of the sides of a round object from their circles: a cell."""
SLIM, STOUT = 0.35, 0.85
"""Radius by visible width: half where nothing hides a part."""
NARROW = 0.65
"""What is narrower than this, by the width below, may be a neck or stand on a ledge."""
N, U, F, Z, UU, UF, FF, UZ, FZ, ZZ, WIDTH = range(11)
"""Sums over the side: cells, lateral and forward position and their squares' sum z, moments about
the mean of each band of height, and widths of bands."""


@kernel
def cut_at_axes(
    cells: Cells, heights: Heights, surfaces: Surfaces, pieces: Pieces, labels: I4, up: F8, n: int
) -> int:
    """Give what turns about another axis a label of its own, in place; return how many there are.

    Parameters
    ----------
    labels : (rows, columns) 1..n, 0 elsewhere.
    """
    rounded = _number_rounded(pieces, n + 1)
    things = np.max(rounded) + 1
    sums, reach = np.zeros((things, BANDS, 11)), np.zeros((2, things, BANDS))
    _add(cells, heights.height, surfaces, labels, rounded, up, sums, reach)
    for p in range(1, n + 1):
        if rounded[p] == 0:
            continue
        rest = p
        for band in np.flatnonzero(_cuts_of(sums[rounded[p]])):
            n += 1
            level = (band + 0.5) * BAND_M
            cut_above(labels, surfaces.spans, heights.height, rest, level, n)
            note_cut(pieces, p)
            rest = n  # what this cut has left
    return n


@kernel
def _cuts_of(bands: F8) -> Bool:
    """Return whether a side is to be cut at each of its bands."""
    cut = np.zeros(BANDS, np.bool_)
    parts = np.zeros((BANDS, 2), np.int64)
    parts[0] = 0, BANDS
    top = 1
    while top > 0:
        top -= 1
        low, high = parts[top]
        band = low + _best_cut(bands[low:high])
        if band > low:
            cut[band] = True
            parts[top] = low, band
            parts[top + 1] = band + 1, high
            top += 2
    return cut


@kernel
def _number_rounded(pieces: Pieces, labels: int) -> I4:
    """Return a number from 1 on for each of the labels that may be round, 0 for the others."""
    rounded = np.zeros(labels, np.bool_)
    for p in range(1, labels):
        rounded[p] = is_cut(pieces, p) or (
            pieces.shape[p, COUNT] >= 2 * LEAST_CELLS and slope_of(pieces.shape[p]) > ROUND
        )
    return np.asarray(np.cumsum(rounded) * rounded)


@kernel
def _add(
    cells: Cells,
    height: F4,
    surfaces: Surfaces,
    labels: I4,
    rounded: I4,
    up: F8,
    sums: F8,
    reach: F8,
) -> None:
    """Collect the sums over the bands of each round thing; ``reach`` (2, things, bands) is room."""
    w, lens, side = cells.w, cells.lens, side_of(up)
    forward = cross(up, side)
    left, right = reach[0], reach[1]
    left[:], right[:] = np.inf, -np.inf
    tangent, normal = surfaces.tangent, surfaces.normal
    for i in range(labels.shape[0]):
        for j in range(surfaces.spans[i, 0], surfaces.spans[i, 1]):
            p = rounded[labels[i, j]]
            if not (p > 0 and tangent[i, 0, j] > 0):
                continue
            if normal[i, 0, j] * up[0] + normal[i, 1, j] * up[1] + normal[i, 2, j] * up[2] > STEEP:
                continue
            depth = 1 / w[i, j]
            x, y = (j - lens.cx) / lens.fx * depth, (i - lens.cy) / lens.fy * depth
            u = x * side[0] + y * side[1] + depth * side[2]
            f = x * forward[0] + y * forward[1] + depth * forward[2]
            z = u * u + f * f
            band = min(max(int(height[i, j] / BAND_M), 0), BANDS - 1)
            s = sums[p, band]
            s[N] += 1
            s[U] += u
            s[F] += f
            s[Z] += z
            s[UU] += u * u
            s[UF] += u * f
            s[FF] += f * f
            s[UZ] += u * z
            s[FZ] += f * z
            s[ZZ] += z * z
            left[p, band], right[p, band] = min(left[p, band], u), max(right[p, band], u)
    for p in range(1, sums.shape[0]):
        for band in range(BANDS):
            s = sums[p, band]
            if s[N] > 0:
                u, f, z = s[U] / s[N], s[F] / s[N], s[Z] / s[N]
                s[UU] -= u * s[U]
                s[UF] -= u * s[F]
                s[FF] -= f * s[F]
                s[UZ] -= u * s[Z]
                s[FZ] -= f * s[Z]
                s[ZZ] -= z * s[Z]
                s[WIDTH] = s[N] * (right[p, band] - left[p, band])


@kernel
def _best_cut(bands: F8) -> int:
    """Return the band at which two axes explain a side best, 0 if one does as well."""
    seen = np.flatnonzero(bands[:, N])
    total = np.sum(bands, axis=0)
    if total[N] < 2 * LEAST_CELLS:
        return 0
    below = np.zeros(11)
    best, most = 0, BETTER
    for band in range(seen[0], seen[-1] - LEAST_BANDS + 2):
        above = total - below - bands[band]
        if band >= seen[0] + LEAST_BANDS and min(above[N], below[N]) >= LEAST_CELLS:
            lower, upper, one = _axis(below), _axis(above), _axis(below + above)
            better = 1 - (lower[3] + upper[3]) / max(one[3], 1e-12)
            if (
                better > most
                and (abs(lower[0] - upper[0]) > APART_M or abs(lower[1] - upper[1]) > BEHIND_M)
                and above[WIDTH] / above[N] > NARROW * below[WIDTH] / below[N]
                and _is_round(below, lower)
                and _is_round(above, upper)
            ):
                best, most = band, better
        below += bands[band]
    return best


@kernel(leaf=True)
def _axis(s: F8) -> tuple[float, float, float, float]:
    """Fit a vertical axis to a side by least squares (Kasa 1976), with a radius for each band.

    Returns
    -------
    Its lateral and forward position, the mean radius, and the sum of squares that remains, m4.
    """
    determinant = s[UU] * s[FF] - s[UF] * s[UF]
    if determinant < 1e-4 * s[UU] * s[FF]:
        return 0.0, 0.0, 0.0, s[ZZ]
    u = (s[UZ] * s[FF] - s[FZ] * s[UF]) / (2 * determinant)
    f = (s[FZ] * s[UU] - s[UZ] * s[UF]) / (2 * determinant)
    square = (s[Z] - 2 * u * s[U] - 2 * f * s[F]) / s[N] + u * u + f * f
    rest = s[ZZ] - 2 * (u * s[UZ] + f * s[FZ])
    return u, f, math.sqrt(max(square, 0.0)), max(rest, 0.0)


@kernel(leaf=True)
def _is_round(s: F8, axis: tuple[float, float, float, float]) -> bool:
    radius, width = axis[2], s[WIDTH] / s[N]
    if not SLIM * width < radius < STOUT * width:
        return False
    return bool(math.sqrt(axis[3] / s[N]) < 2 * radius * OFF_M)
