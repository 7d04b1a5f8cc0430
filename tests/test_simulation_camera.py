"""Tests of the rasterizer against geometry and ray casting, and of the sensor models."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, find_objects, label, uniform_filter

from shapecat.arrays import F8
from shapecat.simulation.camera.measuring import measure
from shapecat.simulation.camera.presets import IDEAL, KINECT, PRESETS, REALSENSE
from shapecat.simulation.camera.render import (
    Geometry,
    Image,
    cropped,
    geometry,
    pixels_if_unoccluded,
    render,
)
from shapecat.simulation.camera.sensors import Sensor, resized
from shapecat.simulation.scenes.kinds import make_scene
from shapecat.simulation.scenes.paths import looking_at
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.primitives import lathe, rounded_box
from shapecat.types import Camera, Pose

HERE = Pose(np.eye(3), np.zeros(3))
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)


def rays(camera: Camera) -> F8:
    v, u = np.mgrid[: camera.height, : camera.width]
    across, down = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([across, down, np.ones(across.shape)], -1)


def big_quad(z: float) -> Mesh:
    corners = np.array([[-90, -90, z], [90, -90, z], [90, 90, z], [-90, 90, z]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_plane_that_extends_behind_the_camera_is_exact() -> None:
    """The floor extends behind the camera; clipped wrongly, it would have wrong depth."""
    pose = looking_at(np.array([0, 0, 1.3]), np.array([0.2, 1.0, 0.9]))
    image = render(geometry([(big_quad(0.0), HERE)]), CAMERA, pose)
    fall = (rays(CAMERA) @ pose.rotation.T)[..., 2]
    expected = np.where(fall < 0, -1.3 / np.where(fall < 0, fall, -1.0), 0.0)
    near = expected < 60

    np.testing.assert_allclose(image.depth[near], expected[near], rtol=1e-9)
    assert np.array_equal(image.mesh_ids[near] == 0, expected[near] > 0)


def test_sphere_has_exact_depth_and_outline() -> None:
    t = np.linspace(-np.pi / 2, np.pi / 2, 200)
    ball = lathe(np.stack([0.2 * np.cos(t), 0.2 * np.sin(t)], -1), segments=300)
    image = render(geometry([(ball, Pose(np.eye(3), np.array([0.05, 0, 1.0])))]), CAMERA, HERE)
    d = rays(CAMERA)
    a, b = (d * d).sum(-1), d @ [0.05, 0, 1.0]
    inside = b * b - a * (1.0025 - 0.04)
    depth = (b - np.sqrt(np.maximum(inside, 0))) / a
    clear = inside > 0.01

    assert (image.mesh_ids[clear] == 0).all()
    np.testing.assert_allclose(image.depth[clear], depth[clear], atol=2e-4)
    assert (image.mesh_ids[inside < -1e-4] == -1).all()


def test_shared_edges_leave_no_gap() -> None:
    """A wall of many small triangles must hide everything behind it, at every pixel."""
    rng = np.random.default_rng(0)
    n = 60
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n)), -1).reshape(-1, 2)
    wall = np.column_stack([grid, 1 + 0.1 * rng.random(n * n)])
    k = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate(
        [np.stack([k, k + 1, k + n], 1), np.stack([k + 1, k + n + 1, k + n], 1)]
    )
    image = render(geometry([(big_quad(5.0), HERE), (Mesh(wall, triangles), HERE)]), CAMERA, HERE)

    assert (image.mesh_ids == 1).all()


def test_both_sides_of_triangles_are_rendered() -> None:
    """Back-face culling would make holes in the thin walls of cups."""
    quad = big_quad(1.0)
    back = Mesh(quad.vertices, quad.triangles[:, ::-1])

    for mesh in (quad, back):
        image = render(geometry([(mesh, HERE)]), CAMERA, HERE)
        assert (image.mesh_ids == 0).all()
        assert float(image.cosine.max()) == pytest.approx(1.0, abs=1e-3)


def test_nearest_surface_is_visible() -> None:
    image = render(
        geometry([(big_quad(2.0), HERE), (big_quad(1.0), HERE), (big_quad(3.0), HERE)]),
        CAMERA,
        HERE,
    )

    assert (image.mesh_ids == 1).all()


def test_crop_equals_part_of_the_image() -> None:
    world = make_scene("clutter", np.random.default_rng(4), frames=1)
    solids = world.geometry(0)
    whole = render(solids, CAMERA, world.path[0])
    crop = render(solids, cropped(CAMERA, 50, 30, 60, 40), world.path[0])

    np.testing.assert_allclose(crop.inverse, whole.inverse[30:70, 50:110], rtol=1e-12)
    assert (crop.mesh_ids == whole.mesh_ids[30:70, 50:110]).mean() > 0.999


def test_depth_agrees_with_open3d_rays() -> None:
    o3d = pytest.importorskip("open3d")
    world = make_scene("shelf", np.random.default_rng(2), frames=1)
    solids, pose = world.geometry(0), world.path[0]
    image = render(solids, CAMERA, pose)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        np.asarray(solids.vertices, np.float32), np.asarray(solids.triangles, np.uint32)
    )
    d = rays(CAMERA) @ pose.rotation.T
    cast = np.concatenate([np.broadcast_to(pose.translation, d.shape), d], -1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy()
    difference = np.abs(np.where(np.isfinite(hit), hit, 0.0) - image.depth)

    assert np.percentile(difference, 99.8) < 1e-4  # a few rays pass an edge on its other side
    assert (difference > 1e-3).mean() < 0.002


def test_pixels_if_unoccluded_include_occluded_ones() -> None:
    cube = rounded_box([0.2, 0.2, 0.2])
    behind = (cube, Pose(np.eye(3), np.array([0, 0, 1.5])))
    before = (cube, Pose(np.eye(3), np.array([0.1, 0, 1.0])))
    both = geometry([behind, before])
    visible = int((render(both, CAMERA, HERE).mesh_ids == 0).sum())
    alone = int((render(geometry([behind]), CAMERA, HERE).mesh_ids == 0).sum())

    assert pixels_if_unoccluded(both, 0, CAMERA, HERE) == alone
    assert 0 < visible < 0.7 * alone


def test_empty_geometry_gives_empty_image() -> None:
    nothing = Geometry(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(0, int))

    assert (render(nothing, CAMERA, HERE).mesh_ids == -1).all()


# --- sensors -----------------------------------------------------------------------------------


def wall_image(sensor: Sensor, z: float) -> Image:
    return render(geometry([(big_quad(z), HERE)]), sensor.camera, HERE)


def step_image(sensor: Sensor) -> Image:
    post = rounded_box([0.2, 0.2, 2.0])
    solids = [(big_quad(1.2), HERE), (post, Pose(np.eye(3)[[0, 2, 1]], np.array([0, -1.0, 0.8])))]
    return render(geometry(solids), sensor.camera, HERE)


def test_ideal_sensor_changes_nothing() -> None:
    image = step_image(IDEAL)
    depth, mesh_ids = measure(image, IDEAL, np.random.default_rng(0))

    np.testing.assert_allclose(depth, image.depth, rtol=1e-6)
    assert np.array_equal(mesh_ids, image.mesh_ids)


@pytest.mark.parametrize("sensor", [KINECT, REALSENSE], ids=["kinect", "realsense"])
def test_sensor_noise_is_reproducible(sensor: Sensor) -> None:
    image = step_image(sensor)
    first = measure(image, sensor, np.random.default_rng(5))
    second = measure(image, sensor, np.random.default_rng(5))
    other = measure(image, sensor, np.random.default_rng(6))

    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])
    assert not np.array_equal(first[0], other[0])


def test_kinect_disparity_is_quantized() -> None:
    depth, _ = measure(wall_image(KINECT, 1.0), KINECT, np.random.default_rng(0))
    levels = np.unique(1 / depth[depth > 0].astype(np.float64))

    assert np.diff(levels) == pytest.approx(0.0029, rel=1e-3)


@pytest.mark.parametrize("distance", [0.8, 1.6])
def test_kinect_depth_noise_grows_with_squared_distance(distance: float) -> None:
    """In real frames, inverse depth has a noise of 0.0020 1/m (40-pixel window) everywhere."""
    sensor = dataclasses.replace(KINECT, fixed_error=0.0)
    depth, _ = measure(wall_image(sensor, distance), sensor, np.random.default_rng(0))
    inverse = 1 / depth[depth > 0].astype(np.float64)

    assert inverse.std() == pytest.approx(0.0020, abs=0.0002)
    assert inverse.mean() == pytest.approx(1 / distance, abs=0.0005)


def test_kinect_noise_is_correlated_between_neighbours() -> None:
    """Any smoothing would average out independent noise, unlike that of real sensors."""
    sensor = dataclasses.replace(KINECT, fixed_error=0.0, holes=0.0)
    depth, _ = measure(wall_image(sensor, 1.0), sensor, np.random.default_rng(0))
    error = 1 / depth[20:460, 20:580].astype(np.float64) - 1.0
    error -= error.mean()
    across = (error[:, 1:] * error[:, :-1]).mean() / error.var()
    down = (error[1:] * error[:-1]).mean() / error.var()

    assert 0.6 < across < 0.85
    assert 0.45 < down < 0.75


@pytest.mark.parametrize(("sensor", "right"), [(KINECT, 6.0), (REALSENSE, 0.0)])
def test_shadow_is_left_of_near_objects(sensor: Sensor, right: float) -> None:
    """The projector is to the right of the camera."""
    sensor = dataclasses.replace(sensor, holes=0.0, grazing_cosine=0.0)
    image = step_image(sensor)
    depth, mesh_ids = measure(image, sensor, np.random.default_rng(0))
    row_runs = []
    for v in range(100, 380, 4):
        post = np.flatnonzero(mesh_ids[v] == 1)
        left = np.flatnonzero(depth[v, : post[0]] > 0)[-1]
        after = post[-1] + 1 + np.flatnonzero(depth[v, post[-1] + 1 :] > 0)[0]
        row_runs.append((post[0] - left - 1, after - post[-1] - 1))
    left_run, right_run = np.mean(row_runs, axis=0)
    full = sensor.camera.fx * 0.05 * (1 / 0.7 - 1 / 1.2)

    assert 0.6 * full < left_run < full + 1
    assert abs(right_run - right) < 2.0


@pytest.mark.parametrize("name", ["d415", "d435", "d455", "sr300"])
def test_stereo_noise_has_waves_as_wide_as_matching_windows(name: str) -> None:
    """Finer noise is averaged in voxels: surfaces would be flatter than real ones.

    Real cameras bend a plane in waves of 15 to 40 pixels, and hardly roughen it below 5.
    """
    sensor = PRESETS[name]
    plain = dataclasses.replace(sensor, fixed_error=0.0, holes=0.0, step=0.0, grazing_cosine=0.0)
    depth, _ = measure(wall_image(plain, 1.0), plain, np.random.default_rng(0))
    error = 1 / depth[20:460, 40:600].astype(np.float64) - 1.0
    smooth = uniform_filter(error, 5)
    waves = smooth - uniform_filter(smooth, 41)

    assert error.std() == pytest.approx(sensor.noise, rel=0.12)
    assert (error - smooth).std() < 0.35 * waves.std()
    assert waves.std() > 0.65 * sensor.noise


def test_stereo_depth_is_missing_around_near_surfaces() -> None:
    """In real images, depth is missing on all sides of an object, not only in its shadow."""
    plain = dataclasses.replace(IDEAL, stereo_margin_px=6)
    box = rounded_box([0.2, 0.3, 0.1])
    solids = [(big_quad(1.2), HERE), (box, Pose(np.eye(3), np.array([0.05, -0.02, 0.8])))]
    image = render(geometry(solids), plain.camera, HERE)
    depth, mesh_ids = measure(image, plain, np.random.default_rng(0))
    near = image.mesh_ids == 1
    margin = binary_dilation(near, np.ones((13, 13))) & ~near

    assert margin.sum() > 4000
    assert (depth[margin] == 0).all()
    assert (mesh_ids[margin] == -1).all()
    assert (depth[~margin] > 0).all()


def small_box_from_above(height: float) -> Image:
    """Return an image, from above, of a box of 60 x 48 px on a plane 0.6 m away."""
    box = rounded_box([0.0687, 0.055, height])  # 525 px at the distance of its top
    scale = (0.6 - height) / 0.6
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    ground = Pose(np.eye(3), np.zeros(3))
    box = Mesh(box.vertices * [scale, scale, 1.0], box.triangles)
    return render(geometry([(big_quad(0.0), ground), (box, ground)]), IDEAL.camera, pose)


def test_matching_windows_round_the_corners_of_outlines() -> None:
    """Blocks with sharp corners would be easier to tell from cans than real ones.

    A pixel belongs to the surface that covers most of its window: on a diagonal, the edge recedes
    until a quarter of the window is left on each side; along the sides, nothing changes.
    """
    plain = dataclasses.replace(IDEAL, matching_window_px=21)
    image = small_box_from_above(0.1)
    depth, mesh_ids = measure(image, plain, np.random.default_rng(0))
    box = mesh_ids == 1
    rows, columns = np.flatnonzero(box.any(axis=1)), np.flatnonzero(box.any(axis=0))
    corner = np.diagonal(box[rows[0] :, columns[0] :])
    lost = (image.mesh_ids == 1) & ~box

    assert (len(rows), len(columns)) == (48, 60)
    assert 3 <= corner.argmax() <= 6  # (1 - 1 / sqrt(2)) * 10.5 = 3.1, at a resolution of 3 px
    assert (box & (image.mesh_ids != 1)).sum() <= 8
    assert 60 < lost.sum() < 200
    np.testing.assert_allclose(depth[lost], 0.6, atol=0.01)


@pytest.mark.parametrize(("height", "wide"), [(0.015, (7, 12)), (0.1, (0, 2))])
def test_matching_windows_blend_only_small_steps(height: float, wide: tuple[int, int]) -> None:
    """At a step of a few centimetres, real depth changes over the width of a window, without holes.

    Larger steps stay sharp; the pixels between would be flying pixels.
    """
    plain = dataclasses.replace(IDEAL, matching_window_px=13)
    depth, _ = measure(small_box_from_above(height), plain, np.random.default_rng(0))
    row = 0.6 - depth[240, 320:400]
    between = (row > 0.1 * height) & (row < 0.9 * height)

    assert wide[0] <= between.sum() <= wide[1]
    assert (depth > 0).all()


def test_table_at_low_angle_has_no_missing_margins() -> None:
    """The inverse depth of the table changes as fast as at an outline, although there is none."""
    pose = looking_at(np.array([0, 0, 0.35]), np.array([0, 1.0, 0.2]))
    sensor = dataclasses.replace(PRESETS["d455"], holes=0.0, grazing_cosine=0.0, border_px=(0,) * 4)
    image = render(geometry([(big_quad(0.0), HERE)]), sensor.camera, pose)
    depth, _ = measure(image, sensor, np.random.default_rng(0))
    near = (image.depth > 0.8) & (image.depth < 2.5)

    assert near.sum() > 50_000
    assert (depth[near] > 0).mean() > 0.99


@pytest.mark.parametrize("z", [0.5, 2.0])
def test_time_of_flight_noise_grows_with_distance(z: float) -> None:
    """If noise were the same at 0.4 m as at 1 m, near objects would be rougher than real ones."""
    sensor = dataclasses.replace(PRESETS["l515"], fixed_error=0.0, holes=0.0)
    depth, _ = measure(wall_image(sensor, z), sensor, np.random.default_rng(0))

    assert depth[depth > 0].std() == pytest.approx(sensor.relative_noise * z, rel=0.1)


def test_stereo_holes_are_patches() -> None:
    """Filters close 3-pixel holes, but holes of real stereo are as wide as a matching window."""
    sensor = dataclasses.replace(IDEAL, holes=0.01, hole_px=12)
    depth, _ = measure(wall_image(sensor, 1.0), sensor, np.random.default_rng(0))
    holes, count = label(depth == 0)
    widths = np.array([hole[1].stop - hole[1].start for hole in find_objects(holes)])

    assert 0.006 < (depth == 0).mean() < 0.014
    assert count > 30
    assert np.median(widths) >= 5


@pytest.mark.parametrize(("hole_px", "correlation"), [(1, 0.0), (8, 1 / 3)])
def test_depth_at_grazing_incidence_is_missing_in_patches(hole_px: int, correlation: float) -> None:
    """Filters close single pixels: a table at a low angle would look intact.

    At a lag of half a patch, the thresholds have a correlation of 1/2, and their signs of 1/3.
    """
    pose = looking_at(np.array([0, 0, 0.35]), np.array([0, 1.0, 0.2]))
    sensor = dataclasses.replace(IDEAL, grazing_cosine=0.2, hole_px=hole_px)
    image = render(geometry([(big_quad(0.0), HERE)]), sensor.camera, pose)
    depth, _ = measure(image, sensor, np.random.default_rng(0))
    missing = (depth == 0) & (image.depth > 0)
    share = missing.mean(axis=1, keepdims=True)
    missing = (missing - share)[(share[:, 0] > 0.25) & (share[:, 0] < 0.75)]

    assert (missing[:, 4:] * missing[:, :-4]).mean() / missing.var() == pytest.approx(
        correlation, abs=0.05
    )


def test_resized_sensor_has_windows_of_same_angle() -> None:
    """Margins of 8 pixels in an image of half the width would hide the objects."""
    half = resized(PRESETS["d455"], 0.5)

    assert half.camera.width == 640
    assert (half.stereo_margin_px, half.hole_px, half.matching_window_px) == (4, 6, 8)
    assert half.noise_window == (8, 6)
    assert resized(IDEAL, 0.5).stereo_margin_px == 0


def test_surface_out_of_range_has_no_depth() -> None:
    for z in (0.3, 5.0):
        depth, mesh_ids = measure(wall_image(KINECT, z), KINECT, np.random.default_rng(0))
        assert (depth == 0).all()
        assert (mesh_ids == -1).all()
