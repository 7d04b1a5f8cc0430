"""Train the default model and write its card: ``python -m shapecat.models.training``.

The views come from simulated tables. With ``--after``, an existing model keeps its trees, and more
trees are grown that correct its errors on these views.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from shapecat.description import BLOCKS, DESCRIPTOR_NAMES
from shapecat.evaluation.training import fit_views
from shapecat.learning import Categorizer, load_model, save_model
from shapecat.learning.growing import grow_on, widened
from shapecat.learning.training import Examples, LearningSettings, calibrate, fit_threshold
from shapecat.models.judging import judge
from shapecat.models.sets import SETS, Simulated, partial_views, simulate

__all__ = ["grow", "main"]

_HERE = Path(__file__).parent
_REJECTED = 0.14
"""Fraction of the partial views of known categories that the novelty threshold rejects. Real
objects are often partly hidden, and a partial view is more novel than a whole one."""
_TREES: dict[str, Any] = {"rounds": 320, "leaves": 40, "rate": 0.09}
"""The many views support trees larger than the default; fewer of them take the same time."""
_MORE: dict[str, Any] = {"rounds": 150, "rate": 0.06}
"""Settings of the trees that are added to an existing model."""


@click.command()
@click.option("--worlds", default=8000, show_default=True, help="Number of training scenes.")
@click.option("--seed", default=0, show_default=True, help="Seed of the random generator.")
@click.option("--jobs", default=2, show_default=True, help="Number of processes.")
@click.option("--out", default=_HERE, type=click.Path(path_type=Path), help="Folder to write to.")
@click.option(
    "--after",
    type=click.Path(path_type=Path),
    help="Model to extend: its trees stay, more are added.",
)
@click.option("--studies/--no-studies", default=True, help="Run the ablation studies.")
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
    after: Path | None,
    studies: bool,
    meshes: Path | None,
    recorded: Sequence[Path],
) -> None:
    """Simulate views, train and evaluate the model; write default.npz and MODEL_CARD.md."""
    sets = {name: simulate(name, worlds, jobs) for name in SETS}
    train, held_out = sets["training"], sets["calibration"]
    if after is None:
        model = _fit(train, held_out, seed, {"blocks": tuple(BLOCKS), "jobs": jobs, **_TREES})
    else:
        model = grow(load_model(after), train, held_out, seed, jobs)
    save_model(out / "default.npz", model)
    judge(out, model, sets, seed=seed, jobs=jobs, studies=studies, meshes=meshes, recorded=recorded)


def _fit(train: Simulated, held_out: Simulated, seed: int, choices: dict[str, Any]) -> Categorizer:
    """Train a model; fit its temperature on all held-out views, its threshold on partial ones."""
    model = fit_views(train.views, held_out.views, seed=seed, rejected=_REJECTED, **choices)
    return _with_threshold(model, held_out)


def grow(
    model: Categorizer, train: Simulated, held_out: Simulated, seed: int, jobs: int
) -> Categorizer:
    """Grow more trees for a model on the training set, then calibrate it like a new one."""
    views = _examples(train)
    wider = widened(
        model, views, descriptor_names=DESCRIPTOR_NAMES, blocks=BLOCKS, used=tuple(BLOCKS)
    )
    settings = LearningSettings(blocks=tuple(BLOCKS), rejected=_REJECTED, jobs=jobs, **_MORE)
    grown = grow_on(wider, views, settings=settings, seed=seed)
    notes = {**model.notes, "after": model.model_id, "more": {"seed": seed, **_MORE}}
    grown = calibrate(replace(grown, notes=notes), _examples(held_out), rejected=_REJECTED)
    return _with_threshold(grown, held_out)


def _with_threshold(model: Categorizer, held_out: Simulated) -> Categorizer:
    pieces = _examples(held_out.where(partial_views(held_out)))
    return fit_threshold(model, pieces, rejected=_REJECTED)


def _examples(seen: Simulated) -> Examples:
    return Examples(seen.views.descriptors, seen.views.labels, seen.views.instances)


if __name__ == "__main__":
    main()
