"""Training of boosted trees as binary classifiers for detection."""

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click
import numpy as np

from shapecat.arrays import F4, Bool
from shapecat.learning.boosting import Tree, TreeSettings, grow_tree, joined, make_bins
from shapecat.trees import BoostedTrees

__all__ = ["Growth", "collect_chunks", "grow", "growing_options"]

_T = TypeVar("_T")

_CHUNK = 10
_L2, _MIN_HESSIAN = 1.0, 2.0
_ROWS = 0.7
"""Fraction of the samples that each tree is trained on."""


class Growth(NamedTuple):
    """Number of trees, maximum number of leaves of each tree, and learning rate."""

    rounds: int
    leaves: int
    rate: float


def growing_options(out: Path) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds the common options of training; --out defaults to ``out``."""
    where = f"{'File' if out.suffix else 'Folder'} to write to; by default that of shapecat."
    options = (
        click.option("--seed", default=0, show_default=True, help="Seed of the random generator."),
        click.option("--jobs", default=2, show_default=True, help="Number of processes."),
        click.option("--out", default=out, type=click.Path(path_type=Path), help=where),
    )

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def collect_chunks(collect: Callable[[Any], _T], series: Iterable[Any], jobs: int) -> list[_T]:
    """Collect samples from series of scenes in spawned processes, and show the progress.

    A series has a ``first`` seed and a number of ``scenes``. Each call of ``collect`` gets a part
    of a series, of at most `_CHUNK` scenes. The results are in the order of the series.
    """
    chunks = [
        one._replace(first=one.first + k, scenes=min(_CHUNK, one.scenes - k))
        for one in series
        for k in range(0, one.scenes, _CHUNK)
    ]
    with (
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool,
        click.progressbar(pool.map(collect, chunks), length=len(chunks), label="scenes") as bar,
    ):
        return list(bar)


def grow(features: F4, truth: Bool, growth: Growth, seed: int) -> BoostedTrees:
    """Grow trees by gradient boosting with the cross-entropy loss.

    The first tree is a single leaf: the log odds of the positive class.

    Parameters
    ----------
    features : (n, f), one row per sample.
    truth : (n,) whether each sample belongs to the positive class.
    growth : number and size of the trees, and learning rate.

    Source: Friedman 2001.
    """
    rng = np.random.default_rng(seed)
    bins, n = make_bins(features), len(truth)
    share = truth.mean()
    grown = [_leaf(float(np.log(share / (1 - share))))]
    logit = np.full(n, grown[0].value[0], np.float32)
    settings = TreeSettings(growth.leaves, growth.rate, _L2, _MIN_HESSIAN)
    columns = np.arange(features.shape[1])
    for _ in range(growth.rounds):
        posterior = 1 / (1 + np.exp(-logit))
        rows = np.sort(rng.permutation(n)[: round(_ROWS * n)]).astype(np.int32)
        gradient, hessian = posterior - truth, posterior * (1 - posterior)
        grown.append(grow_tree(bins, columns, rows, gradient, hessian, settings, logit))
    return joined(grown)


def _leaf(value: float) -> Tree:
    """Return a tree of one leaf, which adds a constant to all scores."""
    none = np.zeros(1, np.int64)
    return Tree(none, np.zeros(1, np.float32), none, np.array([value], np.float32))
