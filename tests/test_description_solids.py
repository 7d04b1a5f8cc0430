"""Tests of the descriptor blocks of fitted solids and of the outline."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapecat.arrays import F4, F8
from shapecat.description.linear import principal_axes
from shapecat.description.outline import OUTLINE_NAMES, OUTLINE_SLICES, outline
from shapecat.description.ranges import inner_range
from shapecat.description.revolution import fit_axis
from shapecat.description.solids import SOLID_NAMES, solids

EYE = np.array([8.0, 0.0, 6.0], np.float32)
INDEX = {name: k for k, name in enumerate(SOLID_NAMES)}


def rows_of(points: F8) -> F4:
    """Return points (n, 3) as an array (3, n) for the kernels."""
    return np.ascontiguousarray(points.T, np.float32)


def tilted(angle: float) -> F8:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def half_cone(rng: np.random.Generator, *, slope: float) -> tuple[F8, F8]:
    """Return points (600, 3) and normals of the side of a frustum that is visible from +x."""
    height, angle = rng.uniform(-1, 1, 600), rng.uniform(-1.2, 1.2, 600)
    radius = 0.5 + slope * height
    outward = np.stack([np.cos(angle), np.sin(angle), np.full(600, -slope)], axis=1)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return points, outward / np.linalg.norm(outward, axis=1, keepdims=True)


@pytest.mark.parametrize("values", [(-3, 1, 2), (0, 0, 5), (4, 4, 4), (1, 1, 3), (0, 0, 0)])
@given(seed=st.integers(0, 999), exponent=st.integers(-12, 12), turned=st.booleans())
@settings(max_examples=25, deadline=None)
def test_principal_axes_solve_eigenvalue_problem(
    values: tuple[float, ...], seed: int, exponent: int, turned: bool
) -> None:
    """Spheres, cylinders and plates have equal eigenvalues, or eigenvalues of zero."""
    scale = 10.0**exponent
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0] if turned else np.eye(3)
    A = (q * np.array(values)) @ q.T * scale
    A = (A + A.T) / 2
    found, axes = principal_axes(A.copy())

    np.testing.assert_allclose(found, np.linalg.eigvalsh(A), rtol=1e-12, atol=1e-13 * scale)
    np.testing.assert_allclose(A @ axes, axes * found, rtol=1e-12, atol=1e-13 * scale)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-13)


@pytest.mark.parametrize("slope", [0.0, 0.2])
@given(tilt=st.floats(-1.5, 1.5), off=st.floats(-0.2, 0.2), seed=st.integers(0, 100))
@settings(deadline=None, max_examples=15)
def test_axis_is_found_from_a_bad_guess(slope: float, tilt: float, off: float, seed: int) -> None:
    """Only a third of the surface is visible, with noise; a frustum must not tilt the axis."""
    rng = np.random.default_rng(seed)
    points, normals = half_cone(rng, slope=slope)
    rotation = tilted(tilt)
    cloud = rows_of((points + rng.normal(0, 0.01, points.shape)) @ rotation.T)
    axis, point = rotation @ [0.1, off, 1.0], rotation @ [0.1, off, 0.0]
    axis /= np.linalg.norm(axis)
    weight = np.full(600, 1 / 600, np.float32)

    fit_axis(cloud, weight, rows_of(normals @ rotation.T), axis, point, 4)

    assert abs(axis @ rotation[:, 2]) > (0.998 if slope == 0 else 0.995)  # slices assume a cylinder
    assert np.linalg.norm(point - (point @ rotation[:, 2]) * rotation[:, 2]) < 0.05


def visible_box(rng: np.random.Generator, yaw: float) -> tuple[F4, F4]:
    """Return points and normals (3, n) of the three visible faces of a box."""
    half = np.array([0.6, 0.9, 0.7])
    points, normals = [], []
    for axis, sign in ((0, 1), (1, 1), (2, 1)):
        face = rng.uniform(-1, 1, (300, 3))
        face[:, axis] = sign
        points.append(face * half)
        normals.append(np.tile(np.eye(3)[axis] * sign, (300, 1)))
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    cloud, directions = np.concatenate(points) @ rotation.T, np.concatenate(normals) @ rotation.T
    return rows_of(cloud), rows_of(directions)


def solid_features(cloud: F4, normals: F4) -> F4:
    out = np.zeros(len(SOLID_NAMES), np.float32)
    low, high = float(cloud[2].min()), float(cloud[2].max())
    revolution = np.full(8, 0.1, np.float32)
    owner = np.arange(cloud.shape[1])
    solids(cloud, owner, cloud[0], cloud[1], normals, EYE, low, high, revolution, out)
    return out


@pytest.mark.parametrize("yaw", [-0.6, -0.3, 0.0])
def test_box_fits_a_box_and_can_does_not(yaw: float) -> None:
    """Boxes and cans are confused most often; corners must distinguish them despite noise."""
    rng = np.random.default_rng(0)
    cloud, normals = visible_box(rng, yaw)
    box = solid_features(cloud + rng.normal(0, 0.01, cloud.shape).astype(np.float32), normals)
    side, directions = half_cone(rng, slope=0.0)
    can = solid_features(rows_of(side), rows_of(directions))

    assert box[INDEX["box_faces"]] < 0.03
    assert box[INDEX["corner_upright"]] < 0.08 < can[INDEX["corner_upright"]]
    assert 2 * box[INDEX["box_sides"]] < can[INDEX["box_sides"]]


def test_ball_has_small_residual_unlike_box() -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals @ EYE > 0]
    ball = solid_features(rows_of(normals + np.array([0.0, 0.0, 1.0])), rows_of(normals))
    cloud, directions = visible_box(rng, 0.0)

    assert ball[INDEX["ball_residual"]] < 0.01
    assert ball[INDEX["ball_height"]] == pytest.approx(1.0 / np.ptp(normals[:, 2]), abs=0.2)
    assert solid_features(cloud, directions)[INDEX["ball_residual"]] > 0.05


def outline_of(cloud: F8, eye: F4 = EYE) -> F4:
    out = np.zeros(len(OUTLINE_NAMES), np.float32)
    outline(rows_of(cloud), eye, out)
    return out


def test_outline_is_independent_of_depth_errors() -> None:
    """Noise moves points along their rays, which must not change the outline."""
    rng = np.random.default_rng(0)
    points, _ = half_cone(rng, slope=0.2)
    rays = points - EYE
    noisy = EYE + rays * (1 + rng.normal(0, 0.02, (600, 1)))

    np.testing.assert_allclose(outline_of(noisy), outline_of(points), atol=0.02)


def test_long_outline_ends_at_narrow_end() -> None:
    """A lying bottle must have the same outline whether it points left or right."""
    rng = np.random.default_rng(0)
    points, _ = half_cone(rng, slope=0.35)
    lying = points[:, [0, 2, 1]] * [1, 1.5, 1]
    left, right = outline_of(lying), outline_of(lying * [1, -1, 1])
    widths = left[2 * OUTLINE_SLICES : 4 * OUTLINE_SLICES : 2]

    assert widths[0] > 2 * widths[-1] > 0
    np.testing.assert_allclose(left, right, atol=0.05)


@given(st.lists(st.floats(-100, 100, width=32), min_size=60, max_size=300), st.floats(0.01, 10))
@settings(deadline=None, max_examples=30)
def test_inner_ranges_are_quantiles(values: list[float], scale: float) -> None:
    row = (np.array(values) * scale).astype(np.float32)
    low, high = inner_range(row)
    bin_width = float(np.ptp(row)) / 64

    assert np.quantile(row, 0.0) <= low <= high <= np.quantile(row, 1.0) + 1e-3 * bin_width + 1e-6
    assert np.mean(row < low - bin_width) <= 0.03
    assert np.mean(row > high + bin_width) <= 0.03
