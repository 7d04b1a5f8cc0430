"""Tests of simulated shapes: limits of the categories, meshes, sizes and resting poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapecat.arrays import F8
from shapecat.geometry import compose
from shapecat.simulation.camera.render import geometry, render
from shapecat.simulation.scenes.footprints import overlap
from shapecat.simulation.scenes.worlds import pose_from_yaw
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.distractors import DISTRACTORS, make_distractor
from shapecat.simulation.shapes.mesh import Mesh, moved
from shapecat.simulation.shapes.primitives import lathe, rounded_box, tube
from shapecat.simulation.shapes.stable_poses import choose_stable_pose, stable_poses
from shapecat.types import CATEGORIES, Camera, Pose

HERE = Pose(np.eye(3), np.zeros(3))
MANY = 40


def meshes_of(category: str) -> list[Mesh]:
    return [make_object(category, np.random.default_rng((3, seed))) for seed in range(MANY)]


def width_at(mesh: Mesh, low: float, high: float) -> float:
    """Return the largest width between two heights, given as fractions of the total."""
    z = mesh.vertices[:, 2] / mesh.extents[2]
    flat = mesh.vertices[(z >= low) & (z <= high), :2]
    angle = np.arange(24) * (np.pi / 24)
    return float(np.ptp(flat @ [np.cos(angle), np.sin(angle)], axis=0).max())


def openness(mesh: Mesh) -> tuple[float, float]:
    """Return the depth of an open object, rendered from above, and the diameter of its rim."""
    top = float(mesh.vertices[:, 2].max())
    rim = mesh.vertices[mesh.vertices[:, 2] > top - 0.01 * mesh.extents[2] - 1e-4, :2]
    far = 20.0
    camera = Camera(3, 3, 4000.0, 4000.0, 1.0, 1.0)  # the middle, a few millimetres
    middle = (rim.min(axis=0) + rim.max(axis=0)) / 2
    above = Pose(np.diag([1.0, -1.0, -1.0]), np.array([*middle, far]))
    floor = far - float(np.median(render(geometry([(mesh, HERE)]), camera, above).depth))
    angle = np.arange(24) * (np.pi / 24)
    return top - floor, float(np.ptp(rim @ [np.cos(angle), np.sin(angle)], axis=0).max())


@pytest.mark.parametrize("category", CATEGORIES)
def test_objects_have_household_size_and_stand_on_ground(category: str) -> None:
    for mesh in meshes_of(category):
        assert abs(float(mesh.vertices[:, 2].min())) < 1e-6
        assert mesh.extents.min() > 0.005
        assert mesh.extents.max() < 0.4
        assert 20 <= len(mesh.triangles) <= 6000
        assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize(
    ("category", "least", "most"), [("cup", 0.65, 2.6), ("bowl", 0.2, 0.65), ("plate", 0.02, 0.2)]
)
def test_open_categories_stay_within_depth_limits(category: str, least: float, most: float) -> None:
    """A generator that blurs the limits of categories teaches the model to guess."""
    ratios = []
    for mesh in meshes_of(category):
        depth, diameter = openness(mesh)
        ratios.append(depth / diameter)

    assert min(ratios) > least
    assert max(ratios) < most
    assert max(ratios) > 1.3 * min(ratios)  # they vary


def test_bottles_are_narrower_at_the_top() -> None:
    shares = [width_at(mesh, 0.93, 1.0) / width_at(mesh, 0.0, 1.0) for mesh in meshes_of("bottle")]

    # Pumps and triggers are wide at the top, but most bottles have none.
    assert np.mean(np.array(shares) < 0.72) > 0.85


def test_cans_are_not_narrower_at_the_top() -> None:
    assert min(width_at(m, 0.93, 1.0) / width_at(m, 0.0, 1.0) for m in meshes_of("can")) > 0.75


def test_half_of_the_balls_are_spheres_and_the_others_round_fruit() -> None:
    shares = [mesh.extents.min() / mesh.extents.max() for mesh in meshes_of("ball")]

    assert min(shares) > 0.6
    assert 0.35 < np.mean(np.array(shares) > 0.93) < 0.85
    assert max(np.ptp(radii(mesh)) for mesh in meshes_of("ball")) > 0.2  # dimples and knobs


def radii(mesh: Mesh) -> F8:
    """Return the distances of the vertices from the centre, as fractions of the largest."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    distances = np.linalg.norm(mesh.vertices - middle, axis=1)
    return np.asarray(distances / distances.max())


