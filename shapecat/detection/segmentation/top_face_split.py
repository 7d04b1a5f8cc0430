"""Ledges: stacked objects whose fronts are flush, parted where the top of the lower one shows.

Where the fronts of two stacked objects lie in one surface no edge parts them. What shows of the
top of the lower one is level, at one height, and the upper one rises from there.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.depth_grid import Cells
from shapecat.detection.merging.segment_features import roundness_of
from shapecat.detection.merging.segments import (
    BAND_M,
    BANDS,
    BOTTOM,
    TOP,
    Pieces,
    note_cut,
    side_of,
)
from shapecat.detection.planes.height_map import Heights
from shapecat.detection.segmentation.connectivity import Surfaces
from shapecat.detection.segmentation.watershed import cut_above
from shapecat.jit import kernel

__all__ = ["cut_at_ledges"]

LEDGE_M2 = 4e-4
"""Least visible area of a ledge."""
FLAT = 0.75
"""Share of what faces up near a ledge that is level with it: the shoulder of a bottle slopes."""
NEAR = 5
"""Bands of height about a ledge."""
RISE_M = 0.025
"""What stands on a ledge is higher than this."""
LEAST_ABOVE, LEAST_BELOW, CLEARANCE = 60, 40, 2
"""Cells of the upper and the lower object, so many bands away from the ledge."""
TURNED = 0.95
"""`roundness_of` of what is one thing turned about an axis: the top of a can makes it less."""
HOLLOW = -0.1
"""`slope_of` from which what rises is the inside of a container."""


@kernel
def cut_at_ledges(
    cells: Cells, heights: Heights, surfaces: Surfaces, pieces: Pieces, labels: I4, up: F8
) -> int:
    """Give what stands on ledges labels of its own, in place; return the number of labels."""
    height, side = heights.height, side_of(up)
    n = pieces.group.size - 1
    for p in range(1, pieces.group.size):
        band = _ledge_of(pieces, p)
        if band > 0 and _is_stack(cells, height, surfaces, labels, p, band, side):
            n += 1
            cut_above(labels, surfaces.spans, height, p, (band + 1 + CLEARANCE / 2) * BAND_M, n)
            note_cut(pieces, p)
    return n


@kernel(leaf=True)
def _ledge_of(pieces: Pieces, p: int) -> int:
    """Return the band of the best ledge of a piece, 0 if it has none."""
    if roundness_of(pieces.shape[p]) > TURNED:
        return 0
    top = int(pieces.shape[p, TOP] / BAND_M)
    bottom = int(pieces.shape[p, BOTTOM] / BAND_M)
    lid = pieces.lid[p]
    ledge, best = 0, LEDGE_M2
    for band in range(max(bottom, 1) + 2, min(top - int(RISE_M / BAND_M), BANDS - 1)):
        level = lid[band - 1] + lid[band] + lid[band + 1]
        around = 0.0
        for k in range(max(band - NEAR, 0), min(band + NEAR + 1, BANDS)):
            around += lid[k]
        if level > best and level > FLAT * around:
            ledge, best = band, level
    return ledge


@kernel(leaf=True)
def _is_stack(
    cells: Cells, height: F4, surfaces: Surfaces, labels: I4, p: int, band: int, side: F8
) -> bool:
    """Whether enough of a piece lies above and below a ledge, and the above is not hollow."""
    w, lens, normal, spans = cells.w, cells.lens, surfaces.normal, surfaces.spans
    n = above = below = 0
    sx = sxx = st = sxt = 0.0
    left, right = np.inf, -np.inf
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            if labels[i, j] != p:
                continue
            k = int(height[i, j] / BAND_M)
            below += k <= band - CLEARANCE
            if k < band + CLEARANCE:
                continue
            above += 1
            nx, ny, nz = normal[i, 0, j], normal[i, 1, j], normal[i, 2, j]
            if nx == 0 and ny == 0 and nz == 0:
                continue
            z = 1 / w[i, j]
            x = (j - lens.cx) / lens.fx * z * side[0] + (i - lens.cy) / lens.fy * z * side[1]
            x += z * side[2]
            turn = nx * side[0] + ny * side[1] + nz * side[2]
            n += 1
            sx += x
            sxx += x * x
            st += turn
            sxt += x * turn
            left, right = min(left, x), max(right, x)
    if above < LEAST_ABOVE or below < LEAST_BELOW or n < LEAST_ABOVE // 2:
        return False
    slope = (sxt - sx * st / n) / max(sxx - sx * sx / n, 1e-9) * (right - left)
    return bool(slope > HOLLOW)
