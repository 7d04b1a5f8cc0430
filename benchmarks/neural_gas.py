"""Speed of Growing Neural Gas compared with published packages."""

import collections.abc
import contextlib
import importlib
import io
import sys
from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import MagicMock

import numpy as np

from benchmarks.measure import cpu_ms, markdown
from benchmarks.scenes import simulated_clutter
from shapecat.arrays import F4
from shapecat.config import Settings, SurfaceSettings
from shapecat.detection import detect
from shapecat.surface import reconstruct, voxelize

_NEURONS, _SIGNALS = 80, 6000
_INTERVAL = 45
"""Signals between two insertions, the same as in shapecat with these numbers."""


def run(count: int) -> tuple[str, dict[str, Any]]:
    """Time the learning of ``count`` objects, 80 neurons and 6000 signals each."""
    clouds = list(_clouds(count))
    settings = SurfaceSettings(neurons=_NEURONS, signals=_SIGNALS)
    ours = _microseconds(
        clouds,
        lambda cloud: reconstruct(cloud, settings=settings, rng=np.random.default_rng(0)),
        repeats=5,
    )
    rows, figures = [("shapecat", ours, 1.0)], {"shapecat": ours}
    absent = []
    for name, load in {"neupy": _neupy, "MDP": _mdp}.items():
        try:
            learn = load()
        except Exception as error:  # noqa: BLE001  old packages fail to load in any way
            absent.append(f"{name} is not measured: {type(error).__name__}: {error}.")
            continue
        figures[name] = _microseconds(clouds[:2], learn, repeats=1)
        rows.append((name, figures[name], round(figures[name] / ours, 0)))
    table = markdown(
        f"Growing Neural Gas, {_NEURONS} neurons, {_SIGNALS} signals",
        ("implementation", "µs per signal", "times as long"),
        rows,
    )
    return "\n".join([table, *absent, ""]), figures


def _clouds(count: int) -> Iterator[F4]:
    """Yield point clouds (n, 3) of objects with enough points for all neurons."""
    settings = Settings()
    for frame in simulated_clutter(count):
        scene = detect(frame, settings=settings.detection, rng=np.random.default_rng(0))
        clouds = (
            voxelize(frame.xyz(candidate.indices), voxel_m=settings.surface.voxel_m)
            for candidate in scene.candidates
        )
        yield from (cloud for cloud in clouds if len(cloud) > 4 * _NEURONS)


def _microseconds(clouds: list[F4], learn: Callable[[F4], Any], *, repeats: int) -> float:
    """Return the median CPU time per signal in microseconds."""
    times = [cpu_ms(lambda cloud=cloud: learn(cloud), repeats) for cloud in clouds]  # type: ignore[misc]  # mypy infers no default
    return round(float(np.median(times)) / _SIGNALS * 1e3, 3)


def _signals(cloud: F4) -> F4:
    """Return the points in the order in which they are presented to the network."""
    rng = np.random.default_rng(0)
    epochs = _SIGNALS // len(cloud) + 1
    order = np.concatenate([rng.permutation(len(cloud)) for _ in range(epochs)])[:_SIGNALS]
    return np.asarray(cloud[order], np.float64)


def _neupy() -> Callable[[F4], Any]:
    """Load neupy, made for Python 3.6; mock the dependencies that its gas does not need."""
    for name in ("Iterable", "Mapping", "Sequence"):
        setattr(collections, name, getattr(collections.abc, name))
    for name in ("tensorflow", "numpy.core.umath_tests"):
        try:
            importlib.import_module(name)
        except Exception:  # noqa: BLE001  any failure, as it is not needed
            sys.modules[name] = MagicMock()
    kind = importlib.import_module("neupy.algorithms").GrowingNeuralGas

    def learn(cloud: F4) -> Any:
        gas = kind(
            n_inputs=3, step=0.1, neighbour_step=0.006, max_edge_age=30, max_nodes=_NEURONS,
            n_iter_before_neuron_added=_INTERVAL, error_decay_rate=0.9995,
        )  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()):
            gas.train(_signals(cloud), epochs=1)
        return gas

    return learn


def _mdp() -> Callable[[F4], Any]:
    """Load MDP (Modular toolkit for Data Processing)."""
    kind = importlib.import_module("mdp").nodes.GrowingNeuralGasNode

    def learn(cloud: F4) -> Any:
        gas = kind(
            start_poss=[cloud[0], cloud[1]], eps_b=0.1, eps_n=0.006, max_age=30,
            lambda_=_INTERVAL, alpha=0.5, d=0.9995, max_nodes=_NEURONS,
        )  # fmt: skip
        gas.train(_signals(cloud))
        return gas

    return learn
