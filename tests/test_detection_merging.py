"""Tests of adjacency, pair features and merging, on a few synthetic segments."""

import numpy as np
import pytest

from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics, project
from shapecat.detection.merging import across_occlusion
from shapecat.detection.merging.across_occlusion import merge_across_occluder
from shapecat.detection.merging.adjacency import measure_adjacency
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    find_adjacent,
    pair_features,
)
from shapecat.detection.merging.segment_features import (
    SEGMENT_FEATURES,
    share,
    write_segment_features,
)
from shapecat.detection.merging.segments import Segments, measure_segments, merge
from shapecat.detection.merging.settings import MERGING
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import SurfaceGraph, connect_surfaces
from shapecat.geometry import DISCONTINUITY
from tests.test_detection import Array

INTRINSICS = PinholeIntrinsics(250.0, 250.0, 99.5, 74.5)
UP = np.array([0.0, -1.0, 0.0])
"""Up direction for a camera that looks straight ahead."""
VIEW = ViewGeometry(INTRINSICS.fx, UP)


def measured(depth: Array, labels: Array) -> tuple[Segments, SurfaceGraph, DepthGrid]:
    """Return the segments with these labels in a depth image (150, 200), their graph and grid.

    Depth is in metres, and 0 where there is nothing.
    """
    with np.errstate(divide="ignore"):
        inv_depth = np.where(depth > 0, 1 / depth, 0).astype(np.float32)
    grid = DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY)
    plane_id = (labels > 0).astype(np.int8)
    y = (np.arange(150)[:, None] - INTRINSICS.cy) / INTRINSICS.fy * depth
    heights = HeightMap(plane_id, np.where(labels > 0, 0.25 - y, 0).astype(np.float32))
    graph = connect_surfaces(grid, heights)
    labels = labels.astype(np.int16)
    segments = measure_segments(grid, heights, graph, labels, int(labels.max()), UP)
    measure_adjacency(grid, heights, graph, labels, UP, segments)
    return segments, graph, grid


def two_boxes(gap_m: float) -> tuple[Array, Array]:
    """Return depth and labels of two faces side by side, the right one ``gap_m`` farther away."""
    depth, labels = np.zeros((150, 200)), np.zeros((150, 200), np.int16)
    depth[50:100, 50:100], labels[50:100, 50:100] = 0.8, 1
    depth[40:100, 100:140], labels[40:100, 100:140] = 0.8 + gap_m, 2
    return depth, labels


def test_touching_boxes_are_adjacent() -> None:
    segments, _, _ = measured(*two_boxes(0))
    first, second = segments.statistics[1], segments.statistics[2]
    assert first["count"] == 50 * 50
    assert first["right"] - first["left"] == pytest.approx(49 / 250 * 0.8, rel=1e-3)
    assert second["top"] - first["top"] == pytest.approx(10 / 250 * 0.8, rel=1e-3)
    assert first["area"] == pytest.approx(0.16**2, rel=0.05)
    assert segments.pairs[1, 2]["contact"] == segments.pairs[2, 1]["contact"] == 50
    assert segments.pairs[1, 2]["in_front"] == segments.pairs[2, 1]["in_front"] == 0
    assert find_adjacent(segments, 1, VIEW)[2]


def test_an_occluding_box_is_adjacent_to_the_box_behind_it() -> None:
    segments, _, _ = measured(*two_boxes(0.1))
    assert segments.pairs[1, 2]["contact"] == 0
    assert segments.pairs[1, 2]["in_front"] == 50
    assert segments.pairs[2, 1]["in_front"] == 0


def test_features_of_two_boxes() -> None:
    segments, _, _ = measured(*two_boxes(0))
    out = np.zeros(1, PAIR_FEATURES)
    pair_features(segments, 2, 1, VIEW, out[0])
    assert out["adjacency"]["contact"] == 1
    assert out["adjacency"]["contact_m"] == pytest.approx(50 / 250 * 0.8, rel=1e-3)
    assert out["relation"]["top_over_top_m"] == pytest.approx(0.032, rel=1e-3)  # smaller first
    assert abs(out["relation"]["lateral_curvature"][0]) < 0.1
    relation = out["relation"][0]
    assert relation["normal_cos"] == pytest.approx(1, abs=1e-3)
    assert abs(relation["second_off_first_m"]) < 1e-3  # one plane
    # The hull closes a corner of 10 by 50 cells with a line, and adds half of it.
    assert relation["first_convexity"] == pytest.approx(1, rel=0.02)
    assert relation["both_convexity"] == pytest.approx(4900 / 5150, rel=0.04)
    assert relation["hull_growth"] == pytest.approx(5150 / 4900, rel=0.04)
    segment = np.zeros(1, SEGMENT_FEATURES)
    write_segment_features(segments, 1, segment[0])
    assert segment["filled"] == pytest.approx(1, rel=0.06)
    assert segment["facing_up"] == 0
    assert share(1, 0) == 0


