"""Make the default model: ``python -m shapecat.models.training``.

Simulated tables give the views; tables, objects and kinds of distractors of the three sets
(training, calibration, test) never meet. Besides the model this writes its card.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from shapecat.arrays import Bool
from shapecat.config import Settings
from shapecat.description import BLOCKS
from shapecat.evaluation import Report, View, evaluate, format_report
from shapecat.evaluation.fused import FUSED
from shapecat.evaluation.training import fit_views
from shapecat.evaluation.views import DescribedViews, describe_views
from shapecat.learning import Categorizer, save_model
from shapecat.learning.training import Examples, fit_threshold
from shapecat.models.arrangements import World
from shapecat.models.card import Table, format_table, write_card
from shapecat.models.meshes import mesh_views
from shapecat.models.recorded import detected_views, labelled_views
from shapecat.models.studies import add_two_categories, compare_surfaces, compare_with_plain
from shapecat.models.worlds import WorldView, simulate_views
from shapecat.simulation.distractors import DISTRACTORS
from shapecat.simulation.procedural import PROCEDURAL
from shapecat.simulation.sensors import PRESETS
from shapecat.types import UNKNOWN

__all__ = ["Simulated", "collect", "main", "simulate"]

_HERE = Path(__file__).parent
_SETS = {"training": (1, 100_000), "calibration": (2, 300), "test": (100_003, 250)}
"""Seed of each set, and its most tables; seeds from 100000 on are for judging alone."""
_SHARES: dict[str, dict[str, Any]] = {
    "training": {"unknown": 0.3, "lying": 0.35, "leaning": 0.05, "settled": 0.45},
    "calibration": {"unknown": 0.17, "settled": 0.3},
    "test": {"unknown": 0.3, "settled": 0.3},
}
_SURFACE_SEEDS = (4, 5)
_SURFACE_TABLES = (150, 60)
_TRACK_SEED, _TRACK_TABLES = 100_006, 24
_BLOCKS = tuple(name for name in BLOCKS if name not in {"metric", "view"})
"""Scale-free: metric sizes help only on objects that the simulator makes."""
_CUT_WELL = 0.75
"""Overlap from which on a detection is taken for one object."""
_MOSTLY = 0.7
"""Share of an object from which on it is taken for mostly visible."""
_REJECTED = 0.14
"""Share of partial views of known categories that the novelty threshold rejects: what is real is
often hidden in part, and a piece is stranger than the whole."""
_MANNERS = ("upright", "lying")
_STEADY = """\
Accuracies that differ by a point are alike at this size. What the gas is there for is steadiness:
random points are as accurate, and change nearly twice as much between frames."""
_THESIS = ("the thesis's own figures, all objects of its data", "about 0.9", "", "< 2000")
_TIMES = 3
"""Each family of procedural objects is met so many times as often as a kind."""
_HEAD = ("", "views", "accuracy", "balanced", "ECE", "known rejected", "unknown rejected", "AUROC")


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


@click.command()
@click.option("--worlds", default=7000, show_default=True, help="Tables to learn from.")
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
    *, worlds: int, seed: int, jobs: int, out: Path, meshes: Path | None, recorded: Sequence[Path]
) -> None:
    """Simulate, learn, judge; write default.npz and MODEL_CARD.md."""
    sets = {name: simulate(name, worlds, jobs) for name in _SETS}
    choices: dict[str, Any] = {"blocks": _BLOCKS, "jobs": jobs}
    model = _fit(sets["training"], sets["calibration"], seed, choices)
    save_model(out / "default.npz", model)
    judged = {"test": sets["test"]}
    rows = [_figures(name, report) for name, report in _parts(sets["test"], model)]
    tracks = {"simulated": collect(_tracks(jobs))}
    if meshes is not None:
        judged["meshes"] = collect(mesh_views(meshes, seed=seed))
        tracks["meshes"] = collect(
            mesh_views(meshes, seed=seed + 1, placements=1, cameras=max(FUSED))
        )
        rows += [_figures(f"meshes: {n}", report) for n, report in _parts(judged["meshes"], model)]
    for folder in recorded:
        rows += _recorded_rows(folder, model)
    tables = [
        Table("Views", ("set", "views", "objects", "unknown"), tuple(_counts(sets))),
        Table("What it reaches on objects it never saw, single views", _HEAD, tuple(rows)),
        _fused_table(tracks, model),
        *_studies(sets["training"], judged, model, seed, jobs),
    ]
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


def _fit(train: Simulated, held_out: Simulated, seed: int, choices: dict[str, Any]) -> Categorizer:
    """Learn a model; its temperature is fitted on all views held out, its threshold on pieces."""
    model = fit_views(train.views, held_out.views, seed=seed, rejected=_REJECTED, **choices)
    partial = held_out.views.where(_partial(held_out))
    pieces = Examples(partial.descriptors, partial.labels, partial.instances)
    return fit_threshold(model, pieces, rejected=_REJECTED)


def simulate(name: str, worlds: int, jobs: int) -> Simulated:
    """Simulate one of the sets; kinds of distractors in the test set are met nowhere else."""
    seed, most = _SETS[name]
    kinds = [kind for k, kind in enumerate(DISTRACTORS) if (k % 3 == 0) == (name == "test")]
    if name == "training":
        kinds += _TIMES * list(PROCEDURAL)
    world = World(seed, tuple(kinds), **_SHARES[name])
    numbers = range(min(worlds, most))
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
        functions=columns["functions"],
    )
    circumstances = {name: columns[name] for name in Simulated._fields[1:]}
    return Simulated(described, **circumstances)


def _clear(views: Simulated) -> Bool:
    """Return which views are whole, mostly visible, cut well, and not upside down.

    Where detection merges an object with others there is no right answer: that is judged with
    detection, and here in a line of its own.
    """
    return np.asarray(~_partial(views) & (views.manner != "upside_down"))


def _partial(views: Simulated) -> Bool:
    """Return which views show a piece of an object, or more than the object."""
    seen = (views.source != "fragment") & (views.visible >= _MOSTLY)
    return np.asarray(~seen | (views.overlap < _CUT_WELL))


def _parts(views: Simulated, model: Categorizer) -> list[tuple[str, Report]]:
    """Evaluate the parts of a set that differ in difficulty."""
    whole = views.source != "fragment"
    clear = _clear(views)
    parts = {
        "whole, mostly visible, cut well, not upside down": clear,
        "of these, upright": clear & (views.manner == "upright"),
        "of these, lying": clear & (views.manner == "lying"),
        "of these, tilted in piles": clear & (views.manner == "tilted"),
        "of these, nearer than 1.4 m": clear & (views.views.distances < 1.4),
        **{f"of these, by {name}": clear & (views.sensor == name) for name in PRESETS},
        "upside down": whole & (views.manner == "upside_down"),
        "30 to 70 % visible": whole & (views.visible < _MOSTLY),
        "fragments": ~whole,
        "cut badly (overlap 0.5 to 0.75)": whole & (views.overlap < _CUT_WELL),
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
    return (name, str(report.n), *map(_text, values))


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


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


def _tracks(jobs: int) -> Iterable[WorldView]:
    """Simulate tables that are looked at from many places."""
    world = World(_TRACK_SEED, tuple(DISTRACTORS), unknown=0.0, cameras=max(FUSED) + 6)
    return simulate_views(world, range(_TRACK_TABLES), jobs=jobs)


def _fused_table(tracks: dict[str, Simulated], model: Categorizer) -> Table:
    """Judge several views of one placement of an object together."""
    rows = []
    for name, seen in tracks.items():
        clear = seen.where(_clear(seen))
        for manner in ("any but upside down", "upright", "lying"):
            mine = clear.where((clear.manner == manner) | (manner not in _MANNERS))
            report = evaluate(mine.views, model)
            singles = (name, manner, "1", str(report.n), _text(report.accuracy), _text(report.ece))
            rows.append(singles)
            rows += [
                (
                    name,
                    manner,
                    str(item.views),
                    str(item.groups),
                    _text(item.accuracy),
                    _text(item.ece),
                )
                for item in report.fused
            ]
    head = ("data", "objects", "views fused", "groups", "accuracy", "ECE")
    return Table(
        "Several views of one placement of an object, fused as tracks are", head, tuple(rows)
    )


def _studies(
    train: Simulated, judged: dict[str, Simulated], model: Categorizer, seed: int, jobs: int
) -> list[Table]:
    """Return what each part of the method is worth."""
    known = {name: s.where(_clear(s) & (s.views.labels != UNKNOWN)) for name, s in judged.items()}
    learned = train.where(train.views.labels != UNKNOWN)
    choices: dict[str, Any] = {"blocks": _BLOCKS, "seed": seed, "jobs": jobs}
    plain = compare_with_plain(learned.views, known["test"].views, model, **choices)
    surfaces = compare_surfaces(*map(_kept_views, _SURFACE_SEEDS, _SURFACE_TABLES), **choices)
    shown = {name: seen.views for name, seen in known.items()}
    added = add_two_categories(learned.views, shown, blocks=_BLOCKS, seed=seed)
    return [
        Table(
            "Beside plain learners on the test tables, no view upside down",
            ("learner", "views learned from", "accuracy", "balanced"),
            tuple(plain),
        ),
        Table(
            "Ways to a graph, each with a model of its own on the same few tables",
            ("surface", "accuracy", "instability between frames", "ms per object"),
            (*surfaces, _THESIS),
            _STEADY,
        ),
        Table(
            "Two new categories on the fixed dictionary, beside learning everything anew",
            ("data", "views each", "way", "new", "old", "old lost", "seconds"),
            tuple(added),
        ),
    ]


def _kept_views(seed: int, tables: int) -> list[View]:
    """Simulate tables and return the clear views of known categories."""
    seen = simulate_views(World(seed, tuple(DISTRACTORS), unknown=0.0, keep=True), range(tables))
    return [
        item.view
        for item in seen
        if item.view and item.source != "fragment" and item.manner != "upside_down"
    ]


if __name__ == "__main__":
    main()
