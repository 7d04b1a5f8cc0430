"""The tables of chapter 8 for any model and data set (thesis ch. 8)."""

import io
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from shapecat.arrays import F4, I4
from shapecat.config import Settings
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import ModelError
from shapecat.evaluation import metrics
from shapecat.evaluation.dataset import read_dataset
from shapecat.evaluation.fused import Fused, fuse_views
from shapecat.evaluation.views import DescribedViews, Observer, describe_views, ignore
from shapecat.learning import Categorizer, load_model

__all__ = ["Report", "evaluate", "evaluate_folder", "format_report"]

UNKNOWN = "unknown"
"""Folder and label of shapes of no category."""
_DISTANCES_M = (0.0, 0.8, 1.1, 1.4, 1.7, math.inf)
_POINTS = (0, 60, 120, 250, 500, 1000, math.inf)


@dataclass(frozen=True)
class Report:
    """What an evaluation came to; undefined figures are None.

    ``confusion`` counts true categories (rows) taken for others (columns), in the order of
    ``categories``; ``by_distance`` and ``by_points`` give (range, views, accuracy); ``fused`` is
    empty where no object has three views.
    """

    model: str
    n: int
    categories: tuple[str, ...]
    accuracy: float | None
    balanced_accuracy: float | None
    ece: float | None
    recall: dict[str, float | None]
    confusion: tuple[tuple[int, ...], ...]
    seconds_per_object: float | None
    novelty: dict[str, float | None] | None = None
    rejected_known: float | None = None
    skipped: int = 0
    calibration: tuple[metrics.Bin, ...] = ()
    by_distance: tuple[tuple[str, int, float], ...] = field(default=())
    by_points: tuple[tuple[str, int, float], ...] = field(default=())
    fused: tuple[Fused, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            **{name: getattr(self, name) for name in self.__dataclass_fields__},
            "categories": list(self.categories),
            "confusion": [list(row) for row in self.confusion],
            "calibration": [item._asdict() for item in self.calibration],
            "by_distance": _as_dicts(self.by_distance),
            "by_points": _as_dicts(self.by_points),
            "fused": [item._asdict() for item in self.fused],
        }


def evaluate_folder(root: Path, model: Path | None = None, *, observe: Observer = ignore) -> Report:
    """Evaluate a model (by default the shipped one) on a labelled data set.

    Raises
    ------
    RecordingError : there are no views, or one cannot be read.
    ModelError : no usable model, or one that does not know a category of the data set.
    """
    categorizer = load_model(model)
    categorizer.require_descriptor(DESCRIPTOR_NAMES)
    dataset = read_dataset(root)
    _require_categories(dataset.categories, categorizer)
    views = describe_views(
        dataset, settings=Settings(), total=len(dataset), phase="evaluate", observe=observe
    )
    return evaluate(views, categorizer)


def evaluate(views: DescribedViews, categorizer: Categorizer) -> Report:
    """Compare what a model says of described views with their labels.

    Views labelled ``unknown`` count for novelty alone. The accuracies take the most probable
    category of every other view, novel or not.

    Raises
    ------
    ModelError : a label that the model does not know.
    """
    _require_categories(np.unique(views.labels).tolist(), categorizer)
    begun = time.perf_counter()
    prediction = categorizer.predict(views.descriptors)
    predicting = (time.perf_counter() - begun) / max(len(views.labels), 1)
    categories = categorizer.categories
    known = views.labels != UNKNOWN
    truth = np.array([categories.index(label) for label in views.labels[known]], np.int64)
    posteriors = prediction.posteriors[known]
    predicted = posteriors.argmax(axis=1).astype(np.int64)
    table = metrics.confusion(truth, predicted, len(categories))
    novelty = None
    if not np.all(known):
        novelty = _novelty_figures(prediction.novelty[~known], prediction.novelty[known])
    return Report(
        model=categorizer.model_id,
        n=int(known.sum()),
        categories=categories,
        accuracy=_defined(metrics.accuracy(truth, predicted)),
        balanced_accuracy=_defined(metrics.balanced_accuracy(table)),
        ece=_defined(metrics.expected_calibration_error(truth, posteriors)),
        recall=dict(zip(categories, map(_defined, metrics.recall(table)), strict=True)),
        confusion=tuple(tuple(row) for row in table.tolist()),
        seconds_per_object=_defined(_mean(views.seconds) + predicting),
        novelty=novelty,
        rejected_known=_defined(_mean(prediction.novelty[known] > 1)),
        skipped=views.skipped,
        calibration=metrics.calibration_curve(truth, posteriors),
        by_distance=_accuracy_over(views.distances[known], truth == predicted, _DISTANCES_M, " m"),
        by_points=_accuracy_over(views.points[known], truth == predicted, _POINTS, ""),
        fused=fuse_views(truth, posteriors, views.instances[known]),
    )


