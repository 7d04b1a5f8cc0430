"""Supporting planes where little of them is seen, and nothing is known of the up direction."""

import numpy as np
import pytest

from benchmarks.piles import judge
from benchmarks.planes import keeps_table, view_of
from benchmarks.simulated import score
from shapecat.arrays import freeze
from shapecat.config import DetectionSettings, Settings
from shapecat.detection import detect
from shapecat.detection.depth_grid import DepthGrid, PinholeIntrinsics, downsample
from shapecat.detection.planes import find_supporting_planes
from shapecat.detection.planes.assumed import assume_plane, unexplained
from shapecat.detection.planes.horizontal import find_horizontal_planes
from shapecat.detection.planes.oriented_points import orient_points
from shapecat.detection.planes.ransac import draw_trials
from shapecat.detection.planes.settings import UP as UP_SETTINGS
from shapecat.detection.planes.strips import add_strip_planes
from shapecat.detection.planes.up_direction import estimate_up
from shapecat.evaluation.overlap import MATCHED_F
from shapecat.learning import load_model
from shapecat.simulation.mesh import Mesh, moved
from shapecat.simulation.paths import looking_at
from shapecat.simulation.primitives import rounded_box
from shapecat.simulation.render import geometry, render
from shapecat.types import Camera, Pose
from tests.test_detection import ball, frame_of
from tests.test_detection import render as made_up

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
UP = np.array([0.0, -np.sqrt(0.5), -np.sqrt(0.5)])
"""Of a camera that looks down by 45 degrees."""


def block(x: float, y: float, z: float, size: tuple[float, float, float]) -> Mesh:
    """Return a box by the middle of its lower face."""
    return moved(rounded_box(size, fine=1), Pose(np.eye(3), np.array([x, y, z])))


def grid_of(meshes: list[Mesh]) -> DepthGrid:
    """Look down at the origin by 45 degrees from a metre away, without noise."""
    pose = looking_at(np.array([0, -np.sqrt(0.5), np.sqrt(0.5)]), np.zeros(3))
    here = Pose(np.eye(3), np.zeros(3))
    depth = render(geometry([(mesh, here) for mesh in meshes]), CAMERA, pose).depth
    grid = downsample(freeze(depth, "v u", "f4"), CAMERA, range_m=2.0)
    assert grid is not None
    return grid


def tiles(step: float, size: float, height: float) -> list[Mesh]:
    """Return a table with 5 x 5 boxes on it."""
    places = (np.arange(5) - 2) * step
    boxes = [block(x, y, 0, (size, size, height)) for x in places for y in places]
    return [block(0, 0, -0.03, (5 * step, 5 * step, 0.03)), *boxes]


def heights(meshes: list[Mesh]) -> tuple[list[float], list[float]]:
    """Return the heights of the planes that are found, and what of each is covered."""
    grid, trials = grid_of(meshes), draw_trials(np.random.default_rng(0))
    found = find_horizontal_planes(grid, orient_points(grid), UP, trials)
    planes = add_strip_planes(grid, found)
    return [one.plane.offset + np.sqrt(0.5) for one in planes], [one.covered_m2 for one in planes]


def supports(meshes: list[Mesh]) -> list[float]:
    """Return the heights of the planes that objects may stand on."""
    trials = draw_trials(np.random.default_rng(0))
    planes, up = find_supporting_planes(grid_of(meshes), None, trials, tallest_m=0.6, upright=True)
    assert up @ UP > np.cos(np.radians(2))
    return [plane.offset + np.sqrt(0.5) for plane in planes]


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        *(("covered to four fifths", seed) for seed in (3, 12, 21, 24, 731005, 731047)),
        *(("cut to a fifth", seed) for seed in (3, 1015, 1028)),
        *(("8 to 85 degrees", seed) for seed in (1, 5)),
    ],
)
def test_table_is_found_without_a_hint(kind: str, seed: int) -> None:
    """A frame that loses its table loses all objects: for strips, a wall, or a grazing view."""
    world, frame = view_of(kind, seed)
    found = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0))
    assert keeps_table(world, found)


def test_table_is_found_in_strips_of_three_centimetres() -> None:
    """They are narrower than what tells a tilt; the tops of the boxes are the largest plane."""
    found, covered_m2 = heights(tiles(0.16, 0.13, 0.04))
    np.testing.assert_allclose(found, [0, 0.04], atol=0.004)
    assert covered_m2[0] > 0.1
    assert covered_m2[1] == 0


@pytest.mark.parametrize("seed", [500006, 520022])
def test_strips_at_the_end_of_the_range_are_no_plane(seed: int) -> None:
    """Beyond it nothing is seen, which looks like a board with nothing below."""
    assert score("empty", seed, 1)["scenes with all planes"] == 1


def test_lid_under_a_box_is_not_covered() -> None:
    """It has nothing below and a top above it as a table has, but it is seen whole."""
    boxes = [block(0, 0, 0, (0.3, 0.3, 0.2)), block(0.05, 0.05, 0.2, (0.2, 0.2, 0.05))]
    _, covered_m2 = heights([block(0, 0, -0.03, (1.2, 1.0, 0.03)), *boxes])
    assert covered_m2 == [0] * len(covered_m2)
    assert len(covered_m2) > 1


