"""The simulated sets that a model is trained, calibrated and tested on.

Tables, objects and kinds of distractors of the three sets never meet.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import click
import numpy as np

from shapecat.arrays import Bool
from shapecat.evaluation.views import DescribedViews
from shapecat.models.arrangements import World
from shapecat.models.worlds import WorldView, simulate_views
from shapecat.simulation.distractors import DISTRACTORS
from shapecat.simulation.procedural import PROCEDURAL

__all__ = [
    "CUT_WELL",
    "MOSTLY",
    "SETS",
    "Simulated",
    "clear_views",
    "collect",
    "partial_views",
    "simulate",
    "world_of",
]

SETS = {"training": (1, 100_000), "calibration": (2, 160), "test": (100_003, 100)}
"""Seed of each set, and its most tables; seeds from 100000 on are for judging alone."""
_SHARES: dict[str, dict[str, Any]] = {
    "training": {"unknown": 0.3, "lying": 0.35, "leaning": 0.05, "settled": 0.4, "cameras": 10},
    "calibration": {"unknown": 0.17, "settled": 0.4},
    "test": {"unknown": 0.3, "settled": 0.5},
}
CUT_WELL = 0.75
"""Overlap from which on a detection is taken for one object."""
MOSTLY = 0.7
"""Share of an object from which on it is taken for mostly visible."""
_TIMES = 3
"""Each family of procedural objects is met so many times as often as a kind."""


class Simulated(NamedTuple):
    """Simulated views, and the circumstances the tables are broken down by."""

    views: DescribedViews
    manner: np.ndarray
    source: np.ndarray
    visible: np.ndarray
    overlap: np.ndarray
    sensor: np.ndarray

    def where(self, chosen: Bool) -> "Simulated":
        """Return the chosen views."""
        return Simulated(
            self.views.where(chosen),
            self.manner[chosen],
            self.source[chosen],
            self.visible[chosen],
            self.overlap[chosen],
            self.sensor[chosen],
        )


def world_of(name: str) -> World:
    """Return what one of the sets is simulated from."""
    kinds = [kind for k, kind in enumerate(DISTRACTORS) if (k % 3 == 0) == (name == "test")]
    if name == "training":
        kinds += _TIMES * list(PROCEDURAL)
    return World(SETS[name][0], tuple(kinds), **_SHARES[name])


def simulate(name: str, worlds: int, jobs: int) -> Simulated:
    """Simulate one of the sets; kinds of distractors in the test set are met nowhere else."""
    numbers = range(min(worlds, SETS[name][1]))
    views = simulate_views(world_of(name), numbers, jobs=jobs)
    click.echo(f"simulating {len(numbers)} tables of the {name} set", err=True)
    return collect(views)


def collect(views: Iterable[WorldView]) -> Simulated:
    """Gather views into columns."""
    rows = list(views)
    columns = {name: np.array([getattr(r, name) for r in rows]) for name in WorldView._fields}
    described = DescribedViews(
        descriptors=columns["descriptor"],
        labels=columns["label"],
        instances=columns["instance"],
        points=columns["points"],
        distances=columns["distance"],
        seconds=columns["seconds"],
        functions=columns["functions"],
    )
    circumstances = {name: columns[name] for name in Simulated._fields[1:]}
    return Simulated(described, **circumstances)


def clear_views(views: Simulated) -> Bool:
    """Return which views are whole, mostly visible, cut well, and not upside down.

    Where detection merges an object with others there is no right answer: that is judged with
    detection, and here in a line of its own.
    """
    return np.asarray(~partial_views(views) & (views.manner != "upside_down"))


def partial_views(views: Simulated) -> Bool:
    """Return which views show a piece of an object, or more than the object."""
    seen = (views.source != "fragment") & (views.visible >= MOSTLY)
    return np.asarray(~seen | (views.overlap < CUT_WELL))
