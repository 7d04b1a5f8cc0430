"""Segment features: how wide, round, hollow or closed on top a segment is."""

import math

import numpy as np

from shapecat.detection.merging.segments import BAND_M, BANDS, Row, Segments
from shapecat.jit import kernel

__all__ = [
    "TOP_DEPTH_M",
    "depth_difference",
    "lateral_curvature",
    "lateral_distance",
    "normal_position_correlation",
    "top_area_share",
    "top_band",
    "width_of",
]

TOP_DEPTH_M = 0.02
"""A top is closed by what faces up within this depth of it."""


@kernel
def width_of(row: Row) -> float:
    """Return the lateral extent of a segment, metres; ``row`` is a `SEGMENT`."""
    return float(row.right - row.left)


@kernel
def lateral_distance(a: Row, b: Row) -> float:
    """Return the lateral distance of the middles of two segments, metres."""
    return float(abs(a.left + a.right - b.left - b.right) / 2)


@kernel
def depth_difference(a: Row, b: Row) -> float:
    """Return how much farther away than segment ``b`` segment ``a`` is on average, metres."""
    return float(a.depth_sum / a.count - b.depth_sum / b.count)


@kernel
def lateral_curvature(row: Row) -> float:
    """Return by how much the lateral normal changes across a segment.

    2 for a whole cylinder seen from outside, -2 from inside, 0 for a plane.
    """
    spread, _, both = _moments(row)
    return float(both / max(spread, 1e-9) * width_of(row))


@kernel
def normal_position_correlation(row: Row) -> float:
    """Return the correlation of the lateral normal with the lateral position.

    1 for what is turned about an upright axis; the faces of a box, and tops that are level, do not
    turn steadily.
    """
    spread, turning, both = _moments(row)
    return float(both / math.sqrt(max(spread * turning, 1e-12)))


@kernel
def _moments(row: Row) -> tuple[float, float, float]:
    """Return the sums of squares of the lateral position and normal, and of products of both."""
    n = max(row.fitted, np.float32(1))
    spread = row.xx_sum - row.x_sum * row.x_sum / n
    turning = row.normal_xx_sum - row.normal_x_sum * row.normal_x_sum / n
    return spread, turning, row.x_normal_x_sum - row.x_sum * row.normal_x_sum / n


@kernel
def top_area_share(segments: Segments, p: int, depth: float) -> float:
    """Return what faces up within ``depth`` of the top of a segment, by its width squared."""
    row = segments.statistics[p]
    top = top_band(row)
    area = 0.0
    for band in range(max(top - int(depth / BAND_M), 0), top + 1):
        area += segments.top_area[p, band]
    return float(area / max(width_of(row) ** 2, 1e-9))


@kernel
def top_band(row: Row) -> int:
    """Return the last band of height in which a segment has anything."""
    return min(int(row.top / BAND_M), BANDS - 1)
