"""Segment features: the size, shape, faces and boundary of a segment."""

import math

import numpy as np

from shapecat.arrays import Row
from shapecat.detection.merging.segments import Segments, mean_depth
from shapecat.detection.merging.settings import MERGING
from shapecat.detection.segmentation.bands import BAND_M, BANDS
from shapecat.jit import kernel

__all__ = [
    "SEGMENT_FEATURES",
    "depth_difference",
    "lateral_curvature",
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
        ("plane_contact", "f4"),  # fractions of the boundary
        ("hidden", "f4"),
        ("shelf_edge", "f4"),
        ("lower_edge_free", "f4"),
        ("touching", "f4"),
        ("in_front", "f4"),
        ("behind", "f4"),
        ("top_area", "f4"),  # divided by the squared width
        ("facing_up", "f4"),  # fraction of the area
        ("area_m2", "f4"),
        ("filled", "f4"),  # area divided by width times height
    ],
    align=True,
)
"""Features of one segment: its size, shape and faces, and the composition of its boundary."""


@kernel(inner=True)
def width_of(row: Row) -> float:
    """Return the lateral extent of a segment, metres; ``row`` is a `SEGMENT`."""
    return float(row.right - row.left)


@kernel(inner=True)
def depth_difference(a: Row, b: Row) -> float:
    """Return the mean depth of segment ``a`` minus that of segment ``b``, metres."""
    return float(mean_depth(a) - mean_depth(b))


@kernel(inner=True)
def lateral_curvature(row: Row) -> float:
    """Return the change of the lateral component of the normal across a segment.

    It is 2 for a whole cylinder seen from outside, -2 from inside, and 0 for a plane.
    """
    spread, _, product = _moments(row)
    return float(product / max(spread, 1e-9) * width_of(row))


@kernel(inner=True)
def normal_position_correlation(row: Row) -> float:
    """Return the correlation between the lateral components of normal and position.

    It is near 1 for the outside of a solid of revolution with an upright axis, and less for the
    faces of a box and for level tops, whose normals do not turn steadily.
    """
    spread, turning, product = _moments(row)
    return float(product / math.sqrt(max(spread * turning, 1e-12)))


@kernel(inner=True)
def _moments(row: Row) -> tuple[float, float, float]:
    """Return the centred sums of x², n² and x n, for lateral position x and lateral normal n."""
    n = max(row.fitted, np.float32(1))
    spread = row.xx_sum - row.x_sum * row.x_sum / n
    turning = row.normal_xx_sum - row.normal_x_sum * row.normal_x_sum / n
    return spread, turning, row.x_normal_x_sum - row.x_sum * row.normal_x_sum / n


@kernel
def write_segment_features(segments: Segments, p: int, out: Row) -> None:
    """Write the `SEGMENT_FEATURES` of segment ``p`` to the record ``out``."""
    row = segments.statistics[p]
    boundary = row.boundary
    in_front = behind = touching = facing_up = top_area = 0.0
    for k in range(segments.parent.size):
        in_front += segments.pairs[p, k].in_front
        behind += segments.pairs[k, p].in_front
        touching += segments.pairs[p, k].contact
    top = min(int(row.top / BAND_M), BANDS - 1)
    for band in range(top + 1):
        facing_up += segments.top_area[p, band]
        top_area += segments.top_area[p, band] if band >= top - MERGING.top_bands else 0.0
    width, height = width_of(row), row.top - row.bottom
    out.width_m, out.top_m, out.bottom_m, out.height_m = width, row.top, row.bottom, height
    out.lateral_curvature = lateral_curvature(row)
    out.normal_position_correlation = normal_position_correlation(row)
    out.plane_contact = share(row.plane_contact, boundary)
    out.hidden = share(row.hidden, boundary)
    out.shelf_edge = share(row.shelf_edge, boundary)
    out.lower_edge_free = share(row.lower_edge_free, boundary)
    out.touching = share(touching, boundary)
    out.in_front = share(in_front, boundary)
    out.behind = share(behind, boundary)
    out.top_area = top_area / max(width**2, 1e-9)
    out.facing_up = share(facing_up, row.area)
    out.area_m2 = row.area
    out.filled = share(row.area, width * height)


@kernel(inner=True)
def share(part: float, whole: float) -> float:
    """Return ``part / whole``; 0 if the whole is not positive."""
    return float(part / whole) if whole > 0 else 0.0
