"""Tests of cleanup: structure rejection, and completed labels."""

import numpy as np
import pytest

from shapecat.config import DetectionSettings
from shapecat.detection.cleanup.context import add_context, measure_borders
from shapecat.detection.cleanup.holes import fill_holes
from shapecat.detection.cleanup.object_features import (
    OBJECT_FEATURES,
    ViewLimits,
    _border_lines,
    _measure,
    measure_object_features,
)
from shapecat.detection.cleanup.structure import (
    RejectionTrees,
    find_background,
    load_trees,
    logits_of,
    number_objects,
)
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics, downsample
from shapecat.detection.merging.segments import _blank, roots_of
from shapecat.detection.pipeline import Task, merge_segments, model_planes, oversegment
from shapecat.detection.planes.height_map import PLANE, HeightMap
from shapecat.detection.records import OverSegmentation, PlaneModel
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.geometry import DISCONTINUITY
from shapecat.trees import BoostedTrees, Trees
from tests.test_detection import Array, Shape, box, frame_of, render, table

_NODE = Trees(
    *(np.zeros(1, kind) for kind in ("i4", "i2")), *(np.zeros(1, kind) for kind in ("f4", "i4"))
)
_LEAF = BoostedTrees(_NODE, np.ones(1, np.float32))
ALWAYS = RejectionTrees(_LEAF, _LEAF)
"""Trees that accept everything as an object."""
INTRINSICS = PinholeIntrinsics(262.5, 262.5, 19.5, 19.5)


def features_of(shapes: list[Shape], tilt_deg: float) -> tuple[Array, Array]:
    """Return the object features (n,) of the segments on a table, and which are rejected (n,).

    The camera looks down by ``tilt_deg``. Segments that were merged into others are left out.
    """
    depth, _ = render(shapes, tilt_deg=tilt_deg)
    frame, settings = frame_of(depth), DetectionSettings()
    assert frame.depth is not None
    assert frame.camera is not None
    grid = downsample(frame.depth, frame.camera, range_m=settings.max_range_m)
    assert grid is not None
    model = model_planes(grid, None, Task(settings, np.random.default_rng(0)))
    assert model is not None
    oversegmentation = oversegment(grid, model)
    merge_segments(grid, model, oversegmentation)
    features = measure_object_features(grid, model, oversegmentation, settings.max_range_m)
    segments = oversegmentation.segments
    rejected = find_background(segments, features, grid, settings, load_trees())
    used = features["visibility"]["cells"] > 0
    return features[used], rejected[used]


def test_box_inside_outline_of_table_is_kept() -> None:
    """Its features must not say that a border, a wall or the range limit cuts it."""
    features, rejected = features_of([table(), box((0, 0, 0), (0.1, 0.08, 0.12))], tilt_deg=35)
    assert len(features) == 1
    around, segment = features["surroundings"][0], features["segment"][0]
    ends = ("image_border", "range_limit", "on_wall", "beyond", "into_wall")
    assert [around[name] for name in ends] == [0] * 5
    assert -0.6 < around["least_outside_m"] <= around["mean_outside_m"]
    assert around["mean_outside_m"] <= around["most_outside_m"] < -0.2
    assert segment["top_m"] == pytest.approx(0.12, abs=0.01)
    assert segment["width_m"] == pytest.approx(0.1, abs=0.015)
    assert not rejected.any()


