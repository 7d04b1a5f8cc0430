"""Segment features: how wide, round, hollow or closed on top a segment is."""

import math

import numpy as np

from shapecat.detection.merging.segments import BAND_M, BANDS, Row, Segments
from shapecat.detection.merging.settings import MERGING
from shapecat.jit import kernel

__all__ = [
    "SEGMENT_FEATURES",
    "depth_difference",
    "lateral_curvature",
    "lateral_distance",
    "normal_position_correlation",
    "share",
    "width_of",
    "write_segment_features",
]

SEGMENT_FEATURES = np.dtype(
    [
        ("width_m", "f4"),
        ("top_m", "f4"),
        ("bottom_m", "f4"),
        ("height_m", "f4"),
        ("lateral_curvature", "f4"),
        ("normal_position_correlation", "f4"),
        ("plane_contact", "f4"),  # shares of the outline
        ("hidden", "f4"),
        ("shelf_edge", "f4"),
        ("upper_silhouette", "f4"),
        ("touching", "f4"),
        ("in_front", "f4"),
        ("behind", "f4"),
        ("top_area", "f4"),  # by the width squared
        ("facing_up", "f4"),  # share of the area
        ("area_m2", "f4"),
        ("filled", "f4"),  # area by width and height
    ]
)
"""Features of one segment: its size, shape and faces, and what its outline is made of."""


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
def write_segment_features(segments: Segments, p: int, out: Row) -> None:
    """Write the `SEGMENT_FEATURES` of a segment to a record of them."""
    row = segments.statistics[p]
    around = row.boundary
    front = back = touch = up = closed = 0.0
    for k in range(segments.parent.size):
        front += segments.pairs[p, k].in_front
        back += segments.pairs[k, p].in_front
        touch += segments.pairs[p, k].contact
    top = min(int(row.top / BAND_M), BANDS - 1)
    for band in range(top + 1):
        up += segments.top_area[p, band]
        closed += segments.top_area[p, band] if band >= top - MERGING.top_bands else 0.0
    wide, tall = width_of(row), row.top - row.bottom
    out.width_m, out.top_m, out.bottom_m, out.height_m = wide, row.top, row.bottom, tall
    out.lateral_curvature = lateral_curvature(row)
    out.normal_position_correlation = normal_position_correlation(row)
    out.plane_contact = share(row.plane_contact, around)
    out.hidden = share(row.hidden, around)
    out.shelf_edge = share(row.shelf_edge, around)
    out.upper_silhouette = share(row.upper_silhouette, around)
    out.touching = share(touch, around)
    out.in_front = share(front, around)
    out.behind = share(back, around)
    out.top_area = closed / max(wide**2, 1e-9)
    out.facing_up = share(up, row.area)
    out.area_m2 = row.area
    out.filled = share(row.area, wide * tall)


@kernel
def share(part: float, whole: float) -> float:
    """Return a part by the whole, 0 if there is none."""
    return float(part / whole) if whole > 0 else 0.0
