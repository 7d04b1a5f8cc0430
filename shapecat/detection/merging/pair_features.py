"""Pair features: named features that show whether two adjacent segments are one object.

Richtsfeld et al. 2014 learn from relations between surface patches; here the relations are between
the outlines, extents, curvatures and positions of segments.
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, Bool, Records, Row
from shapecat.detection.merging.image_hull import hull_area
from shapecat.detection.merging.segment_features import (
    SEGMENT_FEATURES,
    depth_difference,
    lateral_curvature,
    normal_position_correlation,
    share,
    width_of,
    write_segment_features,
)
from shapecat.detection.merging.segments import (
    MIN_LINKS,
    SEGMENT,
    Segments,
    add_statistics,
    mean_depth,
)
from shapecat.detection.merging.settings import MERGING
from shapecat.detection.planes.extent import DIRECTIONS
from shapecat.geometry import NEAREST_M
from shapecat.jit import kernel

__all__ = [
    "PAIR_FEATURES",
    "ViewGeometry",
    "find_adjacent",
    "pair_features",
    "write_pair_features",
]

_ADJACENCY = np.dtype(
    [
        ("contact_m", "f4"),  # length of the border where the surface continues
        ("contact", "f4"),  # fractions of the border: where the surface continues,
        ("first_in_front", "f4"),  # and where one is in front
        ("second_in_front", "f4"),
        ("along_first", "f4"),  # fractions of the boundary of each at the depth of the other
        ("along_second", "f4"),
        ("second_faces_up", "f4"),  # fractions of the contact beyond which the other faces up
        ("first_faces_up", "f4"),
        ("above_second_m", "f4"),  # mean height of that contact above the top of the other
        ("above_first_m", "f4"),
        ("border_m", "f4"),
        ("concavity_deg", "f4"),  # mean concave angle of the contact
    ],
    align=True,
)
"""Features of the border between two segments."""
_RELATION = np.dtype(
    [
        ("area_ratio", "f4"),  # of the first to the second
        ("width_ratio", "f4"),
        ("lateral_distance", "f4"),  # divided by the larger width
        ("depth_difference_m", "f4"),
        ("depth_difference", "f4"),  # divided by the larger width
        ("overlap", "f4"),  # of the lateral ranges, divided by the smaller width
        ("top_over_top_m", "f4"),  # heights of the first above the second
        ("bottom_over_top_m", "f4"),
        ("other_bottom_over_top_m", "f4"),  # height of the second above the first
        ("bottom_over_bottom_m", "f4"),
        ("most_beyond_m", "f4"),  # extent of the first beyond the sides of the second
        ("least_beyond_m", "f4"),
        ("lateral_curvature", "f4"),  # of both together
        ("normal_position_correlation", "f4"),
        ("normal_cos", "f4"),  # cosine between the mean normals
        ("second_off_first_m", "f4"),  # distance of the middle of one from the mean plane of the
        ("first_off_second_m", "f4"),  # other, positive in front of it
        ("first_convexity", "f4"),  # number of cells divided by the area of their convex hull
        ("second_convexity", "f4"),
        ("both_convexity", "f4"),
        ("hull_growth", "f4"),  # area of the hull of both divided by the sum of each hull's area
        ("cells", "f4"),  # of the first
        ("cell_m", "f4"),  # width of a cell at the depth of the first
        ("down", "f4"),  # cosine between the optical axis and up
    ],
    align=True,
)
"""The relative position of two segments, and how well they are visible."""
PAIR_FEATURES = np.dtype(
    [
        ("adjacency", _ADJACENCY),
        ("first", SEGMENT_FEATURES),
        ("second", SEGMENT_FEATURES),
        ("relation", _RELATION),
    ],
    align=True,
)
"""The features of two segments, the one with the smaller area first; all are float32, lengths in
metres. The trees index them in this order. All pairs of a frame use the same record, so each pair
must write every field."""


class ViewGeometry(NamedTuple):
    """The focal length and the up direction of the view, for the features of pairs.

    Attributes
    ----------
    focal : focal length in cells.
    up : (3,) unit vector, sensor frame.
    """

    focal: float
    up: F8


@kernel
def find_adjacent(segments: Segments, p: int, view_geometry: ViewGeometry) -> Bool:
    """Return which segments may belong to the same object as segment ``p``: (n + 1,) bool.

    Such a segment is above the same plane as ``p``, and touches, faces or occludes ``p``, is near
    it, or is occluded by it. There is none if ``p`` has been merged into another.
    """
    pairs, parent, plane_id = segments.pairs, segments.parent, segments.plane_id
    adjacent = np.zeros(parent.size, np.bool_)
    for q in range(1, parent.size if parent[p] == p else 1):
        if q != p and parent[q] == q and plane_id[q] == plane_id[p]:
            border = pairs[p, q].contact + pairs[p, q].near + pairs[p, q].in_front
            border += pairs[q, p].in_front
            adjacent[q] = border >= MIN_LINKS or _face(segments, p, q, view_geometry)
    return adjacent


@kernel(inline=True)
def _face(segments: Segments, p: int, q: int, view_geometry: ViewGeometry) -> bool:
    """Return whether segments p and q may be the near and far wall of a pot, which do not touch.

    One wall is behind the other along the line of sight to them. This is not the optical axis: if
    the camera looks down, the walls of a pot at the left of the image are side by side.
    """
    a, b = segments.statistics[p], segments.statistics[q]
    if abs(a.top - b.top) >= MERGING.facing_m:
        return False
    (x, y, z), (u, v, w) = _mean_position(a), _mean_position(b)
    x, y, z = (x + u) / 2, (y + v) / 2, max((z + w) / 2, NEAREST_M)
    # the horizontal direction across the line of sight, in the image
    up = view_geometry.up
    sx, sy, sz = up[1] * z - up[2] * y, up[2] * x - up[0] * z, up[0] * y - up[1] * x
    angle = math.atan2(sy - sz * y / z, sx - sz * x / z)
    d = round(angle * DIRECTIONS / (2 * math.pi)) % DIRECTIONS
    opposite = (d + DIRECTIONS // 2) % DIRECTIONS
    hull, other = segments.hulls[p], segments.hulls[q]
    width, other_width = hull[d] + hull[opposite], other[d] + other[opposite]
    common = min(hull[d], other[d]) + min(hull[opposite], other[opposite])
    max_width = max(width, other_width) * z / view_geometry.focal
    overlap = common > MERGING.facing_share * min(width, other_width)
    return bool(overlap and _distance(a, b) < max_width)


@kernel(inner=True)
def _distance(a: Row, b: Row) -> float:
    """Return the distance between the mean positions of two `SEGMENT` records, metres."""
    (x, y, z), (u, v, w) = _mean_position(a), _mean_position(b)
    return math.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2)


@kernel
def pair_features(
    segments: Segments, p: int, q: int, view_geometry: ViewGeometry, out: Row
) -> None:
    """Write the `PAIR_FEATURES` of segments ``p`` and ``q`` to ``out``, from their statistics."""
    features = np.zeros(segments.parent.size, SEGMENT_FEATURES)
    write_segment_features(segments, p, features[p])
    write_segment_features(segments, q, features[q])
    write_pair_features(segments, features, p, q, view_geometry, out)


@kernel(inner=True)
def write_pair_features(
    segments: Segments, features: Records, p: int, q: int, view_geometry: ViewGeometry, out: Row
) -> None:
    """Do the work of `pair_features`, given the ``features`` of the segments.

    These (n + 1,) are `SEGMENT_FEATURES`; only those of ``p`` and ``q`` are read.
    """
    area_p, area_q = segments.statistics[p].area, segments.statistics[q].area
    if area_p > area_q or (area_p == area_q and p > q):
        p, q = q, p
    a, b = segments.statistics[p], segments.statistics[q]
    cell = mean_depth(a) / view_geometry.focal
    _write_adjacency(segments, p, q, cell, out.adjacency)
    out.first, out.second = features[p], features[q]
    relation = out.relation
    _write_relation(a, b, relation)
    hull_p, hull_q = segments.hulls[p], segments.hulls[q]
    area_first, area_second = hull_area(hull_p, hull_p), hull_area(hull_q, hull_q)
    hull = hull_area(hull_p, hull_q)
    relation.first_convexity = share(a.count, area_first)
    relation.second_convexity = share(b.count, area_second)
    relation.both_convexity = share(a.count + b.count, hull)
    relation.hull_growth = share(hull, area_first + area_second)
    merged = np.zeros(2, SEGMENT)
    merged[0], merged[1] = a, b
    add_statistics(merged, 0, 1)
    relation.lateral_curvature = lateral_curvature(merged[0])
    relation.normal_position_correlation = normal_position_correlation(merged[0])
    merged[1] = b  # numba frees the array after its last use, even if a record is read later
    relation.cells, relation.cell_m, relation.down = a.count, cell, view_geometry.up[2]


@kernel(inline=True)
def _write_adjacency(segments: Segments, p: int, q: int, cell: float, out: Row) -> None:
    """Write the `_ADJACENCY` features of the first segment p and the second, q, to ``out``.

    A cell is ``cell`` metres wide.
    """
    pair, reverse = segments.pairs[p, q], segments.pairs[q, p]
    border = pair.contact + pair.near + pair.in_front + reverse.in_front
    surface = pair.contact + pair.near
    out.contact_m = pair.contact * cell
    out.contact = share(pair.contact, border)
    out.first_in_front = share(pair.in_front, border)
    out.second_in_front = share(reverse.in_front, border)
    out.along_first = share(surface, segments.statistics[p].boundary)
    out.along_second = share(surface, segments.statistics[q].boundary)
    out.second_faces_up = share(pair.rests_on, pair.contact)
    out.first_faces_up = share(reverse.rests_on, pair.contact)
    out.above_second_m = _above_top(segments, p, q)
    out.above_first_m = _above_top(segments, q, p)
    out.border_m = border * cell
    out.concavity_deg = share(pair.concavity, pair.contact)


@kernel(inner=True)
def _above_top(segments: Segments, p: int, q: int) -> float:
    """Return the mean height, above the top of ``q``, at which ``p`` rests on ``q``, metres.

    Return `MERGING.no_contact_m` if it does not rest on ``q``.
    """
    contact = segments.pairs[p, q].rests_on
    if contact == 0:
        return MERGING.no_contact_m
    return float(segments.pairs[p, q].rests_on_height / contact - segments.statistics[q].top)


@kernel(inline=True)
def _write_relation(a: Row, b: Row, out: Row) -> None:
    """Write the fields of a `_RELATION` that compare two `SEGMENT` records, ``a`` the first."""
    width_a, width_b = width_of(a), width_of(b)
    max_width = max(width_a, width_b)
    left, right = b.left - a.left, a.right - b.right
    common = min(a.right, b.right) - max(a.left, b.left)
    out.area_ratio, out.width_ratio = share(a.area, b.area), share(width_a, width_b)
    out.lateral_distance = share(abs(a.left + a.right - b.left - b.right) / 2, max_width)
    out.depth_difference_m = depth_difference(a, b)
    out.depth_difference = share(depth_difference(a, b), max_width)
    out.overlap = share(common, min(width_a, width_b))
    out.top_over_top_m = a.top - b.top
    out.bottom_over_top_m = a.bottom - b.top
    out.other_bottom_over_top_m = b.bottom - a.top
    out.bottom_over_bottom_m = a.bottom - b.bottom
    out.most_beyond_m, out.least_beyond_m = max(left, right), min(left, right)
    (x, y, z), (u, v, w) = _mean_position(a), _mean_position(b)
    (nx, ny, nz), (mx, my, mz) = _mean_normal(a), _mean_normal(b)
    x, y, z = u - x, v - y, w - z  # from the middle of the first to that of the second
    out.normal_cos = nx * mx + ny * my + nz * mz
    out.second_off_first_m = x * nx + y * ny + z * nz
    out.first_off_second_m = -(x * mx + y * my + z * mz)


@kernel(inner=True)
def _mean_position(row: Row) -> tuple[float, float, float]:
    """Return the mean position x, y, z of a `SEGMENT`, metres, sensor frame."""
    n = max(row.fitted, np.float32(1))
    return row.position_x_sum / n, row.position_y_sum / n, row.position_z_sum / n


@kernel(inner=True)
def _mean_normal(row: Row) -> tuple[float, float, float]:
    """Return the mean normal x, y, z of a `SEGMENT`, a unit vector, sensor frame."""
    x, y, z = row.facing_x_sum, row.facing_y_sum, row.facing_z_sum
    length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    return x / length, y / length, z / length
