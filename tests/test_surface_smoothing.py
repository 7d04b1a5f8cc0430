"""Tests of smoothing by moving least squares."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapecat.arrays import F4
from shapecat.config import SurfaceSettings
from shapecat.geometry import rotation_from_quaternion
from shapecat.surface import smooth, thin, voxelize


def cap(count: int, noise: float, seed: int = 0) -> F4:
    """Return noisy points of a half sphere with a radius of 40 mm."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points[:, 2] = np.abs(points[:, 2])
    radii = 0.04 + rng.normal(0, noise, (count, 1))
    found: F4 = points / np.linalg.norm(points, axis=1, keepdims=True) * radii
    return found.astype(np.float32)


def test_smoothing_removes_noise_and_keeps_size() -> None:
    """A mean or a plane alone would pull a curved surface inwards, by a millimetre here."""
    before = np.linalg.norm(cap(1500, 0.002), axis=1)
    after = np.linalg.norm(smooth(cap(1500, 0.002), radius_m=0.015), axis=1)

    assert after.std() < before.std() / 2
    assert abs(after.mean() - 0.04) < 0.0003


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 1000))
def test_plane_is_unchanged(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flat = np.c_[rng.uniform(-0.05, 0.05, (300, 2)), np.zeros(300)]
    points = (flat @ rotation_from_quaternion(rng.normal(size=4)).T + [0.3, -0.2, 1]).astype("f4")
    moved = smooth(points, radius_m=0.03)

    assert len(moved) == len(points)
    assert np.abs(moved - points).max() < 1e-5


def test_smoothing_is_independent_of_position_and_order() -> None:
    """A neighbour cell that is not searched would show in a shifted grid."""
    points = cap(600, 0.002)
    moved = smooth(points, radius_m=0.02)
    shifted = smooth(points + np.float32(0.0137), radius_m=0.02)
    order = np.random.default_rng(1).permutation(len(points))

    assert np.abs(shifted - np.float32(0.0137) - moved).max() < 1e-5
    assert np.abs(smooth(points[order], radius_m=0.02) - moved[order]).max() < 1e-5


def test_points_with_few_neighbours_are_removed() -> None:
    """The count must agree with the distances between all pairs of points."""
    rng = np.random.default_rng(3)
    points = np.c_[rng.uniform(0, 0.1, (200, 2)), rng.normal(0, 1e-3, 200)].astype("f4")
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    lonely = (apart < 0.008).sum(axis=1) < 4

    assert 0 < lonely.sum() < 200
    assert len(smooth(points, radius_m=0.008)) == 200 - lonely.sum()


def test_outliers_are_removed() -> None:
    points = np.r_[cap(800, 0.001), [[0.2, 0.2, 0.2]]].astype(np.float32)

    assert np.abs(smooth(points, radius_m=0.015)).max() < 0.05


@pytest.mark.parametrize("count", [0, 1, 3, 30])
def test_degenerate_points_give_finite_results(count: int) -> None:
    """Points in one place or on a line have no normal."""
    same = np.full((count, 3), 0.5, np.float32)
    line = (same + np.linspace(0, 0.02, count)[:, None] * [1, 1, 0]).astype(np.float32)
    for points in (same, line):
        moved = smooth(points, radius_m=0.01)
        assert len(moved) <= count
        assert np.abs(moved - 0.5).max(initial=0) < 0.021


@pytest.mark.parametrize(
    ("points", "radius"),
    [([[0, 0, np.nan]] * 5, 0.01), ([[0, 0, 0], [1, 0, 0]], 1e-7), ([[0, 0, 0]], 0), ([[0, 0]], 1)],
)
def test_invalid_input_is_rejected(points: list[list[float]], radius: float) -> None:
    with pytest.raises(ValueError, match=r"points|radius"):
        smooth(np.array(points, np.float32), radius_m=radius)


def test_smoothing_is_off_by_default() -> None:
    """The default model was trained on points that were only averaged."""
    points = cap(6000, 0.002)
    averaged = voxelize(points, voxel_m=0.005)
    enabled = SurfaceSettings(smooth_radius_m=0.015)

    assert np.array_equal(thin(points, settings=SurfaceSettings()), averaged)
    assert np.array_equal(thin(points, settings=enabled), smooth(averaged, radius_m=0.015))