def test_height_and_noise_of_plane_around_segment_are_measured() -> None:
    """Four cells away, samples are 1 mm below the plane (left) and 3 mm above it (right)."""
    labels, plane_id = np.zeros((11, 11), np.int16), np.full((11, 11), -1, np.int8)
    labels[5, 5] = plane_id[5, 5] = 1
    plane_id[:, 10] = plane_id[1] = plane_id[9] = 0  # no plane above and below, nor at the border
    height = np.full((11, 11), 0.9, np.float32)
    height[5, 1], height[5, 9] = -0.001, 0.003
    segments, features = _blank(2), np.zeros(2, OBJECT_FEATURES)
    segments.statistics["count"], segments.statistics["depth_sum"] = 1, 2.0
    segments.plane_id[:] = 1
    grid = DepthGrid(np.full((11, 11), 0.5, np.float32), INTRINSICS, 1, DISCONTINUITY)
    walls, spans = np.zeros((11, 11), np.uint8), np.tile(np.array([0, 11], np.int32), (11, 1))
    planes = np.zeros(1, PLANE)
    low_profile = np.zeros((11, 11), np.bool_)
    heights = HeightMap(plane_id, height)
    model = PlaneModel(np.array([0.0, 0.0, 0.7]), planes, heights, low_profile, walls)
    local_plane, none = np.zeros((11, 3, 11), np.float32), np.zeros((11, 11), np.uint8)
    graph = SurfaceGraph(local_plane, local_plane, none, none, spans)
    parts = OverSegmentation(graph, labels, segments)
    _measure(grid, model, parts, ViewLimits(-1, -1, -1, -1, 0.25), features)
    rows = features["surroundings"]
    least = 0.004 + 0.0025 * 2.0**2
    assert rows["plane_height"][1] == pytest.approx(0.001 / least)
    assert rows["plane_noise"][1] == pytest.approx(0.002 / least)


@pytest.mark.parametrize(("height_m", "shares"), [(0.008, (0.8, 1.0)), (0.12, (0.0, 0.0))])
def test_share_of_low_profile_cells_is_measured(height_m: float, shares: Array) -> None:
    """The trees keep what is thin if it is a low-profile object, and not noise."""
    slab = box((0, 0, 0), (0.12, 0.1, height_m))
    features, rejected = features_of([table(), slab], tilt_deg=35)
    assert len(features) == 1
    assert shares[0] <= features["surroundings"]["low_profile"][0] <= shares[1]
    assert not rejected.any()


def _features(cells: int) -> Array:
    """Return the features of a segment with some cells, 1 m away; all others are 0."""
    features = np.zeros(2, OBJECT_FEATURES)
    features["visibility"]["cells"], features["visibility"]["depth_m"] = cells, 1.0
    return features


def test_segment_wider_than_objects_is_rejected() -> None:
    segments = _blank(2)
    features = _features(400)
    features["segment"]["width_m"] = 0.2
    grid = DepthGrid(np.zeros((40, 40), np.float32), INTRINSICS, 1, DISCONTINUITY)
    for widest, expected in ((0.1, True), (0.3, False)):
        settings = DetectionSettings(max_size_m=widest)
        assert find_background(segments, features, grid, settings, ALWAYS)[1] == expected


def test_segment_near_maximum_height_is_rejected() -> None:
    """As docs/reference.md says, objects must end 2 cm below the limit."""
    features = _features(400)
    features["segment"]["top_m"] = 0.1
    grid = DepthGrid(np.zeros((40, 40), np.float32), INTRINSICS, 1, DISCONTINUITY)
    for highest, expected in ((0.119, True), (0.121, False)):
        settings = DetectionSettings(max_height_m=highest)
        assert find_background(_blank(2), features, grid, settings, ALWAYS)[1] == expected


@pytest.mark.parametrize(("cells", "border"), [(400, 0.5), (31, 0.5), (400, 0.3)])
def test_large_segment_cut_by_border_is_rejected_as_arm(cells: int, border: float) -> None:
    features = _features(cells)
    features["surroundings"]["image_border"] = border
    grid = DepthGrid(np.zeros((40, 40), np.float32), INTRINSICS, 1, DISCONTINUITY)
    found = find_background(_blank(2), features, grid, DetectionSettings(), ALWAYS)[1]
    assert found == (cells > 100 and border > 0.4)


@pytest.mark.parametrize(("cells", "rejected"), [(29, True), (31, False)])
def test_tiny_segment_is_rejected_before_holes_are_filled(cells: int, rejected: bool) -> None:
    """Otherwise the segment would split a hole in an object."""
    grid = DepthGrid(np.zeros((40, 40), np.float32), INTRINSICS, 1, DISCONTINUITY)
    found = find_background(_blank(2), _features(cells), grid, DetectionSettings(), ALWAYS)
    assert found[1] == rejected  # the smallest object covers 60 cells here


