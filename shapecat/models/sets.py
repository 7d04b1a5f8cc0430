"""The simulated training, calibration and test sets.

The sets share no arrangements and no objects; the test set shares no kind of distractor with the
other two.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import click
import numpy as np

from shapecat.arrays import Bool
from shapecat.evaluation.views import DescribedViews
from shapecat.models.arrangements import ArrangementOptions
from shapecat.models.simulated_views import SimulatedView, simulate_views
from shapecat.simulation.shapes.distractors import DISTRACTORS
from shapecat.simulation.shapes.procedural import PROCEDURAL

__all__ = [
    "MOSTLY_VISIBLE",
    "SETS",
    "WELL_SEGMENTED_IOU",
    "SimulatedViews",
    "clear_views",
    "collect",
    "options_of",
    "partial_views",
    "simulate",
]

SETS = {"training": (1, 100_000), "calibration": (2, 160), "test": (100_003, 100)}
"""Seed and maximum number of arrangements of each set; seeds from 100000 up are for evaluation
only."""
_SHARES: dict[str, dict[str, Any]] = {
    "training": {"unknown": 0.3, "lying": 0.35, "leaning": 0.05, "settled": 0.5, "cameras": 10},
    "calibration": {"unknown": 0.17, "settled": 0.5},
    "test": {"unknown": 0.3, "settled": 0.5},
}
"""Parameters in `ArrangementOptions` of each set."""
WELL_SEGMENTED_IOU = 0.75
"""Minimum IoU of a well segmented detection."""
MOSTLY_VISIBLE = 0.7
"""Minimum visible fraction of a mostly visible object."""
_PROCEDURAL_WEIGHT = 3
"""Weight of each procedural family of distractors; other kinds have weight 1."""


class SimulatedViews(NamedTuple):
    """Simulated views, and arrays (n,) of their conditions, as in `SimulatedView`."""

    views: DescribedViews
    resting_pose: np.ndarray
    source: np.ndarray
    visible: np.ndarray
    overlap: np.ndarray
    sensor: np.ndarray

    def where(self, chosen: Bool) -> "SimulatedViews":
        """Return the views that a mask (n,) selects."""
        _, *conditions = self
        return SimulatedViews(self.views.where(chosen), *(column[chosen] for column in conditions))


def options_of(name: str) -> ArrangementOptions:
    """Return the parameters of the arrangements of a set in `SETS`."""
    kinds = [kind for k, kind in enumerate(DISTRACTORS) if (k % 3 == 0) == (name == "test")]
    if name == "training":
        kinds += _PROCEDURAL_WEIGHT * list(PROCEDURAL)
    return ArrangementOptions(SETS[name][0], tuple(kinds), background=True, **_SHARES[name])


def simulate(name: str, worlds: int, jobs: int) -> SimulatedViews:
    """Simulate up to ``worlds`` arrangements of a set in `SETS`; return their views."""
    numbers = range(min(worlds, SETS[name][1]))
    views = simulate_views(options_of(name), numbers, jobs=jobs)
    click.echo(f"simulating {len(numbers)} arrangements of the {name} set", err=True)
    return collect(views)


def collect(views: Iterable[SimulatedView]) -> SimulatedViews:
    """Collect views into one array (n, ...) for each field."""
    rows = list(views)
    columns = {name: np.array([getattr(r, name) for r in rows]) for name in SimulatedView._fields}
    described = DescribedViews(
        descriptors=columns["descriptor"],
        labels=columns["label"],
        instances=columns["instance"],
        points=columns["points"],
        distances=columns["distance"],
    )
    conditions = {name: columns[name] for name in SimulatedViews._fields[1:]}
    return SimulatedViews(described, **conditions)


def clear_views(views: SimulatedViews) -> Bool:
    """Return the mask (n,) of whole, mostly visible, well segmented views that are not upside down.

    If detection merges an object with others, no category is right. Badly segmented views are
    therefore left to the evaluation of detection, and to a row of their own in the model card.
    """
    return np.asarray(~partial_views(views) & (views.resting_pose != "upside_down"))


def partial_views(views: SimulatedViews) -> Bool:
    """Return the mask (n,) of views that are occluded, cut, badly segmented, or background."""
    parts = np.isin(views.source, ("fragment", "background"))
    return np.asarray(
        parts | (views.visible < MOSTLY_VISIBLE) | (views.overlap < WELL_SEGMENTED_IOU)
    )