def _require_categories(names: Sequence[str], categorizer: Categorizer) -> None:
    strange = sorted(set(names) - set(categorizer.categories) - {UNKNOWN})
    if strange:
        msg = (
            f"model {categorizer.model_id} does not know {', '.join(strange)} (it knows "
            f"{', '.join(categorizer.categories)}); teach it with `shapecat learn`, or rename the "
            f"folder to {UNKNOWN}"
        )
        raise ModelError(msg)


def _novelty_figures(unknown: F4, known: F4) -> dict[str, float | None]:
    return {
        "n": len(unknown),
        "auroc": _defined(metrics.auroc(unknown, known)),
        "rejected": _defined(_mean(unknown > 1)),
    }


def _accuracy_over(
    values: np.ndarray, right: I4, edges: Sequence[float], unit: str
) -> tuple[tuple[str, int, float], ...]:
    """Return (range, views, accuracy) for each range of the values that has views."""
    rows = []
    for low, high in itertools.pairwise(edges):
        mine = (values >= low) & (values < high)
        if mine.any():
            name = f"{low:g}-{high:g}{unit}" if math.isfinite(high) else f"{low:g}{unit} or more"
            rows.append((name, int(mine.sum()), float(right[mine].mean())))
    return tuple(rows)


def _as_dicts(rows: Sequence[tuple[str, int, float]]) -> list[dict[str, Any]]:
    return [{"range": name, "n": n, "accuracy": value} for name, n, value in rows]


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _defined(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def format_report(report: Report) -> str:
    """Return the tables for a terminal, 100 columns wide."""
    stream = io.StringIO()
    console = Console(file=stream, width=100, highlight=False)
    skipped = f", {report.skipped} without a surface left out" if report.skipped else ""
    console.print(f"{report.n} views, model {report.model}{skipped}\n")
    console.print(_figures(report))
    console.print(_confusion(report))
    for title, rows in (("distance", report.by_distance), ("voxels", report.by_points)):
        if rows:
            console.print(_breakdown(title, rows))
    if report.fused:
        console.print(_fused(report))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def _grid(title: str | None, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for k, name in enumerate(columns):
        table.add_column(name, justify="left" if k == 0 else "right")
    return table


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _figures(report: Report) -> Table:
    table = _grid(None, "", "")
    table.add_row("accuracy", _text(report.accuracy))
    table.add_row("balanced accuracy", _text(report.balanced_accuracy))
    table.add_row("calibration error", _text(report.ece))
    table.add_row("known shapes rejected", _text(report.rejected_known))
    if report.novelty is not None:
        table.add_row("unknown shapes rejected", _text(report.novelty["rejected"]))
        table.add_row("novelty AUROC", _text(report.novelty["auroc"]))
    milliseconds = None if report.seconds_per_object is None else report.seconds_per_object * 1e3
    table.add_row("ms per object", _text(milliseconds))
    return table


def _confusion(report: Report) -> Table:
    table = _grid("\ntrue category (row) taken for (column)", "", *report.categories, "recall")
    for name, row in zip(report.categories, report.confusion, strict=True):
        table.add_row(name, *(str(n) if n else "." for n in row), _text(report.recall[name]))
    return table


def _breakdown(title: str, rows: Sequence[tuple[str, int, float]]) -> Table:
    table = _grid(None, f"\n{title}", "\nviews", "\naccuracy")
    for name, count, value in rows:
        table.add_row(name, str(count), _text(value))
    return table


def _fused(report: Report) -> Table:
    table = _grid(None, "\nviews fused", "\nobjects", "\naccuracy", "\ncalibration error")
    for item in report.fused:
        table.add_row(str(item.views), str(item.groups), _text(item.accuracy), _text(item.ece))
    return table
