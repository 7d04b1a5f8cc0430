"""Tests of the steps of detection on small synthetic inputs with known results."""

from itertools import pairwise

import numpy as np
import pytest

from shapecat.arrays import freeze
from shapecat.detection.cleanup.holes import fill_holes
from shapecat.detection.connected_components import DOWN, RIGHT, spans_of
from shapecat.detection.depth_grid import DepthGrid, downsample
from shapecat.detection.foreground.convex_hull import fill_hull
from shapecat.detection.merging.pair_features import PAIR_FEATURES
from shapecat.detection.merging.segments import PAIR, SEGMENT, add_statistics
from shapecat.detection.planes import find_supporting_planes
from shapecat.detection.planes.extent import DIRECTIONS, SupportingPlane
from shapecat.detection.planes.height_map import HeightMap, measure_heights, pack_planes
from shapecat.detection.planes.plane_fit import horizontal_plane, plane_normal
from shapecat.detection.planes.ransac import draw_trials, ransac_plane, sample_grid
from shapecat.detection.segmentation.connectivity import SurfaceGraph, connect_surfaces
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.detection.segmentation.watershed import watershed
from shapecat.geometry import DISCONTINUITY
from shapecat.types import Camera
from tests.level_planes import INTRINSICS, UP, level


def test_ransac_finds_a_plane_among_outliers() -> None:
    """Half of the samples are outliers, which would bias a least-squares fit."""
    rng = np.random.default_rng(0)
    inv_depth = level()
    lost = rng.random(inv_depth.shape) < 0.5
    inv_depth[lost] = rng.uniform(0.5, 3, int(lost.sum()))
    samples = sample_grid(inv_depth, inv_depth)
    plane, count = ransac_plane(samples, draw_trials(rng), INTRINSICS, UP, (0.9, 1.0), 0.01)
    np.testing.assert_allclose(plane, horizontal_plane(INTRINSICS, UP, -0.7), atol=2e-3)
    assert plane_normal(plane, INTRINSICS) @ UP > 0.9999
    assert 0.45 < count / samples.inverse_depth.size < 0.6


def test_two_samples_give_no_plane() -> None:
    inv_depth = np.zeros((240, 320), np.float32)
    inv_depth[:5, :5] = 1
    samples = sample_grid(inv_depth, inv_depth)
    trials = draw_trials(np.random.default_rng(0))
    assert ransac_plane(samples, trials, INTRINSICS, UP, (0.9, 1.0), 0.01)[1] == 0


def test_samples_beyond_the_edge_of_a_plane_have_no_height() -> None:
    """An object beside a table is not on the table, however high it is."""
    inv_depth = level()
    inv_depth[:, 200:] = 0
    board = inv_depth.copy()
    inv_depth[100:140, 80:120] = level(0.62)[100:140, 80:120]  # a box of 8 cm
    inv_depth[100:140, 280:300] = level(0.62)[100:140, 280:300]  # and one beyond the edge
    trials = draw_trials(np.random.default_rng(0))
    grid = DepthGrid(board, INTRINSICS, 2, DISCONTINUITY)
    found, _ = find_supporting_planes(grid, UP, trials, max_height_m=0.5, upright=True)
    planes = pack_planes(found)
    assert len(found) == 1
    heights = measure_heights(DepthGrid(inv_depth, INTRINSICS, 2, DISCONTINUITY), planes, 0.6)
    assert (heights.plane_id[105:135, 85:115] == 1).all()
    np.testing.assert_allclose(heights.height[105:135, 85:115], 0.08, atol=1e-4)
    assert (heights.plane_id[100:140, 285:] == 0).all()
    assert (heights.plane_id[180:200, 20:100] == -1).all()


def test_far_sample_below_a_plane_by_noise_is_on_it() -> None:
    """Far away, noise reaches many metres: a sample 15 m below a plane still is at its height."""
    extent = np.full(DIRECTIONS, 1000.0)
    plane = SupportingPlane(*_level_plane(40.0), UP, -40.0, extent, 1.0)
    inv_depth = np.zeros((240, 320), np.float32)
    inv_depth[60, 100] = level(40.0)[60, 100] / (1 + 15 / 40)  # 15 m below the plane
    heights = measure_heights(
        DepthGrid(inv_depth, INTRINSICS, 2, DISCONTINUITY), pack_planes([plane]), 0.6
    )
    assert heights.plane_id[60, 100] == -1
    np.testing.assert_allclose(heights.height[60, 100], -15, atol=0.01)


def _level_plane(below_m: float) -> tuple[float, float, float]:
    a, b, c = horizontal_plane(INTRINSICS, UP, -below_m).tolist()
    return a, b, c


@pytest.mark.parametrize(("rise", "segments"), [(0.0, 1), (1.0, 2)])
def test_watershed_splits_faces_at_a_concave_edge(rise: float, segments: int) -> None:
    """A flat face is one segment; a face that bends towards the camera is two."""
    inv_depth = np.zeros((240, 320), np.float32)
    y = (np.arange(90, 150) - INTRINSICS.cy) / INTRINSICS.fy
    edge = y[30]
    # depth z on the planes z = 0.8 and z = 0.8 - rise (Y - Y_edge) below the edge
    below = (0.8 + rise * edge * 0.8) / (1 + rise * y)
    z = np.where(y > edge, below, 0.8)
    inv_depth[90:150, 120:200] = (1 / z)[:, None].astype(np.float32)
    plane_id = (inv_depth > 0).astype(np.int8)
    heights = HeightMap(plane_id, np.where(plane_id, 0.1, 0).astype(np.float32))
    graph = connect_surfaces(DepthGrid(inv_depth, INTRINSICS, 2, DISCONTINUITY), heights)

    labels, n = watershed(heights, graph)

    assert n == segments
    assert (labels[90:150, 120:200] > 0).all()
    assert (labels[90, 120] != labels[149, 120]) == (segments == 2)


