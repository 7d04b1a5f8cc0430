"""Tests of foreground and planes on small synthetic images."""

import numpy as np
import pytest

from shapecat.arrays import F4, F8, Records
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.foreground.depth_error import filter_high_pass, measure_noise
from shapecat.detection.foreground.low_profile import find_low_profile
from shapecat.detection.foreground.outline import Outline, is_object
from shapecat.detection.foreground.overhang import extend_overhang
from shapecat.detection.foreground.settings import LOW
from shapecat.detection.foreground.walls import CLEARED, ON_WALL, remove_walls
from shapecat.detection.planes.extent import (
    DIRECTIONS,
    SupportingPlane,
    measure_candidate,
    outline_corners,
)
from shapecat.detection.planes.height_map import (
    HeightMap,
    distance_outside,
    measure_heights,
    pack_planes,
)
from shapecat.detection.planes.horizontal import find_horizontal_planes
from shapecat.detection.planes.oriented_points import level_samples, orient_points
from shapecat.detection.planes.plane_fit import horizontal_plane
from shapecat.detection.planes.ransac import draw_trials
from shapecat.detection.planes.supporting import supporting_planes
from shapecat.geometry import DISCONTINUITY
from tests.level_planes import INTRINSICS, RAY_HEIGHTS, UP, I, J, level


def grid_of(inv_depth: F4) -> DepthGrid:
    return DepthGrid(np.ascontiguousarray(inv_depth, np.float32), INTRINSICS, 2, DISCONTINUITY)


def plane_of(grid: DepthGrid, below_m: float) -> SupportingPlane:
    samples, _ = level_samples(orient_points(grid), UP)
    plane: F8 = horizontal_plane(INTRINSICS, UP, -below_m)
    return measure_candidate(grid, samples, plane).plane


def heights_of(grid: DepthGrid, plane: SupportingPlane) -> tuple[HeightMap, Records]:
    planes = pack_planes([plane])
    return measure_heights(grid, planes, 0.5), planes


def test_oriented_points_have_surface_normals() -> None:
    """Half of the image is a table, the other half is empty."""
    inv_depth = level(0.7)
    inv_depth[:, 160:] = 0
    points = orient_points(grid_of(inv_depth))
    valid = points.normals[2] != 0
    assert np.count_nonzero(valid) == points.smooth
    assert 0.9 < points.smooth / (80 * 53) < 1
    np.testing.assert_allclose(UP @ points.normals[:, valid], 1, atol=1e-4)
    np.testing.assert_allclose(UP @ points.positions[:, valid], -0.7, atol=1e-4)


def test_parallel_planes_have_one_normal() -> None:
    """A box of 12 cm is on a table; noise would tilt planes that are fitted separately."""
    rng = np.random.default_rng(0)
    inv_depth = level(0.7)
    inv_depth[90:180, 110:220] = level(0.58)[90:180, 110:220]
    inv_depth += rng.normal(0, 0.002, inv_depth.shape).astype(np.float32)
    grid = grid_of(inv_depth)
    found = find_horizontal_planes(grid, orient_points(grid), UP, draw_trials(rng))
    np.testing.assert_allclose([one.plane.offset for one in found], [-0.7, -0.58], atol=2e-3)
    np.testing.assert_allclose(found[0].plane.up, found[1].plane.up)
    assert found[0].plane.up @ UP > np.cos(np.radians(0.5))


def test_rectangular_plane_has_true_outline_and_area() -> None:
    """A board of 40 by 30 cm, 70 cm below the camera."""
    z = -0.7 / RAY_HEIGHTS
    x, y, depth = (J - 159.5) / 262.5 * z, (I - 119.5) / 262.5 * z, z
    forward = np.array([0, -np.sqrt(0.5), np.sqrt(0.5)])
    across, along = x, forward[1] * y + forward[2] * depth
    board = (abs(across) < 0.2) & (abs(along - 0.7) < 0.15)
    plane = plane_of(grid_of(np.where(board, level(0.7), 0)), 0.7)
    corners = outline_corners(plane.up, plane.offset, plane.extent)
    assert 0.75 * 0.12 < plane.area_m2 <= 0.12  # no normals near edges
    np.testing.assert_allclose(corners @ UP, -0.7, atol=1e-9)
    np.testing.assert_allclose(abs(corners[:, 0]).max(), 0.2, atol=0.02)
    np.testing.assert_allclose(np.ptp(corners @ forward), 0.3, atol=0.04)


def test_points_within_margin_of_outline_are_inside() -> None:
    plane = SupportingPlane(0, 0, 0, np.array([0.0, 0, -1]), -1.0, np.full(DIRECTIONS, 0.5), 1.0)
    row = pack_planes([plane]).view(np.recarray)[0]
    assert distance_outside(row, 0.45, 0.0, 1.0) <= 0.0
    assert distance_outside(row, 0.6, 0.0, 1.0) > 0.0
    assert distance_outside(row, 0.6, 0.0, 1.0) <= 0.15


@pytest.mark.parametrize(("closed", "kept"), [(True, 1), (False, 2)])
def test_board_is_a_supporting_plane_unlike_box_top(closed: bool, kept: int) -> None:
    """Both are 15 cm above the floor and equally large; only the box is closed below its edge."""
    inv_depth = level(0.9)
    z = -0.75 / RAY_HEIGHTS
    forward = np.array([0, -np.sqrt(0.5), np.sqrt(0.5)])
    along = forward[1] * (I - 119.5) / 262.5 * z + forward[2] * z
    top = (abs((J - 159.5) / 262.5 * z) < 0.2) & (abs(along - 0.8) < 0.15)
    edge = 0.65  # distance to the front of the box, which reaches down to the floor
    front = edge / ((I - 119.5) / 262.5 * forward[1] + forward[2])
    height = RAY_HEIGHTS * front
    wall = (height < -0.75) & (height > -0.9) & (abs((J - 159.5) / 262.5 * front) < 0.2)
    if closed:
        inv_depth = np.where(wall, 1 / front, inv_depth)
    grid = grid_of(np.where(top, level(0.75), inv_depth))
    rng = np.random.default_rng(0)
    found = find_horizontal_planes(grid, orient_points(grid), UP, draw_trials(rng))
    assert len(found) == 2
    assert len(supporting_planes(grid, found, max_height_m=0.5)) == kept


