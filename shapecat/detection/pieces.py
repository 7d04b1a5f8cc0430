"""Pieces: what is known of each region and of each pair of regions."""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.detection.cells import JUMP, Cells, Lens
from shapecat.detection.heights import Heights
from shapecat.detection.surfaces import DOWN, RIGHT, Surfaces
from shapecat.geometry import gravity_rotation
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
    "LID_M",
    "MEETS_M",
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
    "Pieces",
    "depths_of",
    "has_lid",
    "is_group",
    "lid_share",
    "meet",
    "merge",
    "pieces_of",
    "rests_on",
    "roundness_of",
    "side_of",
    "slope_of",
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
FEW = 3
"""Links between two pieces that are taken for a contact rather than for noise."""
SAMPLES = 48
BANDS = 128
LID_M, LID = 0.02, 0.3
"""A top is closed if this share of its width squared faces up within this depth of it."""
BAND_M = 0.005
LEDGE_M2, FLAT, MEETS_M = 4e-4, 0.9, 0.0075
LEVEL, SLOPING = 3, 8
"""A level top: least visible area, and share of what faces up in the upper `SLOPING` bands that is
in the upper `LEVEL` ones; how far what stands on it may seem to begin above or below it."""
GAP, SHADOW = 3, 15
INWARD = 3
UPWARD = 0.8
DOWNWARD = 0.7
"""Cosine of the largest angle, in the image, of a neighbour below to straight down."""


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


def pieces_of(
    cells: Cells, heights: Heights, surfaces: Surfaces, labels: I4, n: int, up: F8
) -> Pieces:
    """Collect the statistics of regions 1..n; those of their pairs are up to `meet`."""
    size = n + 1
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
    _measure(cells.w, cells.lens, heights, surfaces, labels, up, side_of(up), pieces)
    return pieces


@kernel
def meet(w: F4, heights: Heights, surfaces: Surfaces, labels: I4, up: F8, pieces: Pieces) -> None:
    """Collect the statistics of pairs of pieces, and their samples."""
    owner, height = heights.owner, heights.height
    change = np.zeros(w.shape[1], np.uint8)
    _meet(w, owner, height, surfaces.links, surfaces.normal, labels, up, change, pieces)
    _choose_samples(surfaces, labels, pieces)


def side_of(up: F8) -> F8:
    """Return the horizontal direction across the view, (3,) unit."""
    across = math.hypot(up[0], up[1])
    if across < 0.2:  # the camera looks straight down
        return np.asarray(gravity_rotation(up)[0])
    return np.array([up[1] / across, -up[0] / across, 0.0])