def test_crowded_image_keeps_its_largest_segments() -> None:
    """Speckle at the top of an image must not use up the segments of the objects below it."""
    plane_id = np.zeros((240, 320), np.int8)
    for i in range(0, 60, 6):
        for j in range(0, 318, 6):
            plane_id[i : i + 4, j : j + 4] = 1
    plane_id[100:140, 100:140] = 1
    links = np.full(plane_id.shape, RIGHT | DOWN, np.uint8)
    blank = np.zeros((0, 3, 0), np.float32)
    flat = np.zeros(plane_id.shape, np.uint8)
    heights = HeightMap(plane_id, np.zeros(plane_id.shape, np.float32))

    labels, n = watershed(heights, SurfaceGraph(blank, blank, links, flat, spans_of(plane_id)))

    assert n == SEGMENTATION.max_segments
    assert (labels[100:140, 100:140] == n).all()
    assert np.unique(labels).tolist() == [*range(n + 1)]


@pytest.mark.parametrize("distance", [0.3, 0.45, 0.9])
def test_slanted_face_is_one_segment_at_any_distance(distance: float) -> None:
    """Near the camera, its inverse depth changes by more than 0.012 1/m from cell to cell."""
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    slope = 1.2 * (np.arange(480)[:, None] - camera.cy) / camera.fy
    depth = np.broadcast_to(distance / (1 + slope), (480, 640)).astype(np.float32)
    grid = downsample(depth[140:340].copy(), camera, range_m=3.0)
    assert grid is not None
    face = np.ones(grid.inverse_depth.shape, np.int8)
    heights = HeightMap(face, np.full(face.shape, 0.1, np.float32))
    labels, n = watershed(heights, connect_surfaces(grid, heights))
    assert n == 1
    assert (labels == 1).all()


def test_convex_hull_of_an_l_is_filled() -> None:
    """Cells between the arms are inside the hull, those beyond are not."""
    residual = np.ones((12, 12), np.float32)
    part, stack = np.zeros((12, 12), np.int32), np.zeros(144, np.int32)
    cells = [(i, 2) for i in range(2, 9)] + [(8, j) for j in range(3, 9)]
    for n, (i, j) in enumerate(cells):
        part[i, j], stack[n] = 7, i * 12 + j
    count = fill_hull(residual, part, stack, len(cells))
    assert part[6, 4] == 7
    assert part[3, 7] == 0
    assert count == np.count_nonzero(part == 7)


def test_enclosed_holes_are_filled_and_open_ones_are_not() -> None:
    inv_depth = np.full((40, 40), 1.25, np.float32)
    labels = np.zeros((40, 40), np.int16)
    labels[10:30, 10:30] = 1
    labels[18:22, 18:22] = 0
    labels[14:16, 10:20] = 0  # open to the left
    filled = np.zeros((40, 40), np.uint8)
    fill_holes(DepthGrid(inv_depth, INTRINSICS, 2, DISCONTINUITY), labels, 1, filled)
    assert (labels[18:22, 18:22] == 1).all()
    assert (filled[18:22, 18:22] == 1).all()
    assert (labels[14:16, 10:20] == 0).all()


def test_statistics_of_two_segments_add_up() -> None:
    """Ranges are joined and sums added; a forgotten field would be lost in every merge."""
    segments = np.zeros(2, SEGMENT)
    for k, name in enumerate(SEGMENT.names or ()):
        segments[name] = k + 1, 100 + k
    a, b = segments.copy()
    add_statistics(segments, 0, 1)
    for name in SEGMENT.names or ():
        join = {"left": min, "bottom": min, "right": max, "top": max}.get(name)
        assert segments[name][0] == (join(a[name], b[name]) if join else a[name] + b[name]), name
        assert segments[name][1] == b[name]


def test_feature_records_are_contiguous_floats() -> None:
    """The trees read a record as one row of float32."""
    assert PAIR_FEATURES.itemsize == 4 * 70
    assert SEGMENT.itemsize == 4 * len(SEGMENT.names or ())
    assert PAIR.itemsize == 4 * len(PAIR.names or ())


def test_downsampling_keeps_the_nearer_side_of_an_edge() -> None:
    """Averaging both sides would create a surface between them."""
    depth = np.full((480, 640), 0.9, np.float32)
    depth[:, 321:] = 0.7
    camera = Camera(640, 480, 525, 525, 319.5, 239.5)
    grid = downsample(freeze(depth, "v u", "f4"), camera, range_m=2.0)
    assert grid is not None
    assert grid.factor == 2
    np.testing.assert_allclose(np.unique(grid.inverse_depth), [1 / 0.9, 1 / 0.7], rtol=1e-6)
    assert all(a <= b for a, b in pairwise(grid.inverse_depth[100]))
