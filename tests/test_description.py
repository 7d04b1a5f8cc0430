"""Tests of the descriptor: names, invariance, finite values and single blocks."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from shapecat.arrays import F4, F8, Record, array
from shapecat.config import SurfaceSettings
from shapecat.description import BLOCKS, DESCRIPTOR_NAMES, describe
from shapecat.description.curvature import assign, fit_surfaces
from shapecat.description.distances import euclidean_distances, geodesic_distances
from shapecat.description.profile import vertical_axis
from shapecat.description.rotation_axis import rotation_axis
from shapecat.surface import reconstruct
from shapecat.types import NeuralGas

EYE = np.array([0.8, 0.1, 0.7], np.float32)
METRIC = [i for block in ("metric", "view") for i in range(BLOCKS[block].start, BLOCKS[block].stop)]
SCALE_FREE = [i for i in range(len(DESCRIPTOR_NAMES)) if i not in METRIC]


class View(Record):
    """The visible points of a shape, and their graph."""

    points: F4 = array("n 3", "f4")
    gas: NeuralGas


def visible(points: F8, normals: F8, seed: int = 0, count: int = 900) -> View:
    """Return the points that face the eye, thinned to ``count``, with 0.5 mm noise."""
    rng = np.random.default_rng(seed)
    facing = np.flatnonzero(np.sum(normals * (EYE - points), axis=1) > 0)
    facing = rng.choice(facing, min(count, len(facing)), replace=False)
    cloud = points[facing] + rng.normal(scale=0.0005, size=(len(facing), 3))
    gas = reconstruct(
        cloud.astype(np.float32), settings=SurfaceSettings(neurons=60, signals=4000), rng=rng
    )
    assert gas is not None
    return View(cloud, gas)


def grid(count: int, low: float, high: float) -> tuple[F8, F8]:
    """Return the angles and heights of an even grid as two flat arrays."""
    angle, step = np.meshgrid(
        np.arange(count) * 2 * np.pi / count, np.linspace(low, high, count // 3)
    )
    return angle.ravel(), step.ravel()


def ball(seed: int = 0, radius: float = 0.05, *, hollow: bool = False) -> View:
    angle, z = grid(120, -0.99, 0.0 if hollow else 0.99)
    r = np.sqrt(1 - z**2)
    normals = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return visible(normals * radius + [0, 0, radius], -normals if hollow else normals, seed)


def can(seed: int = 0, radius: float = 0.035, height: float = 0.12, *, lying: bool = False) -> View:
    angle, z = grid(120, 0.0, height)
    wall = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    side = wall * radius + np.outer(z, [0, 0, 1])
    top = wall * (radius * np.sqrt(z / height))[:, None] + [0, 0, height]
    keep = slice(None, None, 4)
    points = np.concatenate([side, top[keep]])
    normals = np.concatenate([wall, np.tile([0.0, 0, 1], (len(top[keep]), 1))])
    if lying:
        rotation = np.array([[0.8, 0, 0.6], [-0.6, 0, 0.8], [0, -1.0, 0]])
        points, normals = points @ rotation.T + [0, 0, radius], normals @ rotation.T
    return visible(points, normals, seed)


def box(seed: int = 0) -> View:
    half = np.array([0.04, 0.06, 0.05])
    u, v = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    points, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            face = np.zeros((u.size, 3))
            face[:, axis], face[:, axis - 1], face[:, axis - 2] = sign, u.ravel(), v.ravel()
            points.append(face * half + [0, 0, half[2]])
            normals.append(np.tile(sign * np.eye(3)[axis], (u.size, 1)))
    return visible(np.concatenate(points), np.concatenate(normals), seed)


SHAPES: dict[str, Callable[[int], View]] = {"ball": ball, "can": can, "box": box}


def describe_view(view: View, eye: F4 = EYE) -> F4:
    return describe(view.points, view.gas, eye)


# names


def test_names_and_blocks_cover_the_descriptor() -> None:
    """A model stores names: each feature needs a unique one, and blocks must not overlap."""
    assert len(set(DESCRIPTOR_NAMES)) == len(DESCRIPTOR_NAMES) == len(describe_view(ball()))
    end = 0
    for block, columns in BLOCKS.items():
        assert columns.start == end
        end = columns.stop
        assert all(name.startswith(f"{block}.") for name in DESCRIPTOR_NAMES[columns])
    assert end == len(DESCRIPTOR_NAMES)


def describe_random(seed: int) -> F4:
    """Describe random points and edges, which reach bins that plain shapes leave empty."""
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(400, 3)) * np.power((1, 0.3, 0.6), seed)).astype(np.float32)
    edges = np.ascontiguousarray(np.argwhere(np.triu(rng.random((30, 30)) < 0.12, 1)))
    return describe(points, NeuralGas(points[:30], edges), rng.normal(size=3).astype(np.float32))


def test_every_feature_varies() -> None:
    """Guards against a component that is never written."""
    views = [
        *(make(seed) for make in SHAPES.values() for seed in range(2)),
        ball(hollow=True),
        can(lying=True),
    ]
    table = np.stack([*map(describe_view, views), *map(describe_random, range(3))])
    constant = {DESCRIPTOR_NAMES[k] for k in np.flatnonzero(np.ptp(table, axis=0) == 0)}

    # No shape here is curved enough for the last bin.
    assert {name for name in constant if not name.endswith("curvedness_5")} == set()


# invariance


@pytest.mark.parametrize("shape", SHAPES)
@given(yaw=st.floats(-np.pi, np.pi), shift=st.tuples(st.floats(-3, 3), st.floats(-3, 3)))
@settings(deadline=None, max_examples=8)
def test_descriptor_is_invariant_to_yaw_and_horizontal_shift(
    shape: str, yaw: float, shift: tuple[float, float]
) -> None:
    view = SHAPES[shape](0)
    c, s = np.cos(yaw), np.sin(yaw)
    rotation, offset = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([*shift, 0])

    def moved(points: F4) -> F4:
        return np.asarray(points @ rotation.T + offset, np.float32)

    gas = NeuralGas(moved(view.gas.neurons), view.gas.edges)
    found = describe(moved(view.points), gas, moved(EYE))
    np.testing.assert_allclose(found, describe_view(view), atol=0.02)
    assert np.abs(found - describe_view(view)).mean() < 1e-3


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("scale", [0.01, 4.0, 1000.0])
def test_scaling_changes_only_metric_blocks(shape: str, scale: float) -> None:
    view = SHAPES[shape](0)
    gas = NeuralGas(view.gas.neurons * np.float32(scale), view.gas.edges)
    found = describe(view.points * np.float32(scale), gas, EYE * np.float32(scale))
    expected = describe_view(view)
    np.testing.assert_allclose(found[SCALE_FREE], expected[SCALE_FREE], atol=0.01)
    metric = BLOCKS["metric"]
    np.testing.assert_allclose(found[metric], expected[metric] * scale, rtol=0.01)


def test_descriptor_is_independent_of_point_order() -> None:
    view = box()
    order = np.random.default_rng(0).permutation(len(view.points))
    found = describe(view.points[order], view.gas, EYE)
    np.testing.assert_allclose(found, describe_view(view), atol=2e-3)


def test_descriptor_varies_less_with_noise_than_with_shape() -> None:
    """Guards against a descriptor that reflects the randomness of the gas more than the object."""
    draws = {
        name: np.stack([describe_view(make(seed)) for seed in range(3)])[:, SCALE_FREE]
        for name, make in SHAPES.items()
    }
    spread = np.std(np.concatenate(list(draws.values())), axis=0) + 1e-3
    within = [np.abs((a[0] - a[1]) / spread).mean() for a in draws.values()]
    between = [
        np.abs((a[0] - b[1]) / spread).mean()
        for name, a in draws.items()
        for other, b in draws.items()
        if name < other
    ]
    assert max(within) < min(between) / 2


# finite values


def flat(count: int) -> F4:
    u, v = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    return np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], axis=1).astype(np.float32)


LINE = np.linspace(0, 1, 50, dtype=np.float32)[:, None] * np.array([1, 2, 3], np.float32)
DEGENERATE = {
    "level": flat(10),
    "upright": np.ascontiguousarray(flat(10)[:, [0, 2, 1]]),
    "line": LINE,
    "vertical line": LINE * np.array([0, 0, 1], np.float32),
    "one place": np.zeros((40, 3), np.float32),
    "one point": np.zeros((1, 3), np.float32),
    "two places": np.repeat(np.eye(2, 3, dtype=np.float32), 20, axis=0),
    "huge": flat(10) * np.float32(1e15),
    "tiny": flat(10) * np.float32(1e-15),
    "far away": flat(10) + np.float32(1e6),
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("eye", [(0, 0, 0), (0, 0, 5), (1, 2, 3), (1e6, 0, 0)])
def test_features_of_degenerate_points_are_finite(
    name: str, eye: tuple[float, float, float]
) -> None:
    points = DEGENERATE[name]
    chosen = points[:: max(1, len(points) // 12)]
    chosen = np.concatenate([chosen, chosen])[: max(2, len(chosen))]
    chain = np.array([[i, i + 1] for i in range(len(chosen) - 1)])
    for edges in (chain, chain[:1], chain[:0]):
        found = describe(points, NeuralGas(chosen, edges), np.array(eye, np.float32))
        assert np.isfinite(found).all()
        assert np.abs(np.delete(found, METRIC)).max() < 1e4


@given(data=st.data(), count=st.integers(2, 40), neurons=st.integers(2, 20))
@settings(deadline=None, max_examples=40)
def test_features_of_random_points_are_finite(
    data: st.DataObject, count: int, neurons: int
) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 1 << 30)))
    stretch = data.draw(st.tuples(*[st.sampled_from([0.0, 1e-6, 1.0, 100.0])] * 3))
    points = (rng.normal(size=(count, 3)) * stretch).astype(np.float32)
    places = (rng.normal(size=(neurons, 3)) * stretch).astype(np.float32)
    edges = np.argwhere(np.triu(rng.random((neurons, neurons)) < 0.2, 1))
    gas = NeuralGas(places, np.ascontiguousarray(edges))
    found = describe(points, gas, rng.normal(size=3).astype(np.float32))
    assert np.isfinite(found).all()


def test_points_far_from_graph_are_ignored() -> None:
    """A part of the object that its graph leaves out must not increase its extents."""
    view = can()
    crumbs = view.points[:20] + np.array([1, 0, 0], np.float32)
    found = describe(np.concatenate([view.points, crumbs]), view.gas, EYE)
    np.testing.assert_allclose(found, describe_view(view), atol=0.02)


@pytest.mark.parametrize("wrong", ["points", "eye", "gas", "shape", "few"])
def test_invalid_input_is_rejected(wrong: str) -> None:
    view = box()
    points, neurons, eye = view.points.copy(), view.gas.neurons.copy(), EYE.copy()
    if wrong == "points":
        points[5, 1] = np.nan
    if wrong == "eye":
        eye[0] = np.inf
    if wrong == "gas":
        neurons[3, 2] = np.nan
    if wrong == "shape":
        eye = eye[:2]
    gas = NeuralGas(neurons, view.gas.edges)
    if wrong == "few":
        gas = NeuralGas(neurons[:1], np.zeros((0, 2), int))
    with pytest.raises(ValueError, match=r"finite|expected|at least"):
        describe(points, gas, eye)


def test_edges_beyond_neurons_are_rejected() -> None:
    """A graph from a file must not lead to reads outside the arrays."""
    view = box()
    gas = NeuralGas(view.gas.neurons, np.array([[0, 9999]]))
    with pytest.raises(ValueError, match="edge"):
        describe(view.points, gas, EYE)


# the blocks


def test_geodesics_are_shortest_paths() -> None:
    view = can()
    distances = euclidean_distances(*(np.ascontiguousarray(axis) for axis in view.gas.neurons.T))
    i, j = view.gas.edges.astype(int).T
    graph = coo_array((distances[i, j], (i, j)), shape=distances.shape)
    expected = shortest_path(graph.tocsr(), directed=False)
    np.testing.assert_allclose(geodesic_distances(distances, view.gas.edges), expected, atol=1e-6)


def local_fit(view: View, radius: float) -> tuple[F4, F4]:
    x, y, z = (np.ascontiguousarray(axis) for axis in view.gas.neurons.T)
    points, starts = assign(np.ascontiguousarray(view.points.T), x, y, z, np.float32(1.0))
    normals, curvatures = fit_surfaces(
        points, starts, x, y, z, euclidean_distances(x, y, z), np.float32(radius), EYE
    )
    return normals, curvatures


def test_curvature_of_ball_and_bowl_has_true_sign_and_size() -> None:
    """Convex towards the sensor is positive, whatever the initial sign of the normal."""
    normals, curvatures = local_fit(ball(), 0.025)
    assert np.median(curvatures) == pytest.approx(1 / 0.05, rel=0.15)
    out = ball().gas.neurons - [0, 0, 0.05]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    assert np.mean(np.sum(normals.T * out, axis=1) > 0.97) > 0.8
    _, inside = local_fit(ball(hollow=True), 0.025)
    assert np.median(inside) == pytest.approx(-1 / 0.05, rel=0.15)


def test_lying_can_is_curved_in_one_direction() -> None:
    _, (most, least) = local_fit(can(lying=True), 0.02)
    assert np.median(most) == pytest.approx(1 / 0.035, rel=0.2)
    assert abs(np.median(least)) < 0.2 / 0.035


def test_axis_of_can_is_found_from_one_side() -> None:
    """The centre of the visible part is not the centre of the object."""
    for lying in (False, True):
        view = can(lying=lying)
        x, y, z = (np.ascontiguousarray(axis) for axis in view.gas.neurons.T / 0.05)
        normals, _ = local_fit(view, 0.02)
        weight = np.full(x.size, 1 / x.size, np.float32)
        axis, point = rotation_axis(x, y, z, weight, normals)
        direction = np.array([0.6, 0.8, 0]) if lying else np.array([0, 0, 1.0])
        assert abs(axis @ direction) > 0.97
        center = np.array([0, 0, 0.035 / 0.05]) if lying else np.zeros(3)
        across = (center - point) - ((center - point) @ axis) * axis
        assert np.linalg.norm(across) < 0.15
        if not lying:
            upright = vertical_axis(x, y, normals, weight)
            assert np.hypot(upright.x, upright.y) < 0.1


def test_context_features_match_their_names() -> None:
    value = dict(zip(DESCRIPTOR_NAMES, describe_view(box()).tolist(), strict=True))
    assert value["metric.height"] == pytest.approx(0.1, abs=0.006)
    assert value["context.height_to_across"] == pytest.approx(0.1 / (0.1 + 0.127), abs=0.04)
    assert value["context.axis_inward"] < 0.05
    assert value["view.distance"] == pytest.approx(np.linalg.norm(EYE - [0, 0, 0.05]), rel=0.05)
    bowl = dict(zip(DESCRIPTOR_NAMES, describe_view(ball(hollow=True)).tolist(), strict=True))
    assert bowl["context.axis_inward"] > 0.4
    assert bowl["context.share_convex"] < 0.05
    round_ = dict(zip(DESCRIPTOR_NAMES, describe_view(ball()).tolist(), strict=True))
    assert round_["context.sphere_residual"] < 0.05 < value["context.sphere_residual"]
    assert value["context.yaw_harmonic_4"] > 2 * round_["context.yaw_harmonic_4"]
