"""Evaluate a model on held-out data, and write the results into its card."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import click
import numpy as np

from shapecat.config import Settings
from shapecat.evaluation import Report, evaluate, format_report
from shapecat.evaluation.fused import FUSED
from shapecat.evaluation.markup import figure_text
from shapecat.evaluation.views import describe_views
from shapecat.learning import Categorizer
from shapecat.models.arrangements import ArrangementOptions
from shapecat.models.card import PICTURE, markdown, write_card
from shapecat.models.meshes import mesh_views
from shapecat.models.pictures import draw, worst_mistakes
from shapecat.models.recorded import detected_views
from shapecat.models.sets import (
    MOSTLY_VISIBLE,
    WELL_SEGMENTED_IOU,
    SimulatedViews,
    clear_views,
    collect,
    options_of,
)
from shapecat.models.simulated_views import SimulatedView, simulate_arrangement, simulate_views
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.shapes.distractors import DISTRACTORS
from shapecat.types import UNKNOWN

__all__ = ["evaluate_model"]

_TRACK_SEED, _TRACK_TABLES = 100_006, 24
"""Seed and number of the simulated tables on which fusion is evaluated."""
_DRAWN = 20
"""Number of test arrangements in which to look for the worst mistakes."""
_HEAD = ("", "views", "accuracy", "balanced", "ECE", "known rejected", "unknown rejected", "AUROC")
_text = partial(figure_text, missing="")


def evaluate_model(
    out: Path,
    model: Categorizer,
    sets: dict[str, SimulatedViews],
    *,
    seed: int,
    jobs: int,
    meshes: Path | None,
    recorded: Sequence[Path],
) -> None:
    """Evaluate a model; write its card and the picture of its worst mistakes into a folder.

    The results are also printed.

    Parameters
    ----------
    sets : the views of each set in `SETS`, by name.
    seed : seed of the views of meshes.
    jobs : number of processes.
    meshes : folder of meshes to evaluate on, if any.
    recorded : folders of labelled recordings to evaluate on.

    Raises
    ------
    RecordingError : a mesh or a labelled recording is unreadable.
    ModelError : the model does not know a category of the meshes or recordings.
    """
    rows = [_figures(name, report) for name, report in _parts(sets["test"], model)]
    tracks = {"simulated": collect(_tracks(jobs))}
    if meshes is not None:
        of_meshes = collect(mesh_views(meshes, seed=seed))
        rows += [_figures(f"meshes: {n}", report) for n, report in _parts(of_meshes, model)]
        tracks["meshes"] = collect(
            mesh_views(meshes, seed=seed + 1, placements=1, cameras=max(FUSED))
        )
    for folder in recorded:
        views = describe_views(detected_views(folder), settings=Settings())
        rows.append(_figures(f"{folder.name}, as detected", evaluate(views, model)))
    tables = [
        markdown("Views", ("set", "views", "objects", "unknown"), _counts(sets)),
        markdown("Accuracy on unseen objects, single views", _HEAD, rows),
        _fused_table(tracks, model),
    ]
    clear = evaluate(sets["test"].where(clear_views(sets["test"])).views, model)
    write_card(
        out / "MODEL_CARD.md",
        tables=tables,
        confusion=clear,
        settings={
            "worlds": len({name.split("/")[1] for name in sets["training"].views.instances}),
            "seed": seed,
            **model.notes["learning"],
        },
    )
    draw(out / PICTURE, worst_mistakes(_test_views(), model))
    click.echo("\n".join(tables))
    click.echo(format_report(clear))


def _test_views() -> list[SimulatedView]:
    """Return the clear views, with points, of a few test arrangements; see `clear_views`."""
    options = options_of("test")
    views = [view for number in range(_DRAWN) for view in simulate_arrangement(options, number)]
    return [view for view, clear in zip(views, clear_views(collect(views)), strict=True) if clear]


def _parts(views: SimulatedViews, model: Categorizer) -> list[tuple[str, Report]]:
    """Return names and reports of subsets of the views, such as upright or badly segmented ones.

    The subsets overlap; empty ones are left out.
    """
    background = views.source == "background"
    whole = (views.source != "fragment") & ~background
    clear = clear_views(views)
    parts = {
        "whole, mostly visible, well segmented, not upside down": clear,
        "of these, upright": clear & (views.resting_pose == "upright"),
        "of these, lying": clear & (views.resting_pose == "lying"),
        "of these, tilted in piles": clear & (views.resting_pose == "tilted"),
        "of these, nearer than 1.4 m": clear & (views.views.distances < 1.4),
        **{f"of these, by {name}": clear & (views.sensor == name) for name in PRESETS},
        "upside down": whole & (views.resting_pose == "upside_down"),
        "30 to 70 % visible": whole & (views.visible < MOSTLY_VISIBLE),
        "fragments": views.source == "fragment",
        "background": background,
        "badly segmented (IoU 0.5 to 0.75)": whole & (views.overlap < WELL_SEGMENTED_IOU),
        "as detected": clear & (views.source == "detected"),
        "all": np.ones_like(clear),
    }
    return [
        (name, evaluate(views.views.where(selected), model))
        for name, selected in parts.items()
        if selected.any()
    ]


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


def _counts(sets: dict[str, SimulatedViews]) -> list[tuple[object, ...]]:
    return [
        (
            name,
            len(views.views.labels),
            len(np.unique(views.views.instances)),
            np.sum(views.views.labels == UNKNOWN),
        )
        for name, views in sets.items()
    ]


def _tracks(jobs: int) -> Iterable[SimulatedView]:
    """Yield views of the objects on simulated tables, each seen from many viewpoints."""
    options = ArrangementOptions(
        _TRACK_SEED, tuple(DISTRACTORS), unknown=0.0, cameras=max(FUSED) + 6
    )
    return simulate_views(options, range(_TRACK_TABLES), jobs=jobs)


def _fused_table(tracks: dict[str, SimulatedViews], model: Categorizer) -> str:
    """Return a table of the accuracy after fusing several views of one placement of an object.

    ``tracks`` are the views, by the name of their data set.
    """
    rows = []
    for name, views in tracks.items():
        report = evaluate(views.where(clear_views(views)).views, model)
        rows.append((name, 1, report.n, _text(report.accuracy), _text(report.ece)))
        rows += [
            (name, item.views, item.groups, _text(item.accuracy), _text(item.ece))
            for item in report.fused
        ]
    head = ("data", "views fused", "groups", "accuracy", "ECE")
    title = "Several fused views of one placement of an object, fused as in tracks"
    return markdown(title, head, rows)
