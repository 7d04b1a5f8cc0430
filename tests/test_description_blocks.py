"""Tests of blocks of the descriptor against plain NumPy, on surfaces without symmetry."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.distance import cdist

from shapecat.arrays import F4, F8
from shapecat.description.context import CONTEXT_NAMES, context
from shapecat.description.outline import OUTLINE_NAMES, OUTLINE_SLICES, outline
from shapecat.description.profile import PROFILE_NAMES, VerticalAxis, profile, vertical_axis
from shapecat.description.ranges import inner_range
from shapecat.description.surface import Surface

NEURONS, POINTS = 40, 300
LOW, HIGH = -1.3, 1.1
AXIS = VerticalAxis(0.15, -0.25, 0.08)


def random_surface(rng: np.random.Generator) -> Surface:
    """Return a surface of random points and neurons, longer in one direction than in another."""
    stretch = np.array([[1.1], [0.5], [0.7]])
    neurons = rng.normal([[0.1], [-0.2], [0.05]], stretch, (3, NEURONS))
    points = rng.normal(0, stretch, (3, POINTS))
    starts = np.sort(rng.integers(0, POINTS + 1, NEURONS + 1))
    starts[0], starts[-1] = 0, POINTS
    euclidean = cdist(neurons.T, neurons.T)
    longer = rng.uniform(1.0, 2.0, (NEURONS, NEURONS))
    return Surface(
        points=points.astype(np.float32),
        starts=starts,
        nearest=np.repeat(np.arange(NEURONS), np.diff(starts)),
        neurons=neurons.astype(np.float32),
        euclidean=euclidean.astype(np.float32),
        geodesic=(euclidean * (longer + longer.T) / 2).astype(np.float32),
        weight=(np.diff(starts) / POINTS).astype(np.float32),
        spacing=0.3,
        eye=np.array([4.0, -2.5, 3.0], np.float32),
        eye_distance_m=0.9,
        center=np.array([0.3, 0.4, 0.28]),
        unit=0.17,
    )


def ratio(a: float, b: float) -> float:
    return float(a / (a + b))


def random_normals(rng: np.random.Generator) -> F4:
    """Return unit vectors (3, k), most of them upward."""
    normals = rng.normal([[0.4], [0.1], [0.3]], size=(3, NEURONS))
    return np.asarray(normals / np.linalg.norm(normals, axis=0), np.float32)


def check(names: tuple[str, ...], out: F4, wanted: dict[str, float]) -> None:
    """Compare features with their values by name."""
    assert list(wanted) == list(names)
    for name, value in zip(names, out.tolist(), strict=True):
        assert value == pytest.approx(wanted[name], abs=2e-4), name


def widths(surface: Surface) -> F8:
    """Return the widths (16,) counterclockwise, the first in the direction of the sensor."""
    angles = np.arctan2(surface.eye[1], surface.eye[0]) + np.arange(16) * np.pi / 16
    directions = np.stack([np.cos(angles), np.sin(angles)])
    return np.asarray(np.ptp(surface.points[:2].T @ directions, axis=0))


def expected(surface: Surface, normals: F8, curvatures: F8) -> dict[str, float]:
    """Return the features by their definitions."""
    p, w, height = surface.neurons.astype(float), surface.weight.astype(float), HIGH - LOW
    width, level = widths(surface), (p[2] - LOW) / height
    spreads, axes = np.linalg.eigh((w * p) @ p.T)
    bends, folds = np.linalg.eigh((w * normals) @ normals.T)
    slant = np.hypot(normals[0], normals[1])
    yaw, turned = np.arctan2(normals[1], normals[0]), w * slant**2
    harmonics = {
        m: abs(np.sum(turned * np.exp(1j * m * yaw))) / (turned.sum() + 1e-6) for m in (1, 2, 4)
    }
    up = normals[2]
    away = p[:2] - [[AXIS.x], [AXIS.y]]
    r = np.hypot(*away)
    radius, top = np.sum(w * r), level > 0.5
    inward = (slant > 0.3) & (np.sum(away * normals[:2], axis=0) < 0)
    mean, spread = np.average(level, weights=w), np.sqrt(np.cov(level, aweights=w, ddof=0))
    slope = np.cov(level, r, aweights=w, ddof=0)[0, 1] / spread**2
    rows = np.vstack([2 * p, np.ones(NEURONS)]).T * np.sqrt(w)[:, None]
    ridge = np.vstack([rows, 1e-2 * np.eye(4)])  # it shrinks what the points do not determine
    target = np.append(np.sqrt(w) * np.sum(p**2, axis=0), np.zeros(4))
    center = np.linalg.lstsq(ridge, target, rcond=None)[0][:3]
    distance = np.linalg.norm(p - center[:, None], axis=0)
    size = np.sum(w * distance)
    geodesic, count = surface.geodesic.astype(float), NEURONS * (NEURONS - 1)
    base = -surface.center[2] / surface.unit
    return {
        "height_to_across": ratio(height, width[8]),
        "along_to_across": ratio(width[0], width[8]),
        "height_to_widest": ratio(height, width.max()),
        "narrow_to_wide": ratio(width.min(), width.max()),
        "mean_to_wide": ratio(width.mean(), width.max()),
        "spread_2_to_1": spreads[1] / spreads[2],
        "spread_3_to_1": spreads[0] / spreads[2],
        "spread_1_vertical": abs(axes[2, 2]),
        "spread_3_vertical": abs(axes[2, 0]),
        "normal_spread_2": bends[1],
        "normal_spread_3": bends[0],
        "normal_axis_vertical": abs(folds[2, 0]),
        **{f"yaw_harmonic_{m}": value for m, value in harmonics.items()},
        "share_up": np.sum(w[up > 0.8]),
        "share_side": np.sum(w[abs(up) < 0.4]),
        "share_down": np.sum(w[up < -0.25]),
        "share_up_top": np.sum(w[(up > 0.7) & (level > 0.75)]),
        "share_up_bottom": np.sum(w[(up > 0.7) & (level < 0.3)]),
        "axis_radius": ratio(radius, height),
        "axis_radius_spread": np.sqrt(np.sum(w * (r - radius) ** 2)) / radius,
        "axis_residual": AXIS.residual / radius,
        "axis_inward": np.sum(w[inward]),
        "axis_inward_top": np.sum(w[inward & top]),
        "axis_inward_bottom": np.sum(w[inward & ~top]),
        "axis_radius_top": ratio(np.average(r[top], weights=w[top]), radius),
        "axis_radius_bottom": ratio(np.average(r[~top], weights=w[~top]), radius),
        "axis_radius_slope": slope / radius,
        "sphere_residual": np.sqrt(np.sum(w * (distance - size) ** 2)) / size,
        "sphere_radius": 1 / (1 + size),
        "sphere_height": (center[2] - LOW) / height,
        "height_mean": mean,
        "height_deviation": spread,
        "height_skew": np.sum(w * (level - mean) ** 3) / spread**3,
        "share_convex": np.sum(w[curvatures.sum(axis=0) > 0]),
        "geodesic_to_straight": geodesic.sum() / surface.euclidean.sum(),
        "geodesic_longest": geodesic.max() / (geodesic.sum() / count),
        "geodesic_spread": ratio(geodesic.sum(axis=1).min(), geodesic.sum(axis=1).max()),
        "base_gap": ratio(LOW - base, height),
    }


@pytest.mark.parametrize("seed", range(3))
def test_context_has_its_features(seed: int) -> None:
    """A swapped, inverted or displaced feature would only make the model a little worse."""
    rng = np.random.default_rng(seed)
    surface, out = random_surface(rng), np.zeros(len(CONTEXT_NAMES), np.float32)
    normals, curvatures = random_normals(rng), rng.normal(size=(2, NEURONS)).astype(np.float32)
    found: Any = context(surface, normals, curvatures, AXIS, LOW, HIGH, out)

    check(CONTEXT_NAMES, out, expected(surface, normals.astype(float), curvatures.astype(float)))
    width = widths(surface)
    assert_allclose(found, [width.max(), width[8], width[0]], atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_profile_has_its_features(seed: int) -> None:
    """Each neuron counts for the two slices whose middles are nearest, the nearer one more."""
    rng = np.random.default_rng(seed)
    surface, out = random_surface(rng), np.zeros(len(PROFILE_NAMES), np.float32)
    normals, curvatures = random_normals(rng), rng.normal(size=(2, NEURONS)).astype(np.float32)
    profile(surface, normals, curvatures, AXIS, LOW, HIGH, out)

    p, w = surface.neurons.astype(float), surface.weight.astype(float)
    away, bend = p[:2] - [[AXIS.x], [AXIS.y]], curvatures.sum(axis=0)
    r, faces_axis = np.hypot(*away), np.sum(away * normals[:2], axis=0) < 0
    place = np.clip((p[2] - LOW) / (HIGH - LOW) * 8 - 0.5, 0, 7)
    shares = w * np.maximum(0, 1 - abs(place - np.arange(8)[:, None]))
    radii = [np.average(r, weights=share) for share in shares]
    sideways = (1 - abs(normals[2])) * faces_axis
    wanted = {}
    for k, share in enumerate(shares):
        wanted[f"{k}_share"] = share.sum()
        wanted[f"{k}_radius"] = radii[k] / max(radii)
        wanted[f"{k}_spread"] = np.sqrt(np.cov(r, aweights=share, ddof=0)) / max(radii)
        wanted[f"{k}_inward"] = np.average(sideways, weights=share)
        wanted[f"{k}_up"] = np.average(normals[2], weights=share)
        wanted[f"{k}_curvature"] = np.average(bend / (1 + abs(bend)), weights=share)
    check(PROFILE_NAMES, out, wanted)


def test_vertical_axis_is_nearest_to_the_lines_of_the_normals() -> None:
    rng = np.random.default_rng(5)
    surface, normals = random_surface(rng), random_normals(rng)
    x, y, w = surface.neurons[0], surface.neurons[1], surface.weight
    axis = vertical_axis(x, y, normals, w)

    across = np.stack([-normals[1], normals[0]]).astype(float)  # as long as the normal is level
    total = np.sum(w * np.sum(across**2, axis=0))
    prior = np.sqrt(0.01 * total + 1e-6) * np.eye(2)
    rows = np.vstack([(across * np.sqrt(w)).T, prior])
    target = np.append(np.sqrt(w) * (across[0] * x + across[1] * y), [0, 0])
    x0, y0 = np.linalg.lstsq(rows, target, rcond=None)[0]
    off = across[0] * (x - x0) + across[1] * (y - y0)
    assert_allclose(axis, [x0, y0, np.sqrt(np.sum(w * off**2) / total)], atol=1e-5)


def slices(along: F8, across: F8, *, to_narrow: bool) -> tuple[F8, float, float]:
    """Return alternating width and offset (20,) of ten slices, relative length, filled fraction.

    With ``to_narrow``, the slices end at the narrow end.
    """
    low, high = inner_range(along.astype(np.float32))
    number = np.clip((along - low) / (high - low) * OUTLINE_SLICES, 0, OUTLINE_SLICES - 1)
    parts = [across[number.astype(int) == k] for k in range(OUTLINE_SLICES)]
    width = np.array([np.ptp(part) for part in parts])
    middle = np.array([(part.min() + part.max()) / 2 for part in parts])
    aside = abs(middle - np.average(middle, weights=width))
    if to_narrow and np.sum(width * np.arange(-4.5, 5)) > 0:
        width, aside = width[::-1], aside[::-1]
    features = np.stack([width, aside], axis=1).ravel() / width.max()
    length = (high - low) / (high - low + width.max())
    return features, float(length), float(width.mean() / width.max())


@pytest.mark.parametrize("seed", range(3))
def test_outline_has_its_features(seed: int) -> None:
    """The outline is seen by a camera that looks at the middle of the object, upright."""
    surface = random_surface(np.random.default_rng(seed))
    out = np.zeros(len(OUTLINE_NAMES), np.float32)
    outline(surface.points, surface.eye, out)

    eye, points = surface.eye.astype(float), surface.points.T.astype(float)
    toward = eye / np.linalg.norm(eye)
    right = np.cross([0, 0, 1], toward) / np.hypot(*toward[:2])
    rays = points - eye
    image = rays @ np.stack([right, np.cross(toward, right)], axis=1)
    image *= np.linalg.norm(eye) / (rays @ -toward)[:, None]
    _, axes = np.linalg.eigh(np.cov(image.T))
    narrow, wide = (image @ axes).T
    upright, tall, full = slices(image[:, 1], image[:, 0], to_narrow=False)
    along, long, filled = slices(wide, narrow, to_narrow=True)
    numbers = [*upright, *along, tall, long, abs(axes[0, 1]), full, filled]
    check(OUTLINE_NAMES, out, dict(zip(OUTLINE_NAMES, numbers, strict=True)))