def test_large_upright_face_is_a_wall_unlike_small_one() -> None:
    """Both faces are a metre in front of the camera, which looks straight ahead."""
    up = np.array([0.0, -1.0, 0.0])
    trials = draw_trials(np.random.default_rng(0))
    grid = grid_of(np.ones((240, 320), np.float32))
    large = np.ones((240, 320), np.int8)
    walls = remove_walls(grid, large, up, 0.5, trials)
    assert (walls == CLEARED).mean() > 0.95
    assert not large.any()

    small = np.zeros((240, 320), np.int8)
    small[100:150, 140:190] = 1
    only = DepthGrid(np.where(small > 0, grid.inverse_depth, 0), INTRINSICS, 2, DISCONTINUITY)
    walls = remove_walls(only, small, up, 0.5, trials)
    assert not (walls == CLEARED).any()
    assert small.sum() == 2500


def test_small_part_in_plane_of_wall_is_kept() -> None:
    """It may be an object whose front is in this plane; a gap separates it from the wall."""
    inv_depth, plane_id = np.ones((240, 320), np.float32), np.ones((240, 320), np.int8)
    inv_depth[95:125, 145:175] = 0
    part = np.zeros(inv_depth.shape, bool)
    part[100:120, 150:170] = True
    inv_depth[part] = 1
    trials = draw_trials(np.random.default_rng(0))
    walls = remove_walls(grid_of(inv_depth), plane_id, np.array([0.0, -1.0, 0.0]), 0.5, trials)

    assert (walls[part] == ON_WALL).all()
    assert plane_id[part].all()
    assert (walls[~part & (inv_depth > 0)] == CLEARED).mean() > 0.95


@pytest.mark.parametrize(("width", "taken"), [(20, True), (110, False)])
def test_overhang_joins_object_unless_many_times_larger(
    width: int,
    taken: bool,
) -> None:
    """Beyond the edge of the plane, it may be a handle or a wall behind the table."""
    inv_depth = level(0.7)
    inv_depth[100:140, 150 : 170 + width] = level(0.6)[100:140, 150 : 170 + width]
    plane_id = np.full((240, 320), -1, np.int8)
    plane_id[:, 170:] = 0
    plane_id[100:140, 150:170] = 1
    heights = HeightMap(plane_id, np.full((240, 320), 0.1, np.float32))
    plane = plane_of(grid_of(level(0.7)), 0.7)
    none = np.zeros((240, 320), np.uint8)
    planes = pack_planes([plane])
    extend_overhang(grid_of(inv_depth), heights, planes, none, 0.5)
    assert (plane_id[100:140, 170 : 170 + width] == 1).all() == taken
    assert (plane_id[:, 290:] == 0).all()


def test_plate_in_noise_is_found_and_depth_error_is_not() -> None:
    """Both rise by 6 mm: the plate in a step, the error over 40 cells."""
    rng = np.random.default_rng(1)
    table, noise = level(0.7), rng.normal(0, 0.0007, (240, 320))
    gap = level(0.694) - table
    inside = (J - 90) ** 2 + (I - 140) ** 2 < 26**2
    error = np.exp(-((J - 230) ** 2 + (I - 140) ** 2) / (2 * 40**2))
    grid = grid_of(table + noise + gap * (inside + error))
    plane = plane_of(grid_of(table), 0.7)
    heights, planes = heights_of(grid, plane)
    low = find_low_profile(grid, heights, planes, 0.5)
    assert low[inside].mean() > 0.9
    assert low[:, 170:].mean() < 0.01
    assert (heights.plane_id[:, 170:] == 1).mean() < 0.05


def test_outline_of_object_rises_on_all_sides() -> None:
    round_ = Outline(sides=100, facing=95, bounded=95, hidden=0, rise=150.0, steep=90)
    assert is_object(round_, 600)
    assert not is_object(round_._replace(steep=50), 600)  # depth error rises only in places
    assert not is_object(round_._replace(facing=30, bounded=40, rise=60.0), 600)
    assert not is_object(round_._replace(rise=90.0), 600)


def test_high_pass_keeps_step_and_removes_slope() -> None:
    """The filter subtracts the mean in a window."""
    residual = np.asarray(0.001 + 1e-6 * (I + J), np.float32)
    residual[120:126, 160:166] += 0.005
    high_pass = np.zeros_like(residual)
    filter_high_pass(residual, high_pass)
    inner = np.s_[2 * LOW.window : -2 * LOW.window, 2 * LOW.window : -2 * LOW.window]
    step = high_pass[122, 162]
    assert step == pytest.approx(0.005, rel=0.05)
    assert np.median(abs(high_pass[inner])) < 1e-5


def test_noise_is_median_rise_between_cells_of_plane() -> None:
    rng = np.random.default_rng(0)
    high_pass = rng.normal(0, 0.001, (240, 320)).astype(np.float32)
    plane_id = np.full((240, 320), -1, np.int8)
    expected = 0.6745 * np.sqrt(2) * 0.001
    assert measure_noise(high_pass, plane_id, 1) == pytest.approx(expected, rel=0.05)
    assert measure_noise(high_pass, plane_id, 2) == 0