@pytest.mark.parametrize("category", CATEGORIES)
def test_objects_of_a_category_differ(category: str) -> None:
    extents = np.array([np.sort(mesh.extents) for mesh in meshes_of(category)])

    assert len(np.unique(np.round(extents, 4), axis=0)) == MANY
    assert extents[:, 2].max() > 1.8 * extents[:, 2].min()


def test_unknown_category_raises() -> None:
    with pytest.raises(ValueError, match="spoon"):
        make_object("spoon", np.random.default_rng(0))
    with pytest.raises(ValueError, match="spoon"):
        make_distractor(np.random.default_rng(0), ["spoon"])


@pytest.mark.parametrize("kind", DISTRACTORS)
def test_every_distractor_is_generated(kind: str) -> None:
    name, mesh = make_distractor(np.random.default_rng(1), [kind])

    assert name == kind
    assert abs(float(mesh.vertices[:, 2].min())) < 1e-6
    assert 0.01 < mesh.extents.max() < 0.7


def test_there_are_many_kinds_of_distractors() -> None:
    assert len(DISTRACTORS) >= 24


def test_rounded_box_has_requested_size() -> None:
    """Rounding the edges must not shrink the faces."""
    mesh = rounded_box([0.1, 0.2, 0.05], radius=0.006)

    np.testing.assert_allclose(mesh.extents, [0.1, 0.2, 0.05], atol=2e-6)


def test_closed_tube_has_surface_area_of_torus() -> None:
    angle = np.arange(24) * (2 * np.pi / 24)
    path = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    mesh = tube(path, 0.2, closed=True)
    corners = mesh.vertices[mesh.triangles].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(4 * np.pi**2 * 0.2, rel=0.05)


def test_cylinder_rests_on_its_ends_and_side() -> None:
    found = stable_poses(lathe([[0, 0], [0.03, 0], [0.03, 0.1], [0, 0.1]], segments=24))

    assert [stable.name for stable in found].count("upright") == 1
    assert [stable.name for stable in found].count("upside_down") == 1
    assert [stable.name for stable in found].count("lying") == 24


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(["cup", "can", "box", "bottle"]), st.integers(0, 999), st.floats(0, 6.28))
def test_lying_object_touches_ground_and_does_not_roll(
    category: str, seed: int, angle: float
) -> None:
    rng = np.random.default_rng(seed)
    mesh = make_object(category, rng)
    stable_pose = choose_stable_pose(mesh, "lying", rng)
    assert stable_pose is not None
    pose = compose(pose_from_yaw(angle, [0.3, -0.2, 0.7]), stable_pose.pose)
    points = moved(mesh, pose).vertices

    assert float(points[:, 2].min()) == pytest.approx(0.7, abs=2e-5)
    contact = points[points[:, 2] < 0.7 + 2e-4, :2]
    assert len(contact) >= 3
    assert np.all(contact.min(axis=0) <= [0.3 + 1e-4, -0.2 + 1e-4])
    assert np.all(contact.max(axis=0) >= [0.3 - 1e-4, -0.2 - 1e-4])


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@settings(deadline=None)
def test_overlap_of_square_footprints_is_exact(x: float, y: float) -> None:
    square: F8 = np.array([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]], np.float64)
    apart = max(abs(x), abs(y)) >= 0.1

    if abs(max(abs(x), abs(y)) - 0.1) > 1e-9:
        assert overlap(square, square + np.array([x, y]), 0.0) is not apart
