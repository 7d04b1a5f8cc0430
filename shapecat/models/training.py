"""Make the default model: ``python -m shapecat.models.training``.

Simulated tables give the views; tables, objects and kinds of distractors of the three sets
(training, calibration, test) never meet. Besides the model this writes its card.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from shapecat.arrays import F4, I4, Bool
from shapecat.config import Settings
from shapecat.description import BLOCKS
from shapecat.evaluation import Report, evaluate, format_report, metrics
from shapecat.evaluation.report import UNKNOWN
from shapecat.evaluation.training import fit_views
from shapecat.evaluation.views import DescribedViews, describe_views
from shapecat.learning import Categorizer, save_model
from shapecat.learning.baselines import make_baselines
from shapecat.learning.training import encode
from shapecat.models.card import Table, format_table, write_card
from shapecat.models.meshes import mesh_views
from shapecat.models.recorded import detected_views, labelled_views
from shapecat.models.worlds import World, WorldView, simulate_views
from shapecat.simulation.distractors import DISTRACTORS

__all__ = ["Simulated", "collect", "main", "simulate"]

_HERE = Path(__file__).parent
_SETS = {"training": (1, 1.0), "calibration": (2, 0.17), "test": (3, 0.3)}
"""Seed of each set, and its number of tables by that of the training set."""
_BLOCKS = tuple(name for name in BLOCKS if name not in {"metric", "view"})
"""Scale-free: metric sizes help only on objects that the simulator makes."""
_HEAD = ("", "views", "accuracy", "balanced", "ECE", "known rejected", "unknown rejected", "AUROC")


class Simulated(NamedTuple):
    """Simulated views, and the circumstances the tables are broken down by."""

    views: DescribedViews
    manner: np.ndarray
    source: np.ndarray
    visible: np.ndarray
    d2: F4

    def where(self, chosen: Bool) -> "Simulated":
        """Return the chosen views."""
        return Simulated(
            self.views.where(chosen),
            self.manner[chosen],
            self.source[chosen],
            self.visible[chosen],
            self.d2[chosen],
        )


@click.command()
@click.option("--worlds", default=700, show_default=True, help="Tables to learn from.")
@click.option("--seed", default=0, show_default=True, help="Seed of the learners.")
@click.option("--jobs", default=2, show_default=True, help="Processes.")
@click.option("--out", default=_HERE, type=click.Path(path_type=Path), help="Folder to write to.")
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
    meshes: Path | None,
    recorded: Sequence[Path],
) -> None:
    """Simulate, learn, judge; write default.npz and MODEL_CARD.md."""
    sets = {name: simulate(name, worlds, jobs) for name in _SETS}
    choices: dict[str, Any] = {"blocks": _BLOCKS, "jobs": jobs}
    train, held_out = sets["training"].views, sets["calibration"].views
    model = fit_views(train, held_out, seed=seed, **choices)
    rows = [_figures(name, report) for name, report in _parts(sets["test"], model)]
    if meshes is not None:
        unseen = collect(mesh_views(meshes, seed=seed))
        rows += [_figures(f"meshes: {name}", report) for name, report in _parts(unseen, model)]
    for folder in recorded:
        rows += _recorded_rows(folder, model)
    tables = [
        Table("Views", ("set", "views", "objects", "unknown"), tuple(_counts(sets))),
        Table("What it reaches on objects it never saw, single views", _HEAD, tuple(rows)),
        Table(
            "Beside plain learners on the test tables, no view upside down",
            ("learner", "accuracy", "balanced"),
            tuple(_compare(sets["training"], sets["test"], model, seed, jobs)),
        ),
    ]
    save_model(out / "default.npz", model)
    clear = evaluate(sets["test"].where(_clear(sets["test"])).views, model)
    write_card(
        out / "MODEL_CARD.md",
        model=model.model_id,
        categories=model.categories,
        tables=tables,
        confusion=clear,
        settings={"worlds": worlds, "seed": seed, **model.notes["learning"]},
    )
    click.echo("\n".join(map(format_table, tables)))
    click.echo(format_report(clear))


def simulate(name: str, worlds: int, jobs: int) -> Simulated:
    """Simulate one of the sets; kinds of distractors in the test set are met nowhere else."""
    seed, share = _SETS[name]
    kinds = [kind for k, kind in enumerate(DISTRACTORS) if (k % 3 == 0) == (name == "test")]
    world = World(seed, tuple(kinds), unknown=0.3 if name == "test" else 0.17)
    numbers = range(max(round(worlds * share), 1))
    views = simulate_views(world, numbers, jobs=jobs)
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
    )
    circumstances = {name: columns[name] for name in Simulated._fields[1:]}
    return Simulated(described, **circumstances)


def _clear(views: Simulated) -> Bool:
    """Return which views are whole, mostly visible, and not upside down."""
    whole = (views.source != "fragment") & (views.visible >= 0.7)
    return np.asarray(whole & (views.manner != "upside_down"))


def _parts(views: Simulated, model: Categorizer) -> list[tuple[str, Report]]:
    """Evaluate the parts of a set that differ in difficulty."""
    whole = views.source != "fragment"
    clear = _clear(views)
    parts = {
        "whole, mostly visible, not upside down": clear,
        "of these, upright": clear & (views.manner == "upright"),
        "of these, lying": clear & (views.manner == "lying"),
        "of these, nearer than 1.4 m": clear & (views.views.distances < 1.4),
        "upside down": whole & (views.manner == "upside_down"),
        "30 to 70 % visible": whole & (views.visible < 0.7),
        "fragments": ~whole,
        "as detected": clear & (views.source == "detected"),
        "all": np.ones_like(clear),
    }
    return [
        (name, evaluate(views.views.where(mine), model))
        for name, mine in parts.items()
        if mine.any()
    ]


def _recorded_rows(folder: Path, model: Categorizer) -> list[tuple[str, ...]]:
    rows = []
    if (folder / "labels.npz").exists():
        views = describe_views(labelled_views(folder), settings=Settings())
        rows.append(_figures(f"{folder.name}, cut by hand", evaluate(views, model)))
    views = describe_views(detected_views(folder), settings=Settings())
    return [*rows, _figures(f"{folder.name}, as detected", evaluate(views, model))]


def _figures(name: str, report: Report) -> tuple[str, ...]:
    novelty = report.novelty or {}
    values = (
        report.accuracy,
        report.balanced_accuracy,
        report.ece,
        report.rejected_known,
        novelty.get("rejected"),
        novelty.get("auroc"),
    )
    return (name, str(report.n), *("" if value is None else f"{value:.3f}" for value in values))


def _counts(sets: dict[str, Simulated]) -> list[tuple[str, ...]]:
    return [
        (
            name,
            str(len(held.views.labels)),
            str(len(np.unique(held.views.instances))),
            str(int(np.sum(held.views.labels == UNKNOWN))),
        )
        for name, held in sets.items()
    ]


def _compare(
    train: Simulated, test: Simulated, model: Categorizer, seed: int, jobs: int
) -> list[tuple[str, ...]]:
    """Judge the chain beside plain learners, and plain D2 beside the descriptor."""
    known = train.where(train.views.labels != UNKNOWN)
    clear = test.where(_clear(test) & (test.views.labels != UNKNOWN))
    truth, labels = (encode(s.views.labels, model.categories) for s in (clear, known))
    chain = model.predict(clear.views.descriptors).posteriors.argmax(axis=1)
    rows = [_scores("full chain", truth, chain)]
    blocks = {name: BLOCKS[name] for name in _BLOCKS}
    makers = make_baselines(blocks, seed=seed, jobs=jobs)
    for name, make in makers.items():
        learner = make().fit(known.views.descriptors, labels)
        rows.append(_scores(name, truth, learner.predict(clear.views.descriptors)))
    forest = makers["forest"]().fit(known.d2, labels)
    return [*rows, _scores("forest on plain D2", truth, forest.predict(clear.d2))]


def _scores(name: str, truth: I4, predicted: I4) -> tuple[str, ...]:
    table = metrics.confusion(truth, predicted, int(max(truth.max(), predicted.max())) + 1)
    return (
        name,
        f"{metrics.accuracy(truth, predicted):.3f}",
        f"{metrics.balanced_accuracy(table):.3f}",
    )


if __name__ == "__main__":
    main()
