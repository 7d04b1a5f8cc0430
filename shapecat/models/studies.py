"""Ablation studies for the model card: the contribution of each part of the method."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.config import Settings, SurfaceSettings
from shapecat.description import BLOCKS, DESCRIPTOR_NAMES, describe
from shapecat.evaluation import View, metrics
from shapecat.evaluation.baselines import compare_learners
from shapecat.evaluation.training import fit_views
from shapecat.evaluation.views import DescribedViews
from shapecat.learning import Categorizer
from shapecat.learning.incremental import add_categories
from shapecat.learning.training import encode
from shapecat.surface import reconstruct, voxelize
from shapecat.types import UNKNOWN, NeuralGas

__all__ = [
    "add_two_categories",
    "compare_surfaces",
    "compare_with_plain",
    "next_frames",
    "sampled",
    "spread",
    "subsample",
]

_MOST = 16_000
"""Number of views on which the baselines are trained; more take too long."""
_PAIRS = (("bottle", "plate"), ("bowl", "ball"), ("cup", "box"))
_FEW = (20, 100)
_ROUNDS = 250
_NEIGHBOURS = 6


def compare_with_plain(
    train: DescribedViews,
    test: DescribedViews,
    model: Categorizer,
    *,
    blocks: Sequence[str],
    seed: int,
    jobs: int,
) -> list[tuple[str, ...]]:
    """Compare the model with baseline classifiers on the same test views.

    Parameters
    ----------
    train : training views; a part of them trains the baselines.
    blocks : names of the descriptor's blocks to use.

    Returns
    -------
    Rows of classifier, number of training views, accuracy, balanced accuracy.
    """
    part = train.where(_some(len(train.labels), seed))
    truth, predicted = encode(test.labels, model.categories), _best(model, test.descriptors)
    table = metrics.confusion(truth, predicted, len(model.categories))
    figures = metrics.accuracy(truth, predicted), metrics.balanced_accuracy(table)
    rows = compare_learners(
        test,
        part,
        categories=model.categories,
        root=Path("simulated"),
        blocks=blocks,
        seed=seed,
        jobs=jobs,
    )
    return [
        ("the model", str(len(train.labels)), *(f"{value:.3f}" for value in figures)),
        *(
            (row.learner, str(row.learned), f"{row.accuracy:.3f}", f"{row.balanced_accuracy:.3f}")
            for row in rows
        ),
    ]


def _some(count: int, seed: int) -> I4:
    """Return the indices of the views on which the baselines are trained."""
    return np.sort(np.random.default_rng(seed).permutation(count)[:_MOST])


def _best(model: Categorizer, descriptors: F4) -> I4:
    return np.asarray(model.predict(descriptors).posteriors.argmax(axis=1))


_Reconstruct = Callable[[F4, np.random.Generator], NeuralGas | None]


def compare_surfaces(
    train: Sequence[View], test: Sequence[View], *, blocks: Sequence[str], seed: int, jobs: int
) -> list[tuple[str, ...]]:
    """Compare methods of surface reconstruction, each with a model of its own.

    Instability is the mean change of the descriptor between two frames, relative to the mean
    difference between views of different categories.

    Returns
    -------
    Rows of method, accuracy, instability, milliseconds from points to descriptor.
    """
    surface = Settings().surface
    ways: dict[str, _Reconstruct] = {
        "GNG (Fritzke)": lambda p, rng: reconstruct(p, settings=surface, rng=rng),
        "GNG (thesis, Algorithm 4)": lambda p, rng: reconstruct(
            p, settings=replace(surface, method="thesis"), rng=rng
        ),
        "farthest-point sampling": lambda p, rng: sampled(p, spread, surface, rng),
        "random subsampling": lambda p, rng: sampled(p, subsample, surface, rng),
    }
    return [_judge(name, way, train, test, blocks, seed, jobs) for name, way in ways.items()]


def _judge(
    name: str,
    way: _Reconstruct,
    train: Sequence[View],
    test: Sequence[View],
    blocks: Sequence[str],
    seed: int,
    jobs: int,
) -> tuple[str, ...]:
    learned, judged, later = (
        _described(views, way, seed + k)
        for k, views in enumerate((train, test, list(next_frames(test, seed))))
    )
    model = fit_views(
        learned,
        learned.where(np.zeros(0, np.int64)),
        seed=seed,
        rounds=_ROUNDS,
        blocks=tuple(blocks),
        jobs=jobs,
    )
    truth = encode(judged.labels, model.categories)
    right = metrics.accuracy(truth, _best(model, judged.descriptors))
    used = np.concatenate([np.arange(BLOCKS[b].start, BLOCKS[b].stop) for b in blocks])
    scale = learned.descriptors[:, used].std(axis=0) + 1e-6
    now, then = (views.descriptors[:, used] / scale for views in (judged, later))
    other = np.random.default_rng(seed).permutation(len(now))
    apart = truth != truth[other]
    moved = np.abs(now - then).mean() / np.abs(now - now[other])[apart].mean()
    return (name, f"{right:.3f}", f"{moved:.2f}", f"{1e3 * float(np.median(judged.seconds)):.2f}")


def _described(views: Sequence[View], way: _Reconstruct, seed: int) -> DescribedViews:
    """Describe views; without a graph, the descriptor is zero."""
    descriptors = np.zeros((len(views), len(DESCRIPTOR_NAMES)), np.float32)
    seconds = np.zeros(len(views))
    for k, view in enumerate(views):
        rng = np.random.default_rng((seed, k))
        begun = time.process_time()
        gas = way(view.points, rng)
        if gas is not None:
            descriptors[k] = describe(view.points, gas, view.eye)
        seconds[k] = time.process_time() - begun
    return DescribedViews(
        descriptors,
        np.array([view.category for view in views]),
        np.array([view.instance for view in views]),
        np.array([len(view.points) for view in views]),
        np.array([float(np.linalg.norm(view.points.mean(axis=0) - view.eye)) for view in views]),
        seconds,
    )


def next_frames(views: Sequence[View], seed: int) -> Iterator[View]:
    """Yield each view as a slowly moving camera sees it next.

    The points are turned by 2 degrees about z, shifted by 2 mm, get 1 mm of noise and are voxelized
    again.
    """
    c, s = np.cos(np.radians(2)), np.sin(np.radians(2))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    for k, view in enumerate(views):
        rng = np.random.default_rng((seed, 1, k))
        points = view.points @ turn.T + [0.002, 0.001, 0] + rng.normal(0, 0.001, view.points.shape)
        cloud = voxelize(points.astype(np.float32), voxel_m=Settings().surface.voxel_m)
        yield replace(view, points=cloud, eye=turn @ view.eye)


def spread(points: F4, count: int, rng: np.random.Generator) -> I4:
    """Return the indices (count,) of points (n, 3) chosen by farthest-point sampling.

    Source: Gonzalez 1985.
    """
    chosen = [int(rng.integers(len(points)))]
    nearest = np.full(len(points), np.inf, np.float32)
    for _ in range(count - 1):
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(nearest.argmax()))
    return np.array(chosen)


def subsample(points: F4, count: int, rng: np.random.Generator) -> I4:
    """Return the indices (count,) of randomly drawn points (n, 3); all if there are fewer."""
    return rng.permutation(len(points))[:count]


def sampled(
    points: F4,
    choose: Callable[[F4, int, np.random.Generator], I4],
    surface: SurfaceSettings,
    rng: np.random.Generator,
) -> NeuralGas:
    """Return a graph of sampled points (n, 3), metres, each linked to its nearest neighbours.

    ``choose`` returns the indices of a given number of points.
    """
    chosen = points[np.unique(choose(points, min(surface.neurons, len(points)), rng))]
    gaps = ((chosen[:, None] - chosen) ** 2).sum(axis=2)
    near = np.argsort(gaps, axis=1)[:, 1 : _NEIGHBOURS + 1]
    first = np.repeat(np.arange(len(chosen)), near.shape[1])
    pairs = np.sort(np.stack([first, near.reshape(-1)], axis=1), axis=1)
    return NeuralGas(chosen, np.unique(pairs, axis=0))


def add_two_categories(
    train: DescribedViews, test: dict[str, DescribedViews], *, blocks: Sequence[str], seed: int
) -> list[tuple[str, ...]]:
    """Compare adding two categories to a model, from few views, with training it from scratch.

    Returns
    -------
    Rows of data set, views per new category, method, accuracy on the new categories, accuracy on
    the old ones, loss on the old ones, seconds; means over three pairs of categories.
    """
    train = train.where(_some(len(train.labels), seed))
    found: dict[tuple[str, ...], list[tuple[float, ...]]] = {}
    for pair in _PAIRS:
        for key, figures in _add(pair, train, test, tuple(blocks), seed):
            found.setdefault(key, []).append(figures)
    return [(*key, *_means(rows)) for key, rows in found.items()]


def _means(rows: list[tuple[float, ...]]) -> tuple[str, ...]:
    new, old, lost, seconds = np.mean(rows, axis=0)
    return f"{new:.3f}", f"{old:.3f}", f"{lost:.3f}", f"{seconds:.1f}"


def _add(
    pair: tuple[str, str],
    train: DescribedViews,
    test: dict[str, DescribedViews],
    blocks: tuple[str, ...],
    seed: int,
) -> Iterator[tuple[tuple[str, ...], tuple[float, ...]]]:
    choices: dict[str, Any] = {"seed": seed, "blocks": blocks, "rounds": _ROUNDS}
    nothing = train.where(np.zeros(0, np.int64))
    is_new = np.isin(train.labels, pair)
    base = fit_views(train.where(~is_new), nothing, **choices)
    before = {name: _right(base, views, pair)[1] for name, views in test.items()}
    for count in _FEW:
        rng = np.random.default_rng((seed, count))
        chosen = np.concatenate(
            [rng.permutation(np.flatnonzero(train.labels == name))[:count] for name in pair]
        )
        few = train.where(chosen)
        begun = time.perf_counter()
        added = add_categories(base, few.descriptors, few.labels.tolist(), rng=rng)
        took = time.perf_counter() - begun
        begun = time.perf_counter()
        mixed = train.where(np.sort(np.concatenate([np.flatnonzero(~is_new), chosen])))
        anew = fit_views(mixed, nothing, **choices)
        again = time.perf_counter() - begun
        for name, views in test.items():
            for way, model, seconds in (("added", added, took), ("from scratch", anew, again)):
                new, old = _right(model, views, pair)
                yield (name, str(count), way), (new, old, before[name] - old, seconds)


def _right(model: Categorizer, views: DescribedViews, pair: tuple[str, str]) -> tuple[float, float]:
    """Return the accuracy on the new categories and on the old ones."""
    known = views.where(views.labels != UNKNOWN)
    right = _best(model, known.descriptors) == encode(known.labels, model.categories)
    new = np.isin(known.labels, pair)
    return float(right[new].mean()), float(right[~new].mean())