def test_features_of_two_planes_that_meet_in_a_corner() -> None:
    """Two faces in a concave corner are usually two objects."""
    depth, labels = np.zeros((150, 200)), np.zeros((150, 200), np.int16)
    across = (np.arange(200) - INTRINSICS.cx) / INTRINSICS.fx
    depth[50:100, 50:150] = (1 / (1 + abs(across)))[50:150]
    labels[50:100, 50:100], labels[50:100, 100:150] = 1, 2
    segments, _, _ = measured(depth, labels)
    out = np.zeros(1, PAIR_FEATURES)
    pair_features(segments, 1, 2, VIEW, out[0])
    relation = out["relation"][0]
    assert relation["normal_cos"] == pytest.approx(0, abs=0.1)
    middle = (across * depth[75])[100:150].mean()  # as far in front of the corner as beside it
    assert relation["second_off_first_m"] == pytest.approx(2**0.5 * middle, rel=0.1)
    assert relation["first_off_second_m"] == pytest.approx(2**0.5 * middle, rel=0.1)
    assert out["adjacency"]["concavity_deg"] == pytest.approx(90, abs=15)


def test_merging_adds_up_the_statistics() -> None:
    segments, _, _ = measured(*two_boxes(0))
    merge(segments, 1, 2)
    assert segments.parent.tolist() == [0, 1, 1]
    assert segments.statistics[1]["count"] == 50 * 50 + 60 * 40
    assert not segments.pairs[1, 1]["contact"]
    assert not find_adjacent(segments, 1, VIEW)[2]
    assert (segments.samples[1] >= 0).all()


def behind_a_post(offset_m: float) -> tuple[Array, Array]:
    """Return depth and labels of a panel behind a post; the right part is ``offset_m`` farther."""
    depth, labels = np.zeros((150, 200)), np.zeros((150, 200), np.int16)
    depth[50:100, 40:90], labels[50:100, 40:90] = 1.0, 1
    depth[50:100, 100:150], labels[50:100, 100:150] = 1.0 + offset_m, 2
    depth[40:110, 90:100], labels[40:110, 90:100] = 0.7, 3
    return depth, labels


@pytest.mark.parametrize(("offset_m", "merged"), [(0.0, True), (0.05, False)])
def test_coplanar_parts_behind_a_post_are_merged(offset_m: float, *, merged: bool) -> None:
    depth, labels = behind_a_post(offset_m)
    segments, graph, grid = measured(depth, labels)
    merge_across_occluder(segments, grid, graph.normal, labels)
    assert (segments.parent[2] == 1) == merged
    assert segments.parent[3] == 3


def test_coplanar_parts_without_an_occluder_are_not_merged() -> None:
    depth, labels = behind_a_post(0)
    depth[labels == 3], labels[labels == 3] = 0, 0
    segments, graph, grid = measured(depth, labels)
    merge_across_occluder(segments, grid, graph.normal, labels)
    assert segments.parent.tolist() == [0, 1, 2]


def test_point_just_outside_the_image_is_in_no_cell() -> None:
    """Rounded towards zero, it would count as hidden by what is in the first row or column."""
    x, y = (np.array([-0.6, -1.4]) - [INTRINSICS.cx, INTRINSICS.cy]) / INTRINSICS.fx

    assert project(INTRINSICS, x, y, 1.0) == (-1, -1)


def test_number_of_lines_between_two_parts_is_limited() -> None:
    """Their cost grows with their number, and coplanar parts have a pair for any two samples."""
    planes = np.zeros((2, 24, 3))
    planes[0, :, 0], planes[1, :, 2] = np.linspace(0, 0.1, 24), 1

    share_of_partners, lines = across_occlusion._find_partners(planes, planes)

    assert share_of_partners == 1
    assert 24 * 24 / 3 < len(lines) <= MERGING.max_lines
