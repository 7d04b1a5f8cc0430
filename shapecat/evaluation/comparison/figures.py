"""Metrics of a comparison, from the counts over its frames."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from shapecat.evaluation.comparison.identities import FrameIdentities, judge_identities
from shapecat.evaluation.comparison.labellings import LabelledItem
from shapecat.evaluation.comparison.matching import Difference, Matched
from shapecat.evaluation.comparison.overlap import Overlap
from shapecat.evaluation.metrics import expected_calibration_error

__all__ = ["Pairs", "figures_of"]


@dataclass
class Pairs:
    """True and predicted categories of matched objects; ambiguous objects are left out.

    Attributes
    ----------
    truth : true categories.
    labels : final categories of the tracks.
    views : categories of the single views.
    posteriors : posteriors (c,) of the single views.
    """

    truth: list[str] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    views: list[str] = field(default_factory=list)
    posteriors: list[Any] = field(default_factory=list)

    def add(
        self, found: Sequence[LabelledItem], true: Sequence[LabelledItem], matched: Matched
    ) -> None:
        """Add the matched pairs of a frame."""
        for i, j in matched.pairs.items():
            if true[j].decidable:
                self.truth.append(true[j].category)
                self.labels.append(found[i].category)
                self.views.append(found[i].view_category)
                self.posteriors.append(found[i].posterior)


def figures_of(
    frames: Mapping[str, int],
    pairs: Pairs,
    *,
    overlap: Overlap | None,
    seen: Sequence[FrameIdentities] | None,
    rows: Sequence[Difference],
    categories: Sequence[str],
    threshold: float,
) -> dict[str, Any]:
    """Return all metrics by name, as plain values; None if they cannot be computed.

    Parameters
    ----------
    frames : numbers of frames, by name.
    overlap : overlap of the masks; None without masks.
    seen : identities of each frame; None without identities.
    rows : the differences of all frames.
    categories : categories of the model; metrics of categories ignore true objects of any other
        category.
    threshold : lowest similarity of a pair that counts as the same object in the tracking metrics.
    """
    boxes = [row.box_iou for row in rows if row.box_iou is not None]
    return {
        "frames": dict(frames),
        "objects": _objects(rows, overlap),
        "overlap": None
        if overlap is None or not overlap.found + overlap.true
        else {name: round(getattr(overlap, name), 4) for name in ("f", "precision", "recall")},
        "category": _category(pairs, categories),
        "box_iou": {"n": len(boxes), "mean": _mean(boxes)},
        "tracking": None if seen is None else _tracking(seen, threshold),
    }


def _objects(rows: Sequence[Difference], overlap: Overlap | None) -> dict[str, Any]:
    """Count true and found objects, matched by masks, or by boxes if there are no masks."""
    true = sum(row.difference != "surplus" for row in rows)
    detections = sum(row.difference != "missed" for row in rows)
    hits = overlap.hits if overlap else sum(r.difference not in {"surplus", "missed"} for r in rows)
    share = round(hits / true, 4) if true else None
    return {"true": true, "detections": detections, "found": hits, "share_found": share}


def _category(pairs: Pairs, categories: Sequence[str]) -> dict[str, Any]:
    """Return the accuracies of final labels and single views, and the views' calibration error.

    True objects outside the model's categories are left out, such as unknown ones of another run.
    """
    known = [k for k, name in enumerate(pairs.truth) if name in categories]
    truth = np.array([categories.index(pairs.truth[k]) for k in known], np.int64)
    wrong = Counter((pairs.truth[k], pairs.labels[k]) for k in known)
    names = [(a, b, count) for (a, b), count in wrong.most_common() if a != b]
    posteriors = np.array([pairs.posteriors[k] for k in known])
    error = expected_calibration_error(truth, posteriors) if known else None
    return {
        "n": len(known),
        "accuracy": _agreement(pairs.truth, pairs.labels, known),
        "balanced": _balanced(pairs.truth, pairs.labels, known),
        "view_accuracy": _agreement(pairs.truth, pairs.views, known),
        "view_balanced": _balanced(pairs.truth, pairs.views, known),
        "ece": None if error is None else round(error, 4),
        "taken_for": [{"true": a, "label": b, "n": count} for a, b, count in names],
    }


def _agreement(truth: Sequence[str], said: Sequence[str], known: Sequence[int]) -> float | None:
    return _mean([truth[k] == said[k] for k in known])


def _balanced(truth: Sequence[str], said: Sequence[str], known: Sequence[int]) -> float | None:
    """Return the mean recall over the categories."""
    names = sorted({truth[k] for k in known})
    recalls = [_agreement(truth, said, [k for k in known if truth[k] == name]) for name in names]
    return _mean([value for value in recalls if value is not None])


def _tracking(seen: Sequence[FrameIdentities], threshold: float) -> dict[str, Any]:
    figures = judge_identities(seen, threshold=threshold).as_dict()
    return {
        name: None if value != value else round(value, 4)  # noqa: PLR0124  NaN
        for name, value in figures.items()
    }


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 4) if len(values) else None