@pytest.mark.parametrize(
    ("alone", "in_context", "rejected"),
    [(2.9, -0.1, True), (-2.9, 0.1, False), (3.1, -9.0, False), (-3.1, 9.0, True)],
)
def test_context_decides_only_uncertain_segments(
    alone: float, in_context: float, rejected: bool
) -> None:
    features = _features(400)
    grid = DepthGrid(np.zeros((200, 200), np.float32), INTRINSICS, 1, DISCONTINUITY)
    trees = RejectionTrees(
        *(_LEAF._replace(value=np.array([v], np.float32)) for v in (alone, in_context))
    )
    found = find_background(_blank(2), features, grid, DetectionSettings(), trees)
    assert found[1] == rejected


@pytest.mark.parametrize(
    ("cells", "logit", "rejected"),
    [(780, -0.1, True), (820, -0.1, False), (820, -0.9, False), (820, -1.1, True)],
)
def test_large_objects_need_less_evidence(cells: int, logit: float, *, rejected: bool) -> None:
    """Users notice the loss of a large object first."""
    grid = DepthGrid(
        np.zeros((200, 200), np.float32), INTRINSICS, 1, DISCONTINUITY
    )  # 2 % are 800 cells
    leaf = _LEAF._replace(value=np.array([logit], np.float32))
    trees = RejectionTrees(leaf, leaf)
    found = find_background(_blank(2), _features(cells), grid, DetectionSettings(), trees)
    assert found[1] == rejected


def test_logits_are_clipped() -> None:
    """Context features then have the same range in training and in use."""
    for value, expected in ((9.0, 4.0), (-9.0, -4.0), (1.5, 1.5)):
        trees = _LEAF._replace(value=np.array([value], np.float32))
        assert logits_of(np.zeros((1, 1), np.float32), trees).tolist() == [expected]


def test_context_weights_neighbours_by_border_length() -> None:
    """Of four segments, two are merged; the background occludes part of an object."""
    segments = _blank(5)
    segments.parent[:] = [0, 1, 2, 2, 4]
    segments.pairs["contact"][1, 2], segments.pairs["contact"][2, 4] = 6, 2
    segments.pairs["contact"][2, 2] = 9  # within a merged segment
    segments.pairs["in_front"][4, 1], segments.pairs["near"][4, 2] = 3, 1
    roots = roots_of(segments)
    assert roots.tolist() == [1, 2, 4]
    borders = measure_borders(segments, roots)
    features = np.zeros(3, OBJECT_FEATURES)
    features["segment"]["width_m"] = [0.1, 0.2, 0.3]
    found = add_context(features, np.array([8.0, -1.0, -4.0], np.float32), borders)
    assert found["object"]["segment"]["width_m"] == pytest.approx([0.1, 0.2, 0.3])
    assert found["logit"].tolist() == [8, -1, -4]
    yes, uncertain, no = np.tanh([2, -0.25, -1])
    assert found["connected"] == pytest.approx([uncertain, (6 * yes + 2 * no) / 8, uncertain])
    assert found["behind"] == pytest.approx([0, 0, yes])
    assert found["in_front"] == pytest.approx([no, 0, 0])
    assert found["near"] == pytest.approx([0, no, uncertain])


def test_image_border_is_where_samples_begin() -> None:
    """A sensor may leave a straight strip of 12 % empty; a wider gap is not a border."""
    inv_depth = np.zeros((100, 200), np.float32)
    inv_depth[11:60, 0:178] = 1
    grid = DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY)
    assert _border_lines(grid) == (11, 99, 0, 177)
    inv_depth[11:20, 50:] = 0  # the top of an object
    assert _border_lines(grid) == (0, 99, 0, 177)