def test_floor_of_a_raised_bin_is_a_plane_and_the_top_of_a_box_is_not() -> None:
    """Both are too small for furniture, half a metre above the floor, and nothing is seen below."""
    ground, body = block(0, 0.3, -0.53, (2.4, 2.4, 0.03)), block(0, 0, -0.5, (0.34, 0.3, 0.5))
    sides = [
        *(block(x, 0, 0, (0.01, 0.3, 0.08)) for x in (-0.165, 0.165)),
        *(block(0, y, 0, (0.34, 0.01, 0.08)) for y in (-0.145, 0.145)),
    ]
    assert supports([ground, body]) == pytest.approx([-0.5], abs=0.01)
    assert supports([ground, body, *sides]) == pytest.approx([-0.5, 0], abs=0.01)


def test_camera_upside_down_is_believed_where_nothing_speaks_against_it() -> None:
    """How cameras are held is no more than a prior: a table alone is level however it is seen."""
    grid = grid_of([block(0, 0, -0.03, (1.2, 1.0, 0.03))])
    turned = grid._replace(inverse_depth=np.ascontiguousarray(grid.inverse_depth[::-1, ::-1]))
    trials = draw_trials(np.random.default_rng(0))
    up = estimate_up(
        orient_points(turned), turned.intrinsics, np.zeros(3), trials, UP_SETTINGS.held
    )
    assert up @ [0, -UP[1], UP[2]] > np.cos(np.radians(2))


def test_assumed_plane_lies_just_below_what_no_plane_explains() -> None:
    """Blobs in the air, 0.9 to 0.7 m below a turned camera; far ones decide nothing."""
    up = np.array([0.36, -0.48, -0.8])
    i, j = np.mgrid[:120, :160]
    rays = np.stack([(j - 70) / 150, (i - 62) / 150, np.ones(i.shape)])
    down = -np.tensordot(up, rays, 1)  # height below the camera, by depth
    blob = np.where(j < 80, 0.9 - 0.2 * (i / 120), 0.0)
    far = np.where(j > 150, 1.4, 0.0)
    height = blob + far
    inv_depth = np.where((height > 0) & (down > 0.2), down / np.maximum(height, 0.1), 0)
    grid = DepthGrid(inv_depth.astype(np.float32), PinholeIntrinsics(150.0, 150.0, 70.0, 62.0), 4)

    plane = assume_plane(grid, inv_depth > 0, up, tallest_m=0.3)

    assert plane is not None
    assert plane.area_m2 == 0
    np.testing.assert_allclose(plane.up, up)
    lowest = -blob[(inv_depth > 0) & (j < 80)].max()
    assert lowest - 0.025 < plane.offset < lowest
    level = plane.a * j + plane.b * i + plane.c  # inverse depth of the plane at each cell
    below = inv_depth[(inv_depth > 0) & (j < 80)] < level[(inv_depth > 0) & (j < 80)]
    assert below.mean() < 0.02


def test_known_up_is_kept_where_nothing_is_level() -> None:
    """A heap of balls hides its table: the plane below it follows the given direction."""
    places = [(x / 10, y / 10, 0.03 * abs(x + y)) for x in range(-3, 4) for y in range(-2, 3)]
    depth, _ = made_up([ball(place, 0.06) for place in places], tilt_deg=35, noise=0)
    up = np.array([0.1, -0.8, -0.6]) / np.linalg.norm([0.1, -0.8, -0.6])

    rng = np.random.default_rng(0)
    scene = detect(frame_of(depth), up=up, settings=DetectionSettings(), rng=rng)

    np.testing.assert_allclose(scene.up, up, atol=1e-6)
    assert scene.candidates  # above the assumed plane


def test_no_plane_is_assumed_for_a_few_samples_or_above_the_camera() -> None:
    """Nor does it fail where `detection.max_height_m` leaves no object any height."""
    grid = DepthGrid(np.ones((60, 80), np.float32), PinholeIntrinsics(75.0, 75.0, 39.5, 29.5), 8)
    few = np.zeros((60, 80), np.int8)
    few[6:] = -1  # a tenth is above no plane
    up = np.array([0.0, 0.0, -1.0])
    assert unexplained(grid, few) is None
    rest = unexplained(grid, ~few)
    assert rest is not None
    np.testing.assert_array_equal(rest, few == -1)
    assert assume_plane(grid, rest, -up, tallest_m=0.5) is None
    assert assume_plane(grid, rest, up, tallest_m=0.5) is not None
    one = np.arange(few.size).reshape(few.shape) == 3001
    assert assume_plane(grid, one, up, tallest_m=0.5) is not None
    for low in (0.0, 0.001, 0.008):  # less than a bin of heights
        assert assume_plane(grid, rest, up, tallest_m=low) is not None
    far = grid._replace(inverse_depth=np.where(few < 0, np.float32(0.4), grid.inverse_depth))
    assert unexplained(far, ~few) is None  # background, 2.5 m away


@pytest.mark.parametrize("first", [3002, pytest.param(3005, marks=pytest.mark.many)])
def test_objects_in_compartments_are_found_where_their_board_is_hardly_seen(first: int) -> None:
    """Without a plane below them none of these objects was found."""
    found = seen = 0
    for seed in range(first, first + 2):
        scores = judge("shelf bin", "kinect", seed, 1, load_model(None), Settings())
        found += sum(judged.overlap >= MATCHED_F for judged in scores.objects)
        seen += len(scores.objects)
    assert seen > 12
    assert found > 0.55 * seen