@kernel(leaf=True)
def _meet(
    w: F4,
    owner: I4,
    height: F4,
    links: U1,
    normal: F4,
    labels: I4,
    up: F8,
    change: U1,
    pieces: Pieces,
) -> None:
    rows, columns = w.shape
    steep = DOWNWARD * math.hypot(up[0], up[1])
    for i in range(rows):
        if not _find_changes(links[i], labels[i], labels[min(i + 1, rows - 1)], change):
            continue
        for j in range(columns):
            p = labels[i, j]
            if change[j] == 0 or w[i, j] <= 0 or (p == 0 and owner[i, j] > 0):
                continue
            for d in range(2):
                di, dj = (0, 1) if d == 0 else (1, 0)
                bit = RIGHT if d == 0 else DOWN
                y, x = i + di, j + dj
                if y >= rows or x >= columns:
                    continue
                q = labels[y, x]
                if p == q and (p == 0 or links[i, j] & bit):
                    continue
                # Go on over cells without a reading: the shadow of the projector.
                gap = 0
                while (w[y, x] <= 0 or (q == 0 and owner[y, x] > 0)) and gap <= SHADOW:
                    gap += 1
                    y += di
                    x += dj
                    if y >= rows or x >= columns:
                        break
                    q = labels[y, x]
                if p > 0 and (gap == 0 or p != q):
                    pieces.boundary[p] += 1
                if y >= rows or x >= columns or gap > SHADOW:
                    continue
                q = labels[y, x]
                if q > 0 and (gap == 0 or p != q):
                    pieces.boundary[q] += 1
                if p == q:
                    continue
                step = w[i, j] - w[y, x]
                fall = -up[d]  # how much lower the neighbour is seen, however the image is turned
                if fall > steep and p > 0 and step > JUMP:
                    pieces.single[p, OVER] += 1
                if fall < -steep and q > 0 and step < -JUMP:
                    pieces.single[q, OVER] += 1
                if p > 0 and q > 0:
                    if gap == 0 and links[i, j] & bit:
                        pieces.pairs[CONTACT, p, q] += 1
                        pieces.pairs[CONTACT, q, p] += 1
                        _onto(i, j, di, dj, p, q, labels, normal, height, up, pieces)
                        _onto(y, x, -di, -dj, q, p, labels, normal, height, up, pieces)
                    elif abs(step) < JUMP:
                        if gap <= GAP:
                            pieces.pairs[NEAR, p, q] += 1
                            pieces.pairs[NEAR, q, p] += 1
                    elif step > 0:
                        pieces.pairs[FRONT, p, q] += 1
                    else:
                        pieces.pairs[FRONT, q, p] += 1
                elif p > 0:
                    if step < -JUMP:
                        pieces.single[p, HIDDEN] += 1
                    elif step < JUMP and owner[y, x] < 0 and gap <= GAP:
                        pieces.single[p, TABLE if owner[y, x] == -owner[i, j] else RIM] += 1
                elif q > 0:
                    if step > JUMP:
                        pieces.single[q, HIDDEN] += 1
                    elif step > -JUMP and owner[i, j] < 0 and gap <= GAP:
                        pieces.single[q, TABLE if owner[y, x] == -owner[i, j] else RIM] += 1


@kernel(leaf=True)
def _find_changes(links: U1, here: I4, below: I4, change: U1) -> bool:
    """Mark the cells of a row from which a piece does not just go on to the right and down.

    Returns whether there are any.
    """
    for j in range(here.size):
        change[j] = (here[j] != below[j]) | ((here[j] > 0) & (links[j] != RIGHT | DOWN))
    for j in range(here.size - 1):
        change[j] |= here[j] != here[j + 1]
    some = False
    for j in range(here.size):
        some |= change[j] != 0
    return some


@kernel(leaf=True)
def _onto(
    i: int,
    j: int,
    di: int,
    dj: int,
    p: int,
    q: int,
    labels: I4,
    normal: F4,
    height: F4,
    up: F8,
    pieces: Pieces,
) -> None:
    """Count the link from cell (i, j) of ``p`` to ``q`` if ``q`` faces up beyond it."""
    y = min(max(i + INWARD * di, 0), labels.shape[0] - 1)
    x = min(max(j + INWARD * dj, 0), labels.shape[1] - 1)
    if labels[y, x] != q:
        return
    if normal[y, 0, x] * up[0] + normal[y, 1, x] * up[1] + normal[y, 2, x] * up[2] > UPWARD:
        pieces.pairs[ONTO, p, q] += 1
        pieces.pairs[ONTO_HEIGHT, p, q] += height[y, x]


@kernel(leaf=True)
def _measure(
    w: F4,
    lens: Lens,
    heights: Heights,
    surfaces: Surfaces,
    labels: I4,
    up: F8,
    side: F8,
    pieces: Pieces,
) -> None:
    shape, owners, lid = pieces.shape, pieces.owner, pieces.lid
    owner, height = heights.owner, heights.height
    shape[:, LEFT] = 1e9
    shape[:, RIGHTMOST] = -1e9
    shape[:, TOP] = -1e9
    shape[:, BOTTOM] = 1e9
    per_x, per_y = 1 / lens.fx, 1 / lens.fy
    tangent, normal, spans = surfaces.tangent, surfaces.normal, surfaces.spans
    for i in range(w.shape[0]):
        j, end = spans[i]
        while j < end:
            p, first = labels[i, j], j
            if p == 0:
                j += 1
                continue
            # Sums over the cells of one piece that follow each other.
            far = fitted = sides = sides2 = turns = turns2 = both = areas = 0.0
            left, right, bottom, top = np.inf, -np.inf, np.inf, -np.inf
            while j < end and labels[i, j] == p:
                z = 1 / w[i, j]
                x, y = (j - lens.cx) * per_x * z, (i - lens.cy) * per_y * z
                along = x * side[0] + y * side[1] + z * side[2]
                h = height[i, j]
                far += z
                left, right = min(left, along), max(right, along)
                bottom, top = min(bottom, h), max(top, h)
                if tangent[i, 0, j] > 0:
                    nx, ny, nz = normal[i, 0, j], normal[i, 1, j], normal[i, 2, j]
                    turn = nx * side[0] + ny * side[1] + nz * side[2]
                    fitted += 1
                    sides += along
                    sides2 += along * along
                    turns += turn
                    turns2 += turn * turn
                    both += along * turn
                    facing = -(nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z)
                    area = z * z * per_x * per_y / max(facing, 0.2)
                    areas += area
                    if nx * up[0] + ny * up[1] + nz * up[2] > UPWARD:
                        band = min(max(int(h / BAND_M), 0), BANDS - 1)
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
def _choose_samples(surfaces: Surfaces, labels: I4, pieces: Pieces) -> None:
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


