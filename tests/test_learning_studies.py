"""What the studies of the model card compare: it has to be what their rows are called."""

import numpy as np
import pytest

from shapecat.config import SurfaceSettings
from shapecat.evaluation import View
from shapecat.models.studies import next_frames, sampled, spread, subsample
from shapecat.models.worlds import World, simulate_world


def sheet(seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (800, 3))
    points[:, 2] = 0.02
    return points.astype(np.float32)


def nearest(points: np.ndarray) -> float:
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(gaps.min())


def test_farthest_points_keep_apart() -> None:
    rng = np.random.default_rng(1)
    points = sheet()

    assert nearest(points[spread(points, 80, rng)]) > 5 * nearest(
        points[subsample(points, 80, rng)]
    )


def test_sampled_graphs_stand_on_the_points_themselves() -> None:
    """Moved neurons would be another method than the row is called."""
    points = sheet()
    for choose in (spread, subsample):
        gas = sampled(points, choose, SurfaceSettings(), np.random.default_rng(2))

        assert len(gas.neurons) == 80
        assert np.all((gas.neurons[:, None] == points).all(axis=2).any(axis=1))
        assert np.all(gas.edges[:, 0] < gas.edges[:, 1])
        assert len(np.unique(gas.edges, axis=0)) == len(gas.edges)
        assert np.bincount(gas.edges.ravel(), minlength=80).min() >= 6


def test_the_next_frame_is_almost_the_same_and_not_the_same() -> None:
    view = View(sheet(), np.array([0.6, 0.2, 0.5]), "box", "b")
    (later,) = next_frames([view], seed=0)

    assert later.category == "box"
    assert 0 < np.linalg.norm(later.points.mean(axis=0) - view.points.mean(axis=0)) < 0.01
    assert np.linalg.norm(later.eye) == pytest.approx(np.linalg.norm(view.eye))


def test_training_tables_hold_what_they_are_asked_for() -> None:
    """Shares that do not arrive leave the model as it was."""
    world = World(7, ("pan",), unknown=0.0, lying=0.9, leaning=0.5, cameras=1, keep=True)
    views = [view for k in range(4) for view in simulate_world(world, k)]
    manners = [view.manner for view in views if view.label in {"cup", "can", "bottle"}]

    assert {"lying", "leaning"} <= set(manners)
    assert manners.count("upright") < len(manners) / 3
    assert all(view.view is not None and len(view.view.points) == view.points for view in views)
    assert all(0.5 <= view.overlap <= 1 for view in views)
