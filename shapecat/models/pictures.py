"""Pictures for the model card: the model's worst mistakes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shapecat.evaluation import View
from shapecat.learning import Categorizer
from shapecat.models.fragments import image_plane_points
from shapecat.models.simulated_views import SimulatedView
from shapecat.types import UNKNOWN

__all__ = ["Mistake", "draw", "worst_mistakes"]

_COLUMNS = 6


class Mistake(NamedTuple):
    """A simulated view, its voxels ``view``, its wrong ``predicted`` label, and the confidence."""

    simulated: SimulatedView
    view: View
    predicted: str
    confidence: float


def worst_mistakes(
    views: Sequence[SimulatedView], model: Categorizer, *, count: int = 12
) -> list[Mistake]:
    """Return up to ``count`` wrong predictions for different objects, the most confident first.

    Views without points are left out.
    """
    answer = model.predict(np.array([view.descriptor for view in views]))
    mistakes = []
    for view, posterior, novelty in zip(views, answer.posteriors, answer.novelty, strict=True):
        is_unknown = novelty > 1
        predicted = UNKNOWN if is_unknown else model.categories[int(posterior.argmax())]
        familiarity = 1 - float(novelty) / 2
        confidence = 1 - familiarity if is_unknown else familiarity * float(posterior.max())
        if predicted != view.label and view.view is not None:
            mistakes.append(Mistake(view, view.view, predicted, confidence))
    mistakes.sort(key=lambda mistake: -mistake.confidence)
    worst: dict[str, Mistake] = {}
    for mistake in mistakes:
        worst.setdefault(mistake.simulated.instance, mistake)
    return list(worst.values())[:count]


def draw(path: Path, mistakes: Sequence[Mistake]) -> None:
    """Plot the points of each view, seen from the sensor, with both labels; write the image."""
    import matplotlib as mpl  # noqa: PLC0415  only for pictures

    mpl.use("agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    rows = -(-len(mistakes) // _COLUMNS)
    figure, axes = plt.subplots(rows, _COLUMNS, figsize=(2.2 * _COLUMNS, 2.4 * rows), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for mistake, axis in zip(mistakes, axes.flat, strict=False):
        _draw_one(axis, mistake)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def _draw_one(axis: Any, mistake: Mistake) -> None:
    view = mistake.simulated
    distance = np.linalg.norm(mistake.view.points - mistake.view.eye, axis=1)
    points = image_plane_points(mistake.view)
    axis.scatter(*points.T, c=distance, s=3, cmap="viridis_r", linewidths=0)
    axis.set_aspect("equal")
    where = f"{view.sensor}, {view.distance:.1f} m, {view.points} voxels"
    wrong = f"as {mistake.predicted} ({mistake.confidence:.2f})"
    axis.set_title(
        f"{view.label}, {view.resting_pose}\n{wrong}\n{where}",
        fontsize=7,
    )
