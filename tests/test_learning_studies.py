"""The ablation studies of the model card compare the methods that their rows name."""

from typing import Any

import numpy as np
import pytest

from shapecat.config import SurfaceSettings
from shapecat.description import BLOCKS, DESCRIPTOR_NAMES
from shapecat.evaluation import View
from shapecat.evaluation.training import fit_views
from shapecat.evaluation.views import DescribedViews
from shapecat.learning.shape_functions import shape_functions
from shapecat.models.arrangements import ArrangementOptions
from shapecat.models.studies import compare_with_plain, next_frames, sampled, spread, subsample
from shapecat.models.worlds import simulate_world


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
    world = ArrangementOptions(
        7, ("pan",), unknown=0.0, lying=0.9, leaning=0.5, cameras=1, keep=True
    )
    views = [view for k in range(4) for view in simulate_world(world, k)]
    manners = [view.manner for view in views if view.label in {"cup", "can", "bottle"}]

    assert {"lying", "leaning"} <= set(manners)
    assert manners.count("upright") < len(manners) / 3
    assert all(view.view is not None and len(view.view.points) == view.points for view in views)
    assert all(0.5 <= view.overlap <= 1 for view in views)


def described(seed: int) -> DescribedViews:
    """Make views of two categories that differ in every component, and slightly in shape."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(["ball", "box"], 30)
    descriptors = rng.normal(0, 1, (60, len(DESCRIPTOR_NAMES))) + 3.0 * (labels == "box")[:, None]
    functions = [shape_functions(sheet(k) * (1 + k // 30), rng) for k in range(60)]
    numbers = np.arange(60)
    return DescribedViews(
        descriptors.astype(np.float32),
        labels,
        np.array([f"{seed} {k}" for k in numbers]),
        numbers + 100,
        np.ones(60),
        np.zeros(60),
        functions=np.array(functions, np.float32),
    )


@pytest.mark.usefixtures("few_trees")
def test_the_model_stands_beside_plain_learners_on_the_same_views() -> None:
    train, test = described(1), described(2)
    nothing = train.where(np.zeros(0, np.int64))
    choices: dict[str, Any] = {"blocks": tuple(BLOCKS), "seed": 0, "jobs": 1}
    model = fit_views(train, nothing, rounds=20, **choices)

    rows = compare_with_plain(train, test, model, **choices)

    names = [name for name, *_ in rows]
    assert names[:3] == ["the model", "shapecat", "forest"]
    assert names[-2:] == ["forest on D2", "forest on D2, D3, A3 (ESF-like)"]
    assert {learned for _, learned, *_ in rows} == {"60"}
    assert rows[0][2:] == ("1.000", "1.000")
