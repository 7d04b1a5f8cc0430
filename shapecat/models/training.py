"""Make the default model: ``python -m shapecat.models.training``.

Simulated tables give the views. Besides the model this writes its card. With ``--after`` a
model keeps its trees, and more are grown on what it gets wrong in this world.
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
"""Share of partial views of known categories that the novelty threshold rejects: what is real is
often hidden in part, and a piece is stranger than the whole."""
_TREES: dict[str, Any] = {"rounds": 320, "leaves": 40, "rate": 0.09}
"""So many views bear larger trees; fewer of them take as long as the defaults."""
_MORE: dict[str, Any] = {"rounds": 150, "rate": 0.06}
"""Of the trees that are grown for a model that has some."""


@click.command()
@click.option("--worlds", default=8000, show_default=True, help="Tables to learn from.")
@click.option("--seed", default=0, show_default=True, help="Seed of the learners.")
@click.option("--jobs", default=2, show_default=True, help="Processes.")
@click.option("--out", default=_HERE, type=click.Path(path_type=Path), help="Folder to write to.")
@click.option(
    "--after", type=click.Path(path_type=Path), help="Model whose trees are kept, to grow more."
)
@click.option("--studies/--no-studies", default=True, help="What each part of the method is worth.")
@click.option("--meshes", type=click.Path(path_type=Path), help="Folder of meshes to judge by.")
@click.option(
    "--recorded",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Folder of labelled recordings to judge by. Repeatable.",
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
    """Simulate, learn, judge; write default.npz and MODEL_CARD.md."""
    sets = {name: simulate(name, worlds, jobs) for name in SETS}
    train, held_out = sets["training"], sets["calibration"]
    if after is None:
        model = _fit(train, held_out, seed, {"blocks": tuple(BLOCKS), "jobs": jobs, **_TREES})
    else:
        model = grow(load_model(after), train, held_out, seed, jobs)
    save_model(out / "default.npz", model)
    judge(out, model, sets, seed=seed, jobs=jobs, studies=studies, meshes=meshes, recorded=recorded)


def _fit(train: Simulated, held_out: Simulated, seed: int, choices: dict[str, Any]) -> Categorizer:
    """Learn a model; its temperature is fitted on all views held out, its threshold on pieces."""
    model = fit_views(train.views, held_out.views, seed=seed, rejected=_REJECTED, **choices)
    return _with_threshold(model, held_out)


def grow(
    model: Categorizer, train: Simulated, held_out: Simulated, seed: int, jobs: int
) -> Categorizer:
    """Grow more trees for a model on the training set; calibrate it as a new one."""
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
