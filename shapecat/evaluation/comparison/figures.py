"""Counts over the frames of a comparison, and metrics computed from them."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from shapecat.evaluation.comparison.identities import FrameIdentities, compute_tracking_metrics
from shapecat.evaluation.comparison.labellings import LabelledItem
from shapecat.evaluation.comparison.matching import (
    SAME_BOX,
    SAME_MASK,
    Difference,
    frame_identities,
)
from shapecat.evaluation.comparison.overlap import Matched, Overlap
from shapecat.evaluation.metrics import expected_calibration_error

__all__ = ["Tally", "figures_of"]


class Pair(NamedTuple):
    """Categories of a matched pair: the true one, the final one, and that of the view alone.

    ``posterior`` (c,) is from the view alone, too.
    """

    truth: str
    label: str
    view: str
    posterior: Any


@dataclass
class Tally:
    """Counts over all compared frames.

    Attributes
    ----------
    frames : number of compared frames.
    masks : whether all objects of all frames have masks.
    pairs : the matched objects, without ambiguous ones.
    """

    frames: int = 0
    masks: bool = True
    overlap: Overlap = field(default_factory=Overlap)
    pairs: list[Pair] = field(default_factory=list)
    identities: list[FrameIdentities] = field(default_factory=list)
    rows: list[Difference] = field(default_factory=list)

    def add(
        self,
        found: Sequence[LabelledItem],
        true: Sequence[LabelledItem],
        matched: Matched,
        rows: Sequence[Difference],
    ) -> None:
        """Add a frame."""
        self.frames += 1
        self.masks &= matched.f is not None
        self.overlap += matched.overlap
        self.identities.append(frame_identities(found, true, matched))
        self.rows += rows
        self.pairs += [
            Pair(true[j].category, found[i].category, found[i].view_category, found[i].posterior)
            for i, j in matched.pairs.items()
            if true[j].decidable
        ]


def figures_of(tally: Tally, categories: Sequence[str], *, tracked: bool) -> dict[str, Any]:
    """Return all metrics by name, as plain values; None for those that cannot be computed.

    Parameters
    ----------
    categories : categories of the model. Metrics of categories ignore true objects of any other
        category, such as *unknown*.
    tracked : whether the true objects have identities over time.
    """
    overlap = tally.overlap if tally.masks else None
    boxes = [row.box_iou for row in tally.rows if row.box_iou is not None]
    threshold = SAME_MASK if tally.masks else SAME_BOX
    return {
        "objects": _objects(tally.rows, overlap),
        "overlap": None
        if overlap is None or not overlap.found + overlap.true
        else {name: round(getattr(overlap, name), 4) for name in ("f", "precision", "recall")},
        "category": _category(
            [pair for pair in tally.pairs if pair.truth in categories], categories
        ),
        "box_iou": {"n": len(boxes), "mean": _mean(boxes)},
        "tracking": _tracking(tally.identities, threshold) if tracked else None,
    }


def _objects(rows: Sequence[Difference], overlap: Overlap | None) -> dict[str, Any]:
    """Count true objects, detections and found objects.

    True objects are found by overlap F, or by their boxes if ``overlap`` is None.
    """
    true = sum(row.difference != "surplus" for row in rows)
    detections = sum(row.difference != "missed" for row in rows)
    hits = overlap.hits if overlap else sum(r.difference not in {"surplus", "missed"} for r in rows)
    share = round(hits / true, 4) if true else None
    return {"true": true, "detections": detections, "found": hits, "share_found": share}


def _category(pairs: Sequence[Pair], categories: Sequence[str]) -> dict[str, Any]:
    """Return accuracies of final labels and of single views, the views' ECE, and the confusions."""
    wrong = Counter((pair.truth, pair.label) for pair in pairs if pair.truth != pair.label)
    truth = np.array([categories.index(pair.truth) for pair in pairs], np.int64)
    posteriors = np.array([pair.posterior for pair in pairs])
    error = expected_calibration_error(truth, posteriors) if pairs else None
    of_labels = [(pair.truth, pair.label) for pair in pairs]
    of_views = [(pair.truth, pair.view) for pair in pairs]
    return {
        "n": len(pairs),
        "accuracy": _accuracy(of_labels),
        "balanced": _balanced(of_labels),
        "view_accuracy": _accuracy(of_views),
        "view_balanced": _balanced(of_views),
        "ece": None if error is None else round(error, 4),
        "taken_for": [{"true": a, "label": b, "n": n} for (a, b), n in wrong.most_common()],
    }


def _accuracy(pairs: Sequence[tuple[str, str]]) -> float | None:
    return _mean([true == said for true, said in pairs])


def _balanced(pairs: Sequence[tuple[str, str]]) -> float | None:
    """Return the mean recall of the true categories in (true, assigned) pairs; None if empty."""
    names = sorted({true for true, _ in pairs})
    recalls = [_accuracy([pair for pair in pairs if pair[0] == name]) for name in names]
    return _mean([value for value in recalls if value is not None])


def _tracking(seen: Sequence[FrameIdentities], threshold: float) -> dict[str, Any]:
    """Return the tracking metrics by name, rounded; None for undefined ones.

    ``threshold`` is the lowest similarity of a matching pair, for MOTA and IDF1.
    """
    figures = compute_tracking_metrics(seen, threshold=threshold)._asdict()
    return {name: None if math.isnan(value) else round(value, 4) for name, value in figures.items()}


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 4) if len(values) else None
