"""Tests of surface reconstruction: voxels, Growing Neural Gas and its kernels."""

from typing import Any, Literal, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from shapecat.arrays import F4, F8, I4
from shapecat.config import SurfaceSettings
from shapecat.jit import kernel
from shapecat.surface import MIN_POINTS, reconstruct, voxelize
from shapecat.surface.graph import finish_graph
from shapecat.surface.growth import Cloud, Rates, grow_fritzke
from shapecat.surface.neurons import connect, empty_gas, index_mask
from shapecat.surface.simd import adapt, three_nearest, two_nearest
from shapecat.surface.triangles import triangles_of
from shapecat.types import NeuralGas

Method = Literal["fritzke", "thesis"]
METHODS = get_args(Method)
SMALL = SurfaceSettings(neurons=40, signals=2000)


def half_sphere(count: int = 500, radius: float = 0.05, seed: int = 0) -> F4:
    """Return points on the upper half of a sphere."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points[:, 2] = np.abs(points[:, 2])
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return points.astype(np.float32)


def surface(method: Method) -> SurfaceSettings:
    return SurfaceSettings(neurons=40, signals=2000, method=method)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def gas_of(points: F4, method: Method = "fritzke", seed: int = 0) -> NeuralGas:
    gas = reconstruct(points, settings=surface(method), rng=rng(seed))
    assert gas is not None
    return gas


# voxels


@given(
    points=st.lists(st.tuples(*[st.floats(-2, 2, width=32)] * 3), max_size=40),
    voxel_m=st.floats(0.01, 1.0),
)
@settings(deadline=None, max_examples=40)
def test_voxels_average_their_points(
    points: list[tuple[float, float, float]], voxel_m: float
) -> None:
    """Guards against a centroid that mixes voxels, and against a lost voxel."""
    cloud = np.array(points, np.float32).reshape(-1, 3)
    cells: dict[tuple[int, ...], list[F4]] = {}
    for point in cloud:
        # the same arithmetic as in the grid, as a point on a border may fall on either side
        key = tuple(np.rint(np.float64(point) * (65536 / voxel_m)).astype(np.int64) >> 16)
        cells.setdefault(key, []).append(point)
    expected = [np.mean(cells[key], 0) for key in sorted(cells)]
    found = voxelize(cloud, voxel_m=voxel_m)
    assert found.shape == (len(cells), 3)
    np.testing.assert_allclose(found, np.reshape(expected, (-1, 3)), atol=voxel_m * 1e-4)


def test_voxels_are_independent_of_point_order() -> None:
    """Guards against results that differ between workers or readers."""
    cloud = half_sphere(3000)
    shuffled = cloud[rng().permutation(len(cloud))]
    np.testing.assert_array_equal(voxelize(cloud, voxel_m=0.005), voxelize(shuffled, voxel_m=0.005))


def test_distant_voxels_need_no_memory_between_them() -> None:
    cloud = np.array([[-2000, 0, 0], [2000, 2000, 2000]], np.float32)
    assert len(voxelize(cloud, voxel_m=0.005)) == 2


@pytest.mark.parametrize(
    ("points", "voxel_m"),
    [
        ([[np.nan, 0, 0]], 0.01),
        ([[np.inf, 0, 0]], 0.01),
        ([[1.0, 0, 0]], 1e-9),
        ([[1.0, 0, 0]], 0.0),
        ([[1.0, 0, 0]], np.nan),
        ([[1.0, 0]], 0.01),
    ],
)
def test_voxelize_rejects_invalid_input(points: list[list[float]], voxel_m: float) -> None:
    with pytest.raises(ValueError, match=r"points|voxel_m"):
        voxelize(np.array(points, np.float32), voxel_m=voxel_m)


# the graph


@pytest.mark.parametrize("method", METHODS)
@given(
    count=st.integers(MIN_POINTS, 1500),
    stretch=st.tuples(*[st.floats(0, 1)] * 3),
    seed=st.integers(0, 99),
)
@settings(deadline=None, max_examples=15)
def test_every_graph_is_connected_and_within_its_points(
    method: Method, count: int, stretch: tuple[float, float, float], seed: int
) -> None:
    """Guards against isolated neurons, separate parts, repeated edges, and stray neurons."""
    points = (rng(seed).uniform(-1, 1, (count, 3)) * stretch).astype(np.float32)
    gas = reconstruct(points, settings=surface(method), rng=rng(seed))
    if gas is None:
        assert max(stretch) < 1e-5, "only a point has no surface"
        return
    edges, k = gas.edges.astype(int), len(gas.neurons)
    assert 3 <= k <= (80 if method == "thesis" else 40)
    assert np.all(edges[:, 0] < edges[:, 1])
    assert [tuple(edge) for edge in edges] == sorted({tuple(edge) for edge in edges})
    matrix = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(k, k))
    assert connected_components(matrix, directed=False)[0] == 1
    if min(stretch) > 0.01:
        faces = ConvexHull(points).equations
        assert np.max(gas.neurons @ faces[:, :3].T + faces[:, 3]) < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_graph_is_reproducible(method: Method) -> None:
    points = half_sphere()
    first, second, other = (gas_of(points, method, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.neurons, second.neurons)
    np.testing.assert_array_equal(first.edges, second.edges)
    assert not np.array_equal(first.neurons, other.neurons)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_thresholds_scale_with_the_object(method: Method, scale: float) -> None:
    """With thresholds in metres, a large object would get more neurons than a small one."""
    points = half_sphere()
    gas = gas_of(points, method)
    scaled = gas_of((points * scale).astype(np.float32), method)
    assert len(scaled.neurons) == pytest.approx(len(gas.neurons), abs=3)
    spread = np.linalg.norm(scaled.neurons, axis=1).mean() / scale
    assert spread == pytest.approx(np.linalg.norm(gas.neurons, axis=1).mean(), rel=0.02)


@pytest.mark.parametrize("method", METHODS)
def test_neurons_cover_the_surface_evenly(method: Method) -> None:
    gas = gas_of(half_sphere(1000), method)
    assert np.linalg.norm(gas.neurons, axis=1) == pytest.approx(0.05, rel=0.05)
    gaps = np.linalg.norm(gas.neurons[:, None] - gas.neurons, axis=2)
    gaps[np.diag_indices_from(gaps)] = np.inf
    assert gaps.min(0).max() < 3.5 * gaps.min(0).mean()
    assert len(triangles_of(gas.edges, len(gas.neurons))) > len(gas.neurons) / 2


def test_neurons_are_less_noisy_than_points() -> None:
    """Averaging noise is the reason for using a neural gas."""
    clean = half_sphere(1000)
    noisy = (clean * (1 + 0.04 * rng(5).normal(size=(1000, 1)))).astype(np.float32)
    off_points = np.std(np.linalg.norm(noisy, axis=1))
    off_neurons = np.std(np.linalg.norm(gas_of(noisy).neurons, axis=1))
    assert off_neurons < off_points / 2


def test_degenerate_points_have_no_surface() -> None:
    few = half_sphere(MIN_POINTS - 1)
    same = np.full((100, 3), 0.3, np.float32)
    two = np.repeat(np.array([[0, 0, 0], [1, 0, 0]], np.float32), 50, axis=0)
    for points in (np.zeros((0, 3), np.float32), few, same, two):
        assert reconstruct(points, settings=SMALL, rng=rng()) is None


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_points_are_rejected(method: Method, value: float) -> None:
    """Kernels that reorder sums must not get NaN, not even at a point that they skip."""
    points = half_sphere(3000)
    points[1, 2] = value
    with pytest.raises(ValueError, match="finite"):
        reconstruct(points, settings=surface(method), rng=rng())


def test_wrong_shapes_are_rejected() -> None:
    with pytest.raises(ValueError, match="shape"):
        reconstruct(np.zeros((50, 2), np.float32), settings=SMALL, rng=rng())


def test_small_separate_part_is_dropped_and_large_one_joined() -> None:
    """Small parts are points of a neighbour; an occluder may divide an object into large ones."""
    body = half_sphere(600)
    crumb = half_sphere(60, 0.01, seed=1) + np.float32(0.5)
    assert np.ptp(gas_of(np.concatenate([body, crumb])).neurons[:, 0]) < 0.2
    twin = half_sphere(600, seed=1) + np.array([0.5, 0, 0], np.float32)
    assert np.ptp(gas_of(np.concatenate([body, twin])).neurons[:, 0]) > 0.4


# the kernels


@kernel
def _search(x: F4, y: F4, z: F4, sx: float, sy: float, sz: float) -> Any:
    mask = index_mask(x.size)
    return (
        two_nearest(x, y, z, x.size, sx, sy, sz, mask),
        three_nearest(x, y, z, x.size, sx, sy, sz, mask),
    )


@pytest.mark.parametrize("size", [16, 80, 528])
def test_simd_search_finds_nearest_neurons(size: int) -> None:
    """Guards against a skipped lane or remainder, and a winner listed twice."""
    places = rng(size).uniform(-1, 1, (3, size)).astype(np.float32)
    for signal in rng(1).uniform(-1, 1, (200, 3)).astype(np.float32):
        two, three = _search(*places, *signal)
        squared = np.sum((places.T - signal) ** 2, axis=1)
        order = np.argsort(squared)
        assert two == three[:2]
        assert len(set(three)) == 3
        # ties within the replaced bits may come in any order
        np.testing.assert_allclose(squared[list(three)], squared[order[:3]], rtol=2e-4)


@kernel
def _adapt(x: F4, y: F4, z: F4, edge_birth: I4, wins: I4, row: int, winner: int, rates: F8) -> Any:
    return adapt(
        x,
        y,
        z,
        x.size,
        1.0,
        2.0,
        3.0,
        edge_birth,
        row,
        1 << 29,
        wins,
        winner,
        rates[0],
        rates[1],
    )


def test_simd_adaptation_moves_only_winner_and_its_neighbours() -> None:
    places = rng().uniform(-1, 1, (3, 48)).astype(np.float32)
    edge_birth = np.full((2, 48), 1 << 29, np.int32)
    wins = np.arange(48, dtype=np.int32)
    edge_birth[1, [3, 20, 47]] = [1, 15, 40]
    x, y, z = places.copy()
    age = _adapt(x, y, z, edge_birth.reshape(-1), wins, 48, 17, np.array([0.5, 0.1]))
    rate = np.zeros(48)
    rate[[3, 20, 47]] = 0.1
    rate[17] = 0.5
    expected = places + rate * (np.array([[1], [2], [3]]) - places)
    np.testing.assert_allclose([x, y, z], expected, atol=1e-6)
    assert age == 47 - 40


def test_third_nearest_neuron_is_not_linked_across_a_gap() -> None:
    """Two neurons on the far wall of a cup would be joined to its near wall."""
    left, right = [[0, 0, 0], [1, 0, 0]], [[20, 0, 0], [21, 0, 0], [20, 1, 0], [21, 1, 0]]
    places = np.array([*left, *right], np.float32)
    gas = empty_gas(len(places))
    for axis in range(3):
        gas[axis][: len(places)] = places[:, axis]
    points = np.repeat(places, 2, axis=0)
    adjacent = finish_graph(Cloud(*np.ascontiguousarray(points.T)), gas, len(places), 0.1)

    assert adjacent[0, 1]
    assert adjacent[2:, 2:].sum() >= 8
    assert np.argwhere(adjacent[:2, 2:]).tolist() == [[1, 0]]  # the bridge between the parts


def _fritzke(points: F4, state: int, target: int, signals: int, interval: int) -> NeuralGas:
    """Run Algorithm 3 of the thesis step by step, with the deviations that the kernel states.

    ``state`` seeds the order of the points; after each ``interval`` of the ``signals``, a neuron is
    added, up to ``target``.
    """
    places = [np.float64(points[0]), np.float64(points[1])]
    error, age = [0.0, 0.0], {frozenset((0, 1)): 0}
    order: list[int] = list(range(len(points)))
    for signal in range(signals):
        at = signal % len(points)
        if at == 0:
            for i in range(len(order) - 1, 0, -1):
                state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
                j = ((state >> 32) * (i + 1)) >> 32
                order[i], order[j] = order[j], order[i]
        p = np.float64(points[order[at]])
        away = [float(np.sum((place - p) ** 2)) for place in places]
        a, b = np.argsort(away)[:2].tolist()
        error[a] += away[a]
        rest = 1 - 0.9 * signal / signals
        for edge in age:
            if a in edge:
                age[edge] += 1
        for j in {j for edge in age if a in edge for j in edge} - {a}:
            places[j] = places[j] + 0.006 * rest * (p - places[j])
        places[a] = places[a] + 0.1 * rest * (p - places[a])
        age[frozenset((a, b))] = 0
        for edge in sorted(age, key=sorted):
            degrees = [sum(i in other for other in age) for i in edge]
            if age[edge] > 10 and min(degrees) > 1:
                del age[edge]
        if (signal + 1) % interval == 0 and len(places) < target:
            q = int(np.argmax(error))
            f = max({j for edge in age if q in edge for j in edge} - {q}, key=lambda j: error[j])
            places.append((places[q] + places[f]) / 2)
            del age[frozenset((q, f))]
            age[frozenset((q, len(error)))] = age[frozenset((f, len(error)))] = 0
            error[q] /= 2
            error[f] /= 2
            error.append(error[q])
        error = [value * 0.9995 for value in error]
    return NeuralGas(np.array(places), np.array(sorted(sorted(edge) for edge in age)))


def test_kernel_matches_published_algorithm() -> None:
    """The kernel stores ages of edges, errors and rates in other forms, for the same result."""
    points = half_sphere(60, radius=1.0)
    gas = empty_gas(20)
    gas.x[:2], gas.y[:2], gas.z[:2] = points[:2].T
    connect(gas, 0, 1)
    count = grow_fritzke(
        Cloud(*(np.ascontiguousarray(axis) for axis in points.T)),
        np.uint64(7), gas, 20, 600, 18, Rates(0.1, 0.006, 10),
    )  # fmt: skip
    expected = _fritzke(points, 7, 20, 600, 18)
    assert count == len(expected.neurons) == 20
    found = np.stack([gas.x, gas.y, gas.z], axis=1)[:count]
    np.testing.assert_allclose(found, expected.neurons, atol=1e-4)
    linked = gas.edge_birth.reshape(gas.x.size, -1)[:count, :count] < 1 << 29
    np.testing.assert_array_equal(np.argwhere(np.triu(linked)), expected.edges)


def test_distant_third_neighbour_is_not_linked() -> None:
    """The third neighbour of two isolated neurons is across a gap; only one edge may cross it."""
    row = np.stack([np.arange(8.0), np.zeros(8), np.zeros(8)], axis=1) / 10
    pair = np.array([[0.0, 0.9, 0.0], [0.1, 0.9, 0.0]])
    neurons = np.concatenate([row, pair]).astype(np.float32)
    around = np.array([[0.01, 0, 0], [-0.01, 0, 0], [0, 0.01, 0], [0, -0.01, 0]], np.float32)
    points = (neurons[:, None] + around).reshape(-1, 3)
    many = np.concatenate([points, np.repeat(points[-8:], 4, axis=0)])  # the pair has weight
    gas = empty_gas(len(neurons))
    gas.x[: len(neurons)], gas.y[: len(neurons)], gas.z[: len(neurons)] = neurons.T
    cloud = Cloud(*(np.ascontiguousarray(axis) for axis in many.T))

    adjacent = finish_graph(cloud, gas, len(neurons), 0.2)

    between = adjacent[:8, 8:]
    assert adjacent.shape == (10, 10)
    assert np.count_nonzero(between) == 1
    assert adjacent[8, 9]
    assert all(adjacent[k, k + 1] for k in range(7))
