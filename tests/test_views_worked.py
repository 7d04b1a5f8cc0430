"""Tests of surfaces, descriptors and grids on shapes with known values."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapecat.arrays import F8, freeze
from shapecat.config import DetectionSettings, Settings, SurfaceSettings
from shapecat.description import DESCRIPTOR_NAMES, describe
from shapecat.detection import depth_grid, detect
from shapecat.detection.depth_grid import downsample
from shapecat.detection.virtual_camera import virtual_image
from shapecat.perception import perceive
from shapecat.simulation import IDEAL, make_scene, render_frame
from shapecat.surface import reconstruct
from shapecat.types import Camera, Frame, NeuralGas
from tests.conftest import Guesser
from tests.test_detection import box, frame_of, render, table

COUNT = 1200


def facing(points: F8, normals: F8, eye: F8) -> F8:
    """Return the points of a surface that face the sensor."""
    return np.asarray(points[np.sum(normals * (eye - points), axis=1) > 0])


def ball(middle: F8, radius: float, eye: F8) -> F8:
    """Return the visible points of a ball, evenly spread (Fibonacci sphere)."""
    k = np.arange(2 * COUNT) + 0.5
    z, angle = 1 - k / COUNT, k * np.pi * (1 + 5**0.5)
    r = np.sqrt(1 - z * z)
    normals = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return facing(middle + radius * normals, normals, eye)


def gas_of(points: F8, seed: int = 0) -> NeuralGas:
    gas = reconstruct(
        points.astype(np.float32),
        settings=SurfaceSettings(neurons=80, signals=5000),
        rng=np.random.default_rng(seed),
    )
    assert gas is not None
    return gas


def described(points: F8, eye: F8) -> dict[str, float]:
    values = describe(points.astype(np.float32), gas_of(points), eye.astype(np.float32))
    return dict(zip(DESCRIPTOR_NAMES, values.tolist(), strict=True))


def test_ball_has_shares_of_normals_of_half_sphere() -> None:
    """The area of a sphere is uniform over z: normals up, sideways and down are bands of it."""
    eye = np.array([3.0, 0.4, 0.2])
    value = described(ball(np.array([0, 0, 0.2]), 0.06, eye), eye)

    assert value["context.share_down"] == pytest.approx((1 - 0.25) / 2, abs=0.05)
    assert value["context.share_side"] == pytest.approx(0.4, abs=0.05)
    assert value["context.share_up"] == pytest.approx(0.1, abs=0.04)


@pytest.mark.parametrize("height", [0.9, -0.6])
def test_share_of_downward_normals_depends_on_viewpoint(height: float) -> None:
    """From the side, equal parts face up and down, which would hide a sign error."""
    middle, eye = np.array([0, 0, 0.2]), np.array([0.8, 0.3, height])
    points = ball(middle, 0.06, eye)
    normals = (points - middle) / 0.06

    share = described(points, eye)["context.share_down"]

    assert share == pytest.approx(np.mean(normals[:, 2] < -0.25), abs=0.04)


def test_descriptor_has_true_heights_elevation_and_distance() -> None:
    """The ball is 0.14 m above its support; the sensor looks down at an angle of asin(0.6)."""
    middle = np.array([0.0, 0.0, 0.2])
    eye = middle + np.array([0.8, 0.0, 0.6])
    value = described(ball(middle, 0.06, eye), eye)
    below = described(ball(middle, 0.06, eye * [1, 1, -1]), eye * [1, 1, -1])

    assert value["view.elevation"] == pytest.approx(0.6, abs=0.03)
    assert below["view.elevation"] < -0.5
    assert value["view.distance"] == pytest.approx(1.0, abs=0.06)
    low = 0.2 - 0.06 * 0.8  # the lowest visible point, on the horizon of the sensor
    assert value["metric.low"] == pytest.approx(low, abs=0.01)
    assert value["metric.height"] == pytest.approx(0.26 - low, abs=0.012)


def cuboid(size: F8) -> F8:
    """Return the points of the top and of the side at +x of a cuboid on its support."""
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 2))
    top = np.stack([a, b, np.ones(a.size)], axis=1)
    side = np.stack([np.full(a.size, 0.5), a, b + 0.5], axis=1)
    return np.concatenate([top, side]) * size


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_descriptor_has_true_widths_along_and_across_the_view(yaw: float) -> None:
    """Widths of round objects are all equal, so a box shows which is which.

    They do not change if object and sensor are turned together.
    """
    turn = Rotation.from_euler("z", yaw)
    depth, width, height = 0.06, 0.14, 0.1
    eye = turn.apply([0.9, 0.0, 0.5])
    value = described(turn.apply(cuboid(np.array([depth, width, height]))), eye)
    wide = np.hypot(depth, width)  # along the diagonal, which is near one of 16 directions

    for name, length in {"along": depth, "across": width, "wide": wide, "height": height}.items():
        assert value[f"metric.{name}"] == pytest.approx(length, abs=0.003)
    ratios = {
        "height_to_across": (height, width),
        "along_to_across": (depth, width),
        "height_to_widest": (height, wide),
        "narrow_to_wide": (depth, wide),
    }
    for name, (a, b) in ratios.items():
        assert value[f"context.{name}"] == pytest.approx(a / (a + b), abs=0.01)


def walls() -> F8:
    """Return two walls 5 cm apart on a floor, like a mug cut open."""
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 0.08, 33)] * 2))
    zero = np.zeros(a.size)
    floor = np.stack([a * 0.05 / 0.08, b, zero], axis=1)
    left, right = np.stack([zero, b, a], axis=1), np.stack([zero + 0.05, b, a], axis=1)
    return np.concatenate([left, floor, right])


def test_level_surface_counts_where_it_is() -> None:
    """The top of a box, the bottom of an open mug, and a step half as high as its box."""
    size, eye = np.array([0.06, 0.14, 0.1]), np.array([0.9, 0.0, 0.5])
    block, step = cuboid(size), cuboid(size * [1, 1, 0.5]) + size * [1, 0, 0]
    above = np.array([0.025, 0.04, 0.9])
    views = (block, eye), (walls(), above), (np.concatenate([block, step]), eye)
    found = [
        [value["context.share_up_top"], value["context.share_up_bottom"]]
        for value in (described(*view) for view in views)
    ]

    assert_allclose(found, [[0.45, 0], [0, 0.25], [0.23, 0]], atol=0.1)
    assert found[0][1] == found[1][0] == found[2][1] == 0


def test_surface_edges_do_not_cross_gaps() -> None:
    """Otherwise opposite walls of a cup would be joined across the space between them."""
    points = walls()
    gas = gas_of(points)
    tree = cKDTree(points)
    spacing = np.median(cKDTree(gas.neurons).query(gas.neurons, 2)[0][:, 1])
    a, b = gas.neurons[gas.edges[:, 0]], gas.neurons[gas.edges[:, 1]]

    assert np.linalg.norm(a - b, axis=1).max() < 3.5 * spacing
    assert tree.query((a + b) / 2)[0].max() < spacing


def test_separate_parts_are_linked_once_at_nearest_neurons() -> None:
    sheet = walls()[: 33 * 33]
    points = np.concatenate([sheet, sheet + np.array([0.2, 0.03, 0.01])])
    gas = gas_of(points)
    right = gas.neurons[:, 0] > 0.1
    bridges = right[gas.edges[:, 0]] != right[gas.edges[:, 1]]

    assert 0 < np.count_nonzero(right) < len(right)
    assert np.count_nonzero(bridges) == 1
    a, b = gas.edges[bridges][0]
    length = float(np.linalg.norm(gas.neurons[a] - gas.neurons[b]))
    nearest = cKDTree(gas.neurons[right]).query(gas.neurons[~right])[0].min()
    assert length == pytest.approx(float(nearest), rel=1e-5)


def test_stacked_object_is_described_relative_to_its_support() -> None:
    """Relative to the table, it would begin too high; its box would include the object below."""
    shapes = [table(), box((0, 0, 0), (0.22, 0.18, 0.08)), box((0, 0.01, 0.08), (0.1, 0.08, 0.1))]
    frame = frame_of(render(shapes)[0])
    guesser: Any = Guesser()
    perception = perceive(frame, up=None, categorizer=guesser, settings=Settings())
    upper = [d for d in perception.detections if d.candidate.on_candidate is not None]
    low, high = (DESCRIPTOR_NAMES.index(f"metric.{name}") for name in ("low", "height"))

    assert len(perception.detections) == 2
    (top,) = upper
    assert top.candidate.support_m == pytest.approx(0.08, abs=0.01)
    assert top.descriptor[low] < 0.02
    assert top.descriptor[high] == pytest.approx(0.1, abs=0.02)
    assert top.full is not None
    assert top.full.size[2] == pytest.approx(0.1, abs=0.02)


def centers_of(frame: Frame, up: F8 | None) -> F8:
    scene = detect(frame, up=up, settings=DetectionSettings(), rng=np.random.default_rng(0))
    return np.array(sorted(c.box.center.tolist() for c in scene.candidates))


def test_rotated_cloud_with_rotated_up_has_same_objects() -> None:
    """A given up direction is in the frame of the points, whatever their rotation."""
    rng = np.random.default_rng(11)
    image, _ = render_frame(make_scene("tabletop", rng, frames=1), 0, rng=rng, sensor=IDEAL)
    points = image.xyz()
    up = detect(image, settings=DetectionSettings(), rng=np.random.default_rng(0)).up
    rotation = Rotation.from_euler("xyz", [0.25, -0.4, 0.9])
    plain = Frame("/p", 0, 0, 0, "cam", points=points)
    rotated = Frame(
        "/p", 0, 0, 0, "cam", points=np.array(rotation.apply(points), np.float32, order="C")
    )
    expected = centers_of(plain, np.asarray(up, np.float64))
    found = centers_of(rotated, rotation.apply(up))

    assert len(expected) >= 3
    assert len(found) == len(expected)
    assert cKDTree(rotation.apply(expected)).query(found)[0].max() < 0.01


def test_grid_intrinsics_match_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The inverse depth of a plane is linear in the rays, so an error of half a pixel shows."""
    camera = Camera(320, 240, 260.3, 255.1, 158.7, 121.2)
    normal, offset = np.array([0.21, -0.83, -0.35]), -0.9
    v, u = np.mgrid[:240, :320]
    rays = np.stack([(u - 158.7) / 260.3, (v - 121.2) / 255.1, np.ones(u.shape)], axis=-1)
    inverse = rays @ normal / offset
    depth = np.where(inverse > 0.4, 1 / np.maximum(inverse, 0.4), 0).astype(np.float32)
    for cell_m in (0.0125, 0.019):  # two and three pixels per cell
        monkeypatch.setattr(depth_grid, "CELL_M", cell_m)
        grid = downsample(freeze(depth, "v u", "f4"), camera, range_m=2.4)
        assert grid is not None
        i, j = np.nonzero(grid.inverse_depth)
        k = grid.intrinsics
        ray = np.stack([(j - k.cx) / k.fx, (i - k.cy) / k.fy, np.ones(i.size)], axis=-1)
        off = grid.inverse_depth[i, j] - ray @ normal / offset
        step = np.abs(normal[:2] / offset / [k.fx, k.fy]) / grid.factor / 2  # for half a pixel
        assert grid.factor > 1
        assert abs(np.median(off)) < 0.1 * step.min()


def test_virtual_view_intrinsics_match_points() -> None:
    rng = np.random.default_rng(5)
    points = freeze(rng.uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 1.001], (60_000, 3)), "n 3", "f4")
    view = virtual_image(points, range_m=2.0)
    assert view is not None
    used = view.cell >= 0
    i, j = np.divmod(view.cell[used], view.grid.inverse_depth.shape[1])
    x, y, z = view.points[used].T
    k = view.grid.intrinsics
    assert_allclose(np.mean(k.fx * x / z + k.cx - j), 0, atol=0.05)
    assert_allclose(np.mean(k.fy * y / z + k.cy - i), 0, atol=0.05)
    pose = view.view_from_sensor
    assert_allclose(points[used] @ pose.rotation.T + pose.translation, view.points[used], atol=1e-5)