def depths_of(pieces: Pieces) -> F4:
    """Return the mean depth of each piece, metres; 1 where it has no cell."""
    shape = pieces.shape
    count = shape[:, COUNT]
    return np.asarray((shape[:, FAR] + (count == 0)) / np.maximum(count, 1))


@kernel(leaf=True)
def is_group(pieces: Pieces, p: int) -> bool:
    """Whether a piece has not been merged into another."""
    return bool(pieces.group[p] == p)


@kernel(leaf=True)
def slope_of(row: F4) -> float:
    """Return by how much the lateral normal changes across a piece.

    2 for a whole cylinder seen from outside, -2 from inside, 0 for a plane.
    """
    spread, _, both = _moments(row)
    return float(both / max(spread, 1e-9) * (row[RIGHTMOST] - row[LEFT]))


@kernel(leaf=True)
def roundness_of(row: F4) -> float:
    """Return the correlation of the lateral normal with the lateral position.

    1 for what is turned about an upright axis; the faces of a box, and tops that are level, do not
    turn steadily.
    """
    spread, turning, both = _moments(row)
    return float(both / math.sqrt(max(spread * turning, 1e-12)))


@kernel(leaf=True)
def _moments(row: F4) -> tuple[float, float, float]:
    """Return the sums of squares of the lateral position and normal, and of products of both."""
    n = max(row[FITTED], np.float32(1))
    spread = row[SIDE2] - row[SIDE] * row[SIDE] / n
    turning = row[TURN2] - row[TURN] * row[TURN] / n
    return spread, turning, row[SIDETURN] - row[SIDE] * row[TURN] / n


@kernel(leaf=True)
def has_lid(pieces: Pieces, p: int) -> bool:
    """Whether the top of a piece is closed by a surface that faces up."""
    return bool(lid_share(pieces, p, LID_M) > LID)


@kernel(leaf=True)
def rests_on(pieces: Pieces, p: int, q: int) -> bool:
    """Whether piece ``p`` begins where ``q`` ends in a level top; a shoulder slopes."""
    if abs(pieces.shape[p, BOTTOM] - pieces.shape[q, TOP]) > MEETS_M:
        return False
    top = min(int(pieces.shape[q, TOP] / BAND_M), BANDS - 1)
    level = near = 0.0
    for band in range(max(top - SLOPING, 0), top + 1):
        near += pieces.lid[q, band]
        level += pieces.lid[q, band] if band > top - LEVEL else 0.0
    return bool(level > LEDGE_M2 and level > FLAT * near)


@kernel(leaf=True)
def lid_share(pieces: Pieces, p: int, depth: float) -> float:
    """Return what faces up within ``depth`` of the top of a piece, by its width squared."""
    row = pieces.shape[p]
    top = min(int(row[TOP] / BAND_M), pieces.lid.shape[1] - 1)
    area = 0.0
    for band in range(max(top - int(depth / BAND_M), 0), top + 1):
        area += pieces.lid[p, band]
    return float(area / max((row[RIGHTMOST] - row[LEFT]) ** 2, 1e-9))
