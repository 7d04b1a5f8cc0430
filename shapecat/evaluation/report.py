"""Evaluation of a model on labelled views: the tables of the thesis (ch. 8)."""

import io
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from rich.console import Console
from rich.table import Table

from shapecat.arrays import F4, Bool
from shapecat.errors import ModelError
from shapecat.evaluation import metrics
from shapecat.evaluation.fused import Fused, fuse_views
from shapecat.evaluation.markup import figure_text
from shapecat.evaluation.views import DescribedViews
from shapecat.learning import Categorizer
from shapecat.outputs.counts import plural
from shapecat.types import UNKNOWN

__all__ = [
    "Compared",
    "Ranges",
    "Report",
    "Rows",
    "breakdown_table",
    "comparison_tables",
    "evaluate",
    "format_report",
    "require_categories",
]

Row: TypeAlias = tuple[str, ...]
Rows: TypeAlias = list[Row]
Ranges: TypeAlias = tuple[tuple[str, int, float], ...]
"""Name of each range, its number of views, and their accuracy."""

_ELEVATIONS = (-math.inf, 15.0, 30.0, 45.0, 60.0, math.inf)
_DISTANCES_M = (0.0, 0.8, 1.1, 1.4, 1.7, math.inf)
"""Edges of the ranges of elevation, degrees, and of distance."""
_WIDEST = 1_000_000
"""Width of a table in characters: enough for the maximum number of categories with long names."""
_POINTS = (0, 60, 120, 250, 500, 1000, math.inf)
"""Edges of the ranges of the number of voxels."""


class Compared(NamedTuple):
    """Results of the classifier named ``learner``; undefined metrics are None.

    ``learned`` is the number of views that it was trained on; in cross-validation, the mean over
    the folds.
    """

    learner: str
    learned: int
    accuracy: float | None
    balanced_accuracy: float | None
    ece: float | None


@dataclass(frozen=True)
class Report:
    """The results of an evaluation; undefined metrics are None.

    Attributes
    ----------
    model : id of the model.
    n : number of views with a category of the model.
    ece : expected calibration error.
    recall : recall of each category.
    confusion : (c, c) number of views of each true category (row) by predicted category (column),
        in the order of ``categories``.
    novelty : ``n`` (number of unknown shapes), ``rejected`` (fraction of them with a novelty above
        1) and ``auroc``; None without unknown shapes.
    rejected_known : fraction of the known shapes with a novelty above 1.
    skipped : number of views with too few points for a surface.
    off_support : categories whose objects, in most views, do not stand at z = 0.
    by_distance, by_points, by_elevation : (range, views, accuracy) over the distance in metres, the
        number of voxels, and the elevation of the sensor as seen from the object, degrees.
    fused : accuracy after fusing several views; empty if no object has three views.
    baselines : results of shapecat's classifier and of the baselines, trained on the same views;
        empty unless requested.
    calibration : number of views, mean confidence and accuracy in bins of confidence.
    """

    model: str
    n: int
    categories: tuple[str, ...]
    accuracy: float | None
    balanced_accuracy: float | None
    ece: float | None
    recall: dict[str, float | None]
    confusion: tuple[tuple[int, ...], ...]
    novelty: dict[str, float | None] | None = None
    rejected_known: float | None = None
    skipped: int = 0
    off_support: tuple[str, ...] = ()
    calibration: tuple[metrics.Bin, ...] = ()
    by_distance: Ranges = ()
    by_points: Ranges = ()
    fused: tuple[Fused, ...] = ()
    by_elevation: Ranges = ()
    baselines: tuple[Compared, ...] = ()

    @property
    def breakdowns(self) -> tuple[tuple[str, Ranges], ...]:
        """The name and the rows of each breakdown that is not empty."""
        parts = (
            ("distance", self.by_distance),
            ("elevation", self.by_elevation),
            ("points", self.by_points),
        )
        return tuple((name, rows) for name, rows in parts if rows)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            **{name: getattr(self, name) for name in self.__dataclass_fields__},
            "categories": list(self.categories),
            "confusion": [list(row) for row in self.confusion],
            "calibration": [item._asdict() for item in self.calibration],
            "by_distance": _as_dicts(self.by_distance),
            "by_points": _as_dicts(self.by_points),
            "by_elevation": _as_dicts(self.by_elevation),
            "fused": [item._asdict() for item in self.fused],
            "baselines": [item._asdict() for item in self.baselines],
        }


def evaluate(views: DescribedViews, categorizer: Categorizer) -> Report:
    """Compare the predictions of a model with the labels of described views.

    Views labelled ``unknown`` only affect the novelty metrics. The accuracies use the most probable
    category of every other view, whether novel or not.

    Raises
    ------
    ModelError : the model does not know a label.
    """
    require_categories(np.unique(views.labels).tolist(), categorizer)
    prediction = categorizer.predict(views.descriptors)
    categories = categorizer.categories
    known = views.labels != UNKNOWN
    truth = np.array([categories.index(label) for label in views.labels[known]], np.int64)
    posteriors = prediction.posteriors[known]
    predicted = posteriors.argmax(axis=1).astype(np.int64)
    table = metrics.confusion(truth, predicted, len(categories))
    elevations = views.elevations if len(views.elevations) else np.full(known.shape, np.nan)
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
        novelty=novelty,
        rejected_known=_defined(_mean(prediction.novelty[known] > 1)),
        skipped=views.skipped,
        off_support=views.off_support,
        calibration=metrics.calibration_curve(truth, posteriors),
        by_distance=_accuracy_by_range(
            views.distances[known], truth == predicted, _DISTANCES_M, " m"
        ),
        by_points=_accuracy_by_range(views.points[known], truth == predicted, _POINTS, ""),
        by_elevation=_accuracy_by_range(elevations[known], truth == predicted, _ELEVATIONS, "°"),
        fused=fuse_views(truth, posteriors, views.instances[known]),
    )


