"""Tests of rotations, poses, upright boxes and records."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from shapecat.arrays import F8, freeze
from shapecat.geometry import (
    compose,
    gravity_rotation,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
    upright_box,
)
from shapecat.surface.triangles import triangles_of
from shapecat.types import Camera, Frame, Pose

number = st.floats(-1, 1, allow_subnormal=False)
quaternion = st.lists(number, min_size=4, max_size=4).filter(lambda q: sum(x * x for x in q) > 0.01)
vector = st.lists(number, min_size=3, max_size=3)
direction = vector.filter(lambda v: sum(x * x for x in v) > 0.01)


def pose(q: list[float], t: list[float]) -> Pose:
    return Pose(rotation_from_quaternion(q), np.array(t))


@settings(deadline=None)
@given(quaternion)
def test_quaternion_survives_a_round_trip(q: list[float]) -> None:
    rotation = rotation_from_quaternion(q)

    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert_allclose(
        rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-9
    )


@settings(deadline=None)
@given(quaternion, vector, vector)
def test_inverse_undoes_a_transform(q: list[float], t: list[float], p: list[float]) -> None:
    a_from_b = pose(q, t)

    assert_allclose(transform(inverse(a_from_b), transform(a_from_b, p)), p, atol=1e-9)
    assert_allclose(compose(a_from_b, inverse(a_from_b)).rotation, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1]])
def test_invalid_quaternion_is_rejected(bad: list[float]) -> None:
    """Faulty drivers publish transforms with a quaternion of zeros or NaN."""
    with pytest.raises(ValueError, match="not a rotation"):
        rotation_from_quaternion(bad)


@settings(deadline=None)
@given(direction)
def test_gravity_rotation_maps_up_to_z(up: list[float]) -> None:
    rotation = gravity_rotation(up)
    length = float(np.linalg.norm(up))

    assert_allclose(rotation @ np.array(up), [0.0, 0.0, length], atol=1e-9)
    assert_allclose(np.linalg.det(rotation), 1)


@settings(deadline=None, max_examples=30)
@given(direction, st.floats(0, 3), st.integers(0, 100))
def test_upright_box_of_rotated_box_is_that_box(up: list[float], yaw: float, seed: int) -> None:
    size = np.array([0.3, 0.12, 0.2])
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * size
    inside = np.random.default_rng(seed).uniform(-0.5, 0.5, (300, 3)) * size
    c, s = np.cos(yaw), np.sin(yaw)
    rotated = np.vstack([corners, inside]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    points: F8 = rotated @ gravity_rotation(up) + [1, 2, 3]

    box = upright_box(points.astype(np.float32), up)

    assert_allclose(box.center, [1, 2, 3], atol=1e-4)
    assert_allclose(np.sort(box.size), np.sort(size), atol=0.006)
    local = (points - box.center) @ rotation_from_quaternion(box.orientation)
    assert np.all(np.abs(local) <= box.size / 2 + 1e-5)


def test_upright_box_needs_only_one_point() -> None:
    """Open3D's boxes raise on flat input."""
    box = upright_box(np.array([[1, 2, 3]], np.float32), [0, 0, 1])

    assert_allclose(box.center, [1, 2, 3])
    assert_allclose(box.size, 0)
    with pytest.raises(ValueError, match="at least one point"):
        upright_box(np.zeros((0, 3), np.float32), [0, 0, 1])


def test_records_reject_wrong_shapes() -> None:
    with pytest.raises(ValueError, match="translation"):
        Pose(np.eye(3), np.zeros(2))
    with pytest.raises(ValueError, match="either depth or points"):
        Frame("t", 0, 0, 0, "f")
    with pytest.raises(ValueError, match="same size"):
        Frame("t", 0, 0, 0, "f", depth=np.zeros((2, 2)), camera=Camera(3, 2, 1, 1, 1, 1))


def test_records_are_read_only() -> None:
    """Shared arrays that change under a reader cause bugs that are hard to find."""
    made = Pose(np.eye(3), np.zeros(3))

    with pytest.raises(ValueError, match="read-only"):
        made.translation[0] = 1


def test_points_without_depth_are_nan() -> None:
    camera = Camera(2, 1, 100.0, 100.0, 0.5, 0.0)
    frame = Frame("t", 0, 0, 0, "f", depth=np.array([[0, 2]]), camera=camera)

    points = frame.xyz()

    assert np.isnan(points[0]).all()
    assert_allclose(points[1], [0.01, 0, 2])


def test_triangles_are_cycles_of_three_edges() -> None:
    edges = freeze([[0, 1], [0, 2], [1, 2], [2, 3]], "n 2", "u2")

    assert triangles_of(edges, 4).tolist() == [[0, 1, 2]]
