"""Train the default model and write its card: ``python -m shapecat.models.training``.

The views come from simulated tables, piles, bins, shelves and rooms.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from shapecat.evaluation.training import fit_views
from shapecat.learning import Categorizer, save_model
from shapecat.learning.training import Examples, fit_threshold
from shapecat.models.growing import growing_options
from shapecat.models.model_evaluation import evaluate_model
from shapecat.models.sets import SETS, SimulatedViews, partial_views, simulate

__all__ = ["main"]

_REJECTED = 0.14
"""Fraction of the partial views of known categories that the novelty threshold rejects. Real
objects are often partly hidden, and a partial view is more novel than a whole one."""
_TREES: dict[str, Any] = {"rounds": 320, "leaves": 40, "rate": 0.09}
"""Settings of the boosted trees: larger than by default, since there are so many views, but fewer,
so that training takes the same time."""


@click.command()
@click.option("--worlds", default=6800, show_default=True, help="Number of training arrangements.")
@growing_options(Path(__file__).parent)
@click.option("--meshes", type=click.Path(path_type=Path), help="Folder of meshes for evaluation.")
@click.option(
    "--recorded",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Folder of labelled recordings for evaluation. Repeatable.",
)
def main(
    *,
    worlds: int,
    seed: int,
    jobs: int,
    out: Path,
    meshes: Path | None,
    recorded: Sequence[Path],
) -> None:
    """Simulate views, train and evaluate the model; write default.npz and MODEL_CARD.md."""
    sets = {name: simulate(name, worlds, jobs) for name in SETS}
    train, held_out = sets["training"], sets["calibration"]
    model = _fit(train, held_out, seed, jobs)
    save_model(out / "default.npz", model)
    evaluate_model(out, model, sets, seed=seed, jobs=jobs, meshes=meshes, recorded=recorded)


def _fit(train: SimulatedViews, held_out: SimulatedViews, seed: int, jobs: int) -> Categorizer:
    """Train a model; fit its temperature on all held-out views, its threshold on partial views."""
    choices = {"jobs": jobs, "rejected": _REJECTED, **_TREES}
    model = fit_views(train.views, held_out.views, seed=seed, **choices)
    views = held_out.where(partial_views(held_out)).views
    pieces = Examples(views.descriptors, views.labels, views.instances)
    return fit_threshold(model, pieces, rejected=_REJECTED)


if __name__ == "__main__":
    main()