def require_categories(names: Sequence[str], categorizer: Categorizer) -> None:
    """Check that a model knows all category names; ``unknown`` is always allowed.

    Raises
    ------
    ModelError : the model does not know a name.
    """
    strange = sorted(set(names) - set(categorizer.categories) - {UNKNOWN})
    if strange:
        msg = (
            f"model {categorizer.model_id} does not know {', '.join(strange)} (it knows "
            f"{', '.join(categorizer.categories)}); add it with `shapecat learn`, or rename the "
            f"folder to {UNKNOWN}"
        )
        raise ModelError(msg)


def _novelty_figures(unknown: F4, known: F4) -> dict[str, float | None]:
    """Return `Report.novelty` from the novelties of unknown (n,) and of known views (m,)."""
    return {
        "n": len(unknown),
        "auroc": _defined(metrics.auroc(unknown, known)),
        "rejected": _defined(_mean(unknown > 1)),
    }


def _accuracy_by_range(
    values: np.ndarray, right: Bool, edges: Sequence[float], unit: str
) -> Ranges:
    """Return (range, views, accuracy) for each range [low, high) between ``edges`` that has views.

    ``values`` (n,) is the quantity of each view, in ``unit``; ``right`` (n,) is whether its
    category is right.
    """
    rows = []
    for low, high in itertools.pairwise(edges):
        in_range = (values >= low) & (values < high)
        if in_range.any():
            name = f"{low:g}-{high:g}{unit}" if math.isfinite(high) else f"{low:g}{unit} or more"
            name = name if math.isfinite(low) else f"below {high:g}{unit}"
            rows.append((name, int(in_range.sum()), float(right[in_range].mean())))
    return tuple(rows)


def _as_dicts(rows: Ranges) -> list[dict[str, Any]]:
    return [{"range": name, "n": n, "accuracy": value} for name, n, value in rows]


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _defined(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def format_report(report: Report) -> str:
    """Return a report as text tables; names are printed as they are, and no table is wrapped."""
    stream = io.StringIO()
    console = Console(file=stream, width=_WIDEST, highlight=False, markup=False, emoji=False)
    skipped = f"; skipped {report.skipped} without a surface" if report.skipped else ""
    console.print(f"{plural(report.n, 'view')}, model {report.model}{skipped}")
    console.print(_grid(("", ""), _figures(report)))
    # As the title of the table, it would be wrapped to the table's width.
    console.print("\nrows: true category; columns: predicted category")
    console.print(_grid(("", *report.categories, "recall"), _confusion(report)))
    tables = [breakdown_table(name, ranges) for name, ranges in report.breakdowns]
    tables += [(head, rows) for _, head, rows in comparison_tables(report, "-")]
    for head, rows in tables:
        console.print(_grid([f"\n{name}" for name in head], rows))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def _grid(head: Iterable[str], rows: Rows) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for k, name in enumerate(head):
        table.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _figures(report: Report) -> Rows:
    figures = {
        "accuracy": report.accuracy,
        "balanced accuracy": report.balanced_accuracy,
        "calibration error": report.ece,
        "known shapes rejected": report.rejected_known,
    }
    if report.novelty is not None:
        figures["unknown shapes rejected"] = report.novelty["rejected"]
        figures["novelty AUROC"] = report.novelty["auroc"]
    return [(name, figure_text(value, "-")) for name, value in figures.items()]


def _confusion(report: Report) -> Rows:
    return [
        (name, *(str(n) if n else "." for n in row), figure_text(report.recall[name], "-"))
        for name, row in zip(report.categories, report.confusion, strict=True)
    ]


def breakdown_table(name: str, ranges: Ranges) -> tuple[Row, Rows]:
    """Return header and rows of the table of a breakdown by the quantity ``name``."""
    rows: Rows = [(label, str(count), figure_text(value)) for label, count, value in ranges]
    return (name, "views", "accuracy"), rows


def comparison_tables(report: Report, missing: str = "–") -> list[tuple[str, Row, Rows]]:
    """Return title, header and rows of the tables of fused views and of baselines, if any.

    ``missing`` stands for an undefined metric.
    """
    text = partial(figure_text, missing=missing)
    tables: list[tuple[str, Row, Rows]] = []
    if report.fused:
        head: Row = ("views fused", "groups", "accuracy", "calibration error")
        rows: Rows = [
            (str(one.views), str(one.groups), text(one.accuracy), text(one.ece))
            for one in report.fused
        ]
        tables.append(("Several views of one object", head, rows))
    if report.baselines:
        head = ("classifier", "training views", "accuracy", "balanced", "calibration error")
        rows = [
            (learner, str(learned), *map(text, figures))
            for learner, learned, *figures in report.baselines
        ]
        tables.append(("Classifiers trained on the same views", head, rows))
    return tables