def test_hole_is_filled_with_enclosing_object() -> None:
    """A can in front of the ring hides part of the hole, but does not get the rest."""
    inv_depth = np.full((40, 40), 1.25, np.float32)
    labels, filled = np.zeros((40, 40), np.int16), np.zeros((40, 40), np.uint8)
    labels[10:30, 10:30] = 1
    labels[15:25, 15:25] = 0
    labels[20:35, 18:21], inv_depth[20:35, 18:21] = 2, 1.4
    hole = labels[15:25, 15:25] == 0
    fill_holes(DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY), labels, 2, filled)
    assert (labels[15:25, 15:25][hole] == 1).all()
    assert filled.sum() == hole.sum()


def test_gap_between_two_boxes_is_not_a_hole() -> None:
    """Each box has half of the boundary of the gap."""
    inv_depth = np.full((40, 40), 1.25, np.float32)
    labels, filled = np.zeros((40, 40), np.int16), np.zeros((40, 40), np.uint8)
    labels[10:30, 5:35] = 1
    labels[20:30] *= 2
    labels[17:23, 15:25] = 0
    fill_holes(DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY), labels, 2, filled)
    assert not filled.any()


@pytest.mark.parametrize(("width", "torn", "filled"), [(20, 0, True), (20, 3, True), (5, 0, False)])
def test_mouth_of_cup_seen_from_above_is_filled(width: int, torn: int, filled: bool) -> None:
    """The floor of a cup is behind its rim, like background in a handle, whose hole is smaller.

    Edges may lack depth.
    """
    inv_depth = np.full((40, 40), 1.25, np.float32)
    labels, cells = np.zeros((40, 40), np.int16), np.zeros((40, 40), np.uint8)
    hole = slice(20 - width // 2, 20 - width // 2 + width)
    labels[7:33, 7:33] = 1
    labels[hole, hole], inv_depth[hole, hole] = 0, 0
    floor = slice(hole.start + torn, hole.stop - torn)
    inv_depth[floor, floor] = 1.1
    fill_holes(DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY), labels, 1, cells)
    assert (labels[floor, floor] == filled).all()
    assert cells.sum() == filled * (width - 2 * torn) ** 2


def test_table_between_the_parts_of_a_drill_is_not_a_hole() -> None:
    """Motor, grip and base enclose it on three sides, and it is larger than they are.

    It would make a real drill 25 instead of 18 cm wide.
    """
    inv_depth = np.full((40, 40), 1.25, np.float32)
    labels, filled = np.zeros((40, 40), np.int16), np.zeros((40, 40), np.uint8)
    labels[5:9, 5:30] = labels[9:30, 5:9] = labels[30:34, 5:30] = 1
    inv_depth[labels == 0] = 1.1
    labels[2:38, 36] = 2  # another object farther right, so that the rows end there
    fill_holes(DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY), labels, 2, filled)
    assert not filled.any()


def test_background_of_large_image_is_not_a_hole() -> None:
    """The product of its open sides (six gaps of a rack) and its cells exceeds 32 bits."""
    inv_depth = np.full((632, 632), 0.5, np.float32)
    labels, filled = np.zeros((632, 632), np.int16), np.zeros((632, 632), np.uint8)
    labels[[0, 3]] = labels[:, [0, -1]] = 1
    labels[3, 100:601:100], labels[-1, 100:601:100] = 0, 1
    fill_holes(DepthGrid(inv_depth, INTRINSICS, 1, DISCONTINUITY), labels, 1, filled)
    assert not filled.any()


def test_remaining_objects_are_numbered_in_segment_order() -> None:
    """Segments 2 and 4 are merged into 1 and 3, and 3 is rejected."""
    parent = np.array([0, 1, 1, 3, 3, 5], np.int16)
    rejected = np.array([False, False, False, True, False, False])
    labels = np.array([[0, 1, 2], [3, 4, 5]], np.int16)
    spans = np.array([[1, 3], [0, 3]], np.int32)

    assert number_objects(parent, rejected, labels, spans).tolist() == [0, 1, 5]
    assert labels.tolist() == [[0, 1, 1], [0, 0, 2]]
