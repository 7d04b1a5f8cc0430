"""Pieces: what is known of each region, and of each pair of regions (from `borders`)."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import Cells, Lens
from shapecat.detection.planes.height_map import Heights
from shapecat.detection.segmentation.connectivity import Surfaces
from shapecat.geometry import level_axes
from shapecat.jit import kernel

__all__ = [
    "AREA",
    "BAND_M",
    "BOTTOM",
    "CONTACT",
    "COUNT",
    "FAR",
    "FEW",
    "FITTED",
    "FRONT",
    "HIDDEN",
    "LEFT",
    "NEAR",
    "ONTO",
    "ONTO_HEIGHT",
    "OVER",
    "RIGHTMOST",
    "RIM",
    "SAMPLES",
    "SIDE",
    "SIDE2",
    "SIDETURN",
    "TABLE",
    "TOP",
    "TURN",
    "TURN2",
    "UPWARD",
    "Pieces",
    "choose_samples",
    "depth_of",
    "depths_of",
    "is_cut",
    "is_group",
    "may_join",
    "merge",
    "note_cut",
    "pieces_after_cuts",
    "pieces_of",
    "side_of",
]

CONTACT, FRONT, NEAR, ONTO, ONTO_HEIGHT = range(5)
"""Pair statistics [p, q]: linked neighbours; places where p is in front of q; neighbours of equal
depth over a gap; links whose far side on q faces up, and the sum of its heights."""
TABLE, HIDDEN, RIM, OVER = range(4)
"""Statistics of one piece: links with its plane; boundary behind things that are no piece; links
with a higher plane, from below; places where it ends above what is farther away: what stands on
something meets that there."""
COUNT, LEFT, RIGHTMOST, FITTED, SIDE, SIDE2, TURN, TURN2, SIDETURN, TOP, BOTTOM, AREA, FAR = range(
    13
)
"""The shape of one piece, in the order of `Pieces.shape`."""
FEW = 3
"""Links between two pieces that are taken for a contact rather than for noise."""
SAMPLES = 48
"""Most cells, evenly spaced, that stand for a piece where to look at all would take too long."""
BAND_M, BANDS = 0.005, 128
"""Height of a band, and their number; what is higher counts in the last one."""
UPWARD = 0.8
"""Cosine of the largest angle to up of the normal of what faces up."""


class Pieces(NamedTuple):
    """Statistics of n pieces; row 0 is no piece. All but the samples add up when pieces merge.

    Attributes
    ----------
    pairs : (5, n + 1, n + 1) float32, see `CONTACT` and the following.
    single : (n + 1, 4) float32, see `TABLE` and the following.
    boundary : (n + 1,) float32 sides of cells on the boundary.
    shape : (n + 1, 13) float32: cells, lateral range, cells with a tangent, sums for the regression
        of their lateral normal on the lateral position, height range, area, sum of the depths.
    lid : (n + 1, BANDS) float32 m2 of surface that faces up, by height.
    samples : (n + 1, SAMPLES) int32 cells away from edges, -1 beyond the last.
    owner : (n + 1,) int8 the plane it is above, as in `Heights.owner`.
    group : (n + 1,) int16 the piece it has been merged into.
    """

    pairs: F4
    single: F4
    boundary: F4
    shape: F4
    lid: F4
    samples: I4
    owner: I4
    group: I4


@kernel
def pieces_of(
    cells: Cells, heights: Heights, surfaces: Surfaces, labels: I4, n: int, up: F8
) -> Pieces:
    """Collect the shapes of regions 1..n; what they meet, and samples, are up to `borders.meet`."""
    pieces: Pieces = pieces_after_cuts(cells, heights, surfaces, labels, n, up, _blank(1))
    return pieces


@kernel
def pieces_after_cuts(
    cells: Cells, heights: Heights, surfaces: Surfaces, labels: I4, n: int, up: F8, before: Pieces
) -> Pieces:
    """Collect the shapes as `pieces_of`, of cut regions alone; the others are as ``before``.

    What `is_cut` is measured anew.
    """
    pieces: Pieces = _blank(n + 1)
    wanted = np.ones(n + 1, np.bool_)
    wanted[0] = False
    for p in range(1, before.group.size):
        if not is_cut(before, p):
            wanted[p] = False
            pieces.shape[p], pieces.lid[p] = before.shape[p], before.lid[p]
            pieces.owner[p] = before.owner[p]
    _measure(cells.w, cells.lens, heights, surfaces, labels, up, side_of(up), wanted, pieces)
    return pieces


@kernel
def _blank(size: int) -> Pieces:
    """Return pieces without any cell."""
    pieces = Pieces(
        np.zeros((5, size, size), np.float32),
        np.zeros((size, OVER + 1), np.float32),
        np.zeros(size, np.float32),
        np.zeros((size, 13), np.float32),
        np.zeros((size, BANDS), np.float32),
        np.full((size, SAMPLES), -1, np.int32),
        np.zeros(size, np.int8),
        np.arange(size).astype(np.int16),
    )
    shape = pieces.shape
    shape[:, LEFT], shape[:, RIGHTMOST] = 1e9, -1e9
    shape[:, BOTTOM], shape[:, TOP] = 1e9, -1e9
    return pieces


@kernel
def side_of(up: F8) -> F8:
    """Return the horizontal direction across the view, (3,) unit."""
    across = math.hypot(up[0], up[1])
    if across < 0.2:  # the camera looks straight down
        return np.array(level_axes(up[0], up[1], up[2])[0])
    return np.array([up[1] / across, -up[0] / across, 0.0])


@kernel(leaf=True)
def _measure(
    w: F4,
    lens: Lens,
    heights: Heights,
    surfaces: Surfaces,
    labels: I4,
    up: F8,
    side: F8,
    wanted: Bool,
    pieces: Pieces,
) -> None:
    """Add up the cells of the wanted labels; label 0 is not one."""
    shape, owners, lid = pieces.shape, pieces.owner, pieces.lid
    owner, height = heights.owner, heights.height
    zero, one, far_off = np.float32(0), np.float32(1), np.float32(np.inf)
    per_x, per_y = np.float32(1 / lens.fx), np.float32(1 / lens.fy)
    cx, cy, edge_on = np.float32(lens.cx), np.float32(lens.cy), np.float32(0.2)
    sx, sy, sz = np.float32(side[0]), np.float32(side[1]), np.float32(side[2])
    ux, uy, uz = np.float32(up[0]), np.float32(up[1]), np.float32(up[2])
    tangent, normal, spans = surfaces.tangent, surfaces.normal, surfaces.spans
    for i in range(w.shape[0]):
        j, end = spans[i]
        while j < end:
            p, first = labels[i, j], j
            if not wanted[p]:
                j += 1
                continue
            # Sums over the cells of one piece that follow each other.
            far = fitted = sides = sides2 = turns = turns2 = both = areas = zero
            left, right, bottom, top = far_off, -far_off, far_off, -far_off
            while j < end and labels[i, j] == p:
                z = one / w[i, j]
                x, y = (np.float32(j) - cx) * per_x * z, (np.float32(i) - cy) * per_y * z
                along = x * sx + y * sy + z * sz
                h = height[i, j]
                far += z
                left, right = min(left, along), max(right, along)
                bottom, top = min(bottom, h), max(top, h)
                if tangent[i, 0, j] > 0:
                    nx, ny, nz = normal[i, 0, j], normal[i, 1, j], normal[i, 2, j]
                    turn = nx * sx + ny * sy + nz * sz
                    fitted += one
                    sides += along
                    sides2 += along * along
                    turns += turn
                    turns2 += turn * turn
                    both += along * turn
                    facing = -(nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z)
                    area = z * z * per_x * per_y / max(facing, edge_on)
                    areas += area
                    if nx * ux + ny * uy + nz * uz > np.float32(UPWARD):
                        band = min(max(int(h / np.float32(BAND_M)), 0), BANDS - 1)
                        lid[p, band] += area
                j += 1
            owners[p] = owner[i, first]
            row = shape[p]
            row[COUNT] += j - first
            row[FAR] += far
            row[LEFT], row[RIGHTMOST] = min(row[LEFT], left), max(row[RIGHTMOST], right)
            row[TOP], row[BOTTOM] = max(row[TOP], top), min(row[BOTTOM], bottom)
            row[FITTED] += fitted
            row[SIDE] += sides
            row[SIDE2] += sides2
            row[TURN] += turns
            row[TURN2] += turns2
            row[SIDETURN] += both
            row[AREA] += areas


@kernel
def choose_samples(surfaces: Surfaces, labels: I4, pieces: Pieces) -> None:
    """Choose evenly spaced cells of each piece away from edges."""
    rows, columns = labels.shape
    spans, tangent, edge, samples = surfaces.spans, surfaces.tangent, surfaces.edge, pieces.samples
    stride = np.maximum(pieces.shape[:, COUNT].astype(np.int32) // SAMPLES, 1)
    wait, taken = stride.copy(), np.zeros_like(stride)
    for i in range(rows):
        for j in range(spans[i, 0], spans[i, 1]):
            p = labels[i, j]
            if p == 0 or edge[i, j] > 20 or not tangent[i, 0, j] > 0:
                continue
            wait[p] -= 1
            if wait[p] == 0 and taken[p] < SAMPLES:
                samples[p, taken[p]] = i * columns + j
                taken[p] += 1
                wait[p] = stride[p]


@kernel
def merge(pieces: Pieces, p: int, q: int) -> None:
    """Add piece ``q`` to piece ``p``; both are groups of their own before."""
    n = pieces.group.size
    for r in range(pieces.pairs.shape[0]):
        for k in range(n):
            pieces.pairs[r, p, k] += pieces.pairs[r, q, k]
            pieces.pairs[r, q, k] = 0
        for k in range(n):
            pieces.pairs[r, k, p] += pieces.pairs[r, k, q]
            pieces.pairs[r, k, q] = 0
        pieces.pairs[r, p, p] = 0
    pieces.boundary[p] += pieces.boundary[q]
    pieces.single[p] += pieces.single[q]
    pieces.lid[p] += pieces.lid[q]
    a, b = pieces.shape[p], pieces.shape[q]
    for k in (COUNT, FITTED, SIDE, SIDE2, TURN, TURN2, SIDETURN, AREA, FAR):
        a[k] += b[k]
    a[LEFT], a[RIGHTMOST] = min(a[LEFT], b[LEFT]), max(a[RIGHTMOST], b[RIGHTMOST])
    a[TOP], a[BOTTOM] = max(a[TOP], b[TOP]), min(a[BOTTOM], b[BOTTOM])
    # Half of the samples from each side.
    first, second = pieces.samples[p].copy(), pieces.samples[q].copy()
    mixed = 0
    for k in range(SAMPLES):
        for source in (first, second):
            if source[k] >= 0 and mixed < SAMPLES:
                pieces.samples[p, mixed] = source[k]
                mixed += 1
    for k in range(n):
        if pieces.group[k] == q:
            pieces.group[k] = p


@kernel(leaf=True)
def depth_of(pieces: Pieces, p: int) -> float:
    """Return the mean depth of a piece, metres; 1 where it has no cell."""
    count = pieces.shape[p, COUNT]
    return float(pieces.shape[p, FAR] / count) if count > 0 else 1.0


@kernel
def depths_of(pieces: Pieces) -> F4:
    """Return `depth_of` all pieces."""
    depths = np.zeros(pieces.group.size, np.float32)
    for p in range(depths.size):
        depths[p] = depth_of(pieces, p)
    return depths


@kernel(leaf=True)
def note_cut(pieces: Pieces, p: int) -> None:
    """Note that a region, which may have been cut off itself, was cut: its statistics are wrong."""
    if p < pieces.group.size:
        pieces.shape[p, COUNT] = 0


@kernel(leaf=True)
def is_cut(pieces: Pieces, p: int) -> bool:
    """Whether region ``p`` was cut, or cut off, since its statistics were collected."""
    return bool(p >= pieces.group.size or pieces.shape[p, COUNT] == 0)


@kernel(leaf=True)
def is_group(pieces: Pieces, p: int) -> bool:
    """Whether a piece has not been merged into another."""
    return bool(pieces.group[p] == p)


@kernel(leaf=True)
def may_join(pieces: Pieces, p: int, q: int) -> bool:
    """Whether two pieces stand above one plane, and neither has been merged into another."""
    return bool(
        p != q
        and is_group(pieces, p)
        and is_group(pieces, q)
        and pieces.owner[p] == pieces.owner[q]
    )
