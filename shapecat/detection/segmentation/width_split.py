"""Split at width changes: stacked objects with flush fronts, where the outline has a step.

Where a wider or narrower object begins, both sides of the outline step in or out, even if the
fronts are one surface. The ends of a cup's handle look like such a step; merging undoes the split.
"""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.bands import BAND_M, BANDS, lateral_axis
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.jit import kernel

__all__ = ["split_at_width_changes"]

BANDS_BESIDE = SEGMENTATION.bands_beside


class Outlines(NamedTuple):
    """The lateral range of segments 1..n in height bands of `BAND_M`; row 0 is not used.

    Attributes
    ----------
    ends : (2, n + 1, BANDS) float32 metres, the ends of the range along `lateral_axis`: the
        smallest position, and the largest times -1. Both grow where a segment narrows. They are
        infinite in a band without cells.
    counts : (n + 1, BANDS) int32 the number of cells.
    """

    ends: F4
    counts: I4


@kernel
def split_at_width_changes(
    grid: DepthGrid, heights: HeightMap, graph: SurfaceGraph, labels: I4, up: F8, n: int
) -> int:
    """Split segments where their outline has a step, in place; return the last label.

    The part above the step gets a new label.

    Parameters
    ----------
    labels : (rows, columns) segments 1..n, 0 elsewhere.
    up : (3,) unit vector, sensor frame.
    n : the last label before the split.
    """
    side = lateral_axis(up)
    outlines = _outlines_of(grid, heights.height, graph.spans, labels, n, side)
    cuts, last_label = np.zeros(BANDS, np.bool_), n
    for p in range(1, n + 1):
        top_label = p  # the label above the cuts so far
        for band in range(BANDS if _find_cuts(outlines, p, cuts) else 0):
            if cuts[band]:
                last_label += 1
                _relabel_above(
                    labels, graph.spans, heights.height, top_label, band * BAND_M, last_label
                )
                top_label = last_label
    return last_label


@kernel(inline=True)
def _relabel_above(
    labels: I4, spans: I4, height: F4, label: int, level: float, new_label: int
) -> None:
    """Set the cells of ``label`` that are higher than ``level``, metres, to ``new_label``.

    ``labels`` (rows, columns) are 0 outside ``spans``; ``height`` (rows, columns) is in metres.
    """
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            if labels[i, j] == label and height[i, j] > level:
                labels[i, j] = new_label


@kernel(inline=True)
def _outlines_of(grid: DepthGrid, height: F4, spans: I4, labels: I4, n: int, side: F8) -> Outlines:
    """Collect the outlines of the labels 1..n.

    ``height`` is as in `HeightMap`, ``spans`` as in `SurfaceGraph`; ``side`` (3,) is the
    `lateral_axis`.
    """
    inv_depth, intrinsics = grid.inverse_depth, grid.intrinsics
    one, per_band = np.float32(1), np.float32(1 / BAND_M)
    # Lateral position over depth is linear in column and row.
    a, b = np.float32(side[0] / intrinsics.fx), np.float32(side[1] / intrinsics.fy)
    c = np.float32(
        side[2] - intrinsics.cx * side[0] / intrinsics.fx - intrinsics.cy * side[1] / intrinsics.fy
    )
    ends = np.zeros((2, n + 1, BANDS), np.float32)
    ends[:] = np.inf
    count = np.zeros((n + 1, BANDS), np.int32)
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            p = labels[i, j]
            if p == 0:
                continue
            u = (np.float32(j) * a + np.float32(i) * b + c) * (one / inv_depth[i, j])
            band = min(max(int(height[i, j] * per_band), 0), BANDS - 1)
            count[p, band] += 1
            ends[0, p, band] = min(ends[0, p, band], u)
            ends[1, p, band] = min(ends[1, p, band], -u)
    return Outlines(ends, count)


@kernel(inline=True)
def _find_cuts(outlines: Outlines, p: int, cuts: Bool) -> bool:
    """Mark in ``cuts`` (BANDS,) the bands below which label ``p`` is cut; return whether it is cut.

    A cut needs the largest step nearby, at least `SegmentationSettings.both_steps_m`, and enough
    cells on either side.
    """
    first, last, band_count, above = 0, 0, 0, 0
    for band in range(BANDS):
        cells = outlines.counts[p, band]
        if cells > 0:
            first, last = (band if band_count == 0 else first), band
            band_count, above = band_count + 1, above + cells
    if band_count < 2 * BANDS_BESIDE:
        return False
    steps, any_cut = np.zeros(BANDS), False
    cuts[:] = False
    for band in range(first + BANDS_BESIDE, last - BANDS_BESIDE + 2):
        steps[band] = _step_at(outlines, p, band)
    below = 0  # cells since the last cut; ``above``: cells in this band and higher ones
    for band in range(BANDS - BANDS_BESIDE):
        largest = steps[band] >= SEGMENTATION.both_steps_m and band >= BANDS_BESIDE
        for k in range(
            band - BANDS_BESIDE if largest else 0, band + BANDS_BESIDE + 1 if largest else 0
        ):
            largest &= steps[band] >= steps[k]
        if largest and min(below, above) >= SEGMENTATION.part_cells:
            cuts[band] = any_cut = True
            below = 0
        below += outlines.counts[p, band]
        above -= outlines.counts[p, band]
    return any_cut


@kernel(inline=True)
def _step_at(outlines: Outlines, p: int, band: int) -> float:
    """Return the sum of the steps of both sides of label p at the lower edge of a band, metres.

    The result is 0 unless one side steps by at least `SegmentationSettings.side_step_m`; the other
    side counts from half of that.
    """
    total = largest = 0.0
    for k in range(2):
        end = outlines.ends[k, p]
        low, high = band - BANDS_BESIDE, band + 1
        after = before = np.float32(0)
        for k4 in range(BANDS_BESIDE - 1):
            after += end[high + k4]
            before += end[low + k4]
        change = after - before
        if not abs(change) < np.inf:
            continue
        sign = np.float32(1 if change > 0 else -1)
        # A slope below or above the step continues across it.
        slope = max(sign * _slope_of(end, low), sign * _slope_of(end, high), 0.0)
        step = -_second(end, high, -sign) - _second(end, low, sign) - BANDS_BESIDE * slope
        if step >= SEGMENTATION.side_step_m / 2:
            total, largest = total + step, max(largest, step)
    return total if largest >= SEGMENTATION.side_step_m else 0.0


@kernel(inner=True)
def _second(end: F4, k: int, sign: float) -> float:
    """Return the second largest of ``sign * end[k : k + 4]``: a spur one band high is noise.

    ``end`` (BANDS,) is a row of `Outlines.ends`.
    """
    a, b, c, d = sign * end[k], sign * end[k + 1], sign * end[k + 2], sign * end[k + 3]
    return float(max(min(max(a, b), max(c, d)), min(a, b), min(c, d)))


@kernel(inner=True)
def _slope_of(end: F4, k: int) -> float:
    """Return the change per band from the first two to the last two of the values ``end[k:k + 4]``.

    ``end`` (BANDS,) is a row of `Outlines.ends`.
    """
    return float((end[k + 3] + end[k + 2] - end[k + 1] - end[k]) / 4)
