"""Matching of the found and true objects of a frame."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapecat.arrays import Bool
from shapecat.evaluation.comparison.identities import FrameIdentities
from shapecat.evaluation.comparison.labellings import LabelledItem, Labelling
from shapecat.evaluation.comparison.overlap import Matched, Overlap, box_iou, match_masks

__all__ = [
    "SAME_BOX",
    "SAME_MASK",
    "Difference",
    "frame_identities",
    "item_box_iou",
    "labelled_part",
    "match_objects",
]

SAME_MASK = 0.5
"""Lowest IoU of two masks that count as the same object (PASCAL VOC)."""
SAME_BOX = 0.25
"""Lowest IoU of two 3D boxes that count as the same object. It is lower than for masks, because
hidden sides are estimates (SUN RGB-D, Song 2015)."""


class Difference(NamedTuple):
    """A row of objects.parquet: a true object and its matched detection, or one without the other.

    Attributes
    ----------
    difference : ``missed``, ``surplus``, ``outline`` (``f`` below 0.75), ``category``, ``identity``
        (another track than in earlier frames), or None if both agree.
    true_track, true_category : from the reference; None without a true object.
    track, category, confidence : from the run; None without a detection.
    f, iou : overlap of the masks; None without masks.
    box_iou : overlap of the 3D boxes; None without boxes.
    """

    topic: str
    frame: int
    stamp_ns: int
    difference: str | None
    true_track: int | None = None
    true_category: str | None = None
    track: int | None = None
    category: str | None = None
    confidence: float | None = None
    f: float | None = None
    iou: float | None = None
    box_iou: float | None = None


def match_objects(found: Sequence[LabelledItem], true: Sequence[LabelledItem]) -> Matched:
    """Match the objects of a frame one to one.

    If all objects of both sides have masks, pairs maximise the sum of overlap F and need an IoU of
    at least 0.5. Otherwise all objects are matched by 3D boxes: pairs maximise the sum of IoU and
    need an IoU of at least 0.25.
    """
    masks = [[i.pixels for i in items if i.pixels is not None] for items in (found, true)]
    if len(masks[0]) == len(found) and len(masks[1]) == len(true):
        by_mask = match_masks(masks[0], masks[1])
        pairs = by_mask.pairs.items()
        return by_mask._replace(
            pairs={i: j for i, j in pairs if by_mask.similarity[i, j] >= SAME_MASK}
        )
    iou = np.array([[item_box_iou(a, b) or 0.0 for b in true] for a in found])
    iou = iou.reshape(len(found), len(true))
    return Matched(_best(iou), iou, None, Overlap())


def _best(iou: Any) -> dict[int, int]:
    """Return the pairs (row, column) with the largest sum of IoU, of at least `SAME_BOX` each."""
    pairs = zip(*(places.tolist() for places in linear_sum_assignment(-iou)), strict=True)
    return {i: j for i, j in pairs if iou[i, j] >= SAME_BOX}


def item_box_iou(a: LabelledItem, b: LabelledItem) -> float | None:
    """Return the IoU of two objects' 3D boxes; None if a box is missing."""
    return None if a.box is None or b.box is None else box_iou(a.box, b.box)


def frame_identities(
    found: Sequence[LabelledItem], true: Sequence[LabelledItem], matched: Matched
) -> FrameIdentities:
    """Return the identities of a frame, without duplicates, and their similarity.

    Objects without a track are left out. Of several detections of one track, the one most similar
    to a true object counts. ``matched`` is from `match_objects`.
    """
    best: dict[int, int] = {}
    for i, item in enumerate(found):
        if item.track is None:
            continue
        best_so_far = best.setdefault(item.track, i)
        if matched.similarity[i].max(initial=0) > matched.similarity[best_so_far].max(initial=0):
            best[item.track] = i
    true_tracks = {item.track: j for j, item in enumerate(true) if item.track is not None}
    similarity = matched.similarity[np.ix_(list(best.values()), list(true_tracks.values()))].T
    return FrameIdentities(list(true_tracks), list(best), similarity)


def labelled_part(found: Labelling, true: Labelling) -> Labelling:
    """Return the detections without the pixels that have no label in the truth.

    A detection with more than half of its pixels ignored in the truth is left out.
    """
    if true.known is None:
        return found
    items = (
        item if item.pixels is None else replace(item, pixels=item.pixels[true.known[item.pixels]])
        for item in found.items
        if not _is_ignored(item, true.ignored)
    )
    return Labelling(tuple(items))


def _is_ignored(item: LabelledItem, ignored: Bool | None) -> bool:
    """Return whether most pixels of an object are marked in ``ignored``.

    ``ignored`` (n,) marks pixels of the flattened image; None marks none.
    """
    if ignored is None or item.pixels is None or not item.pixels.size:
        return False
    return bool(ignored[item.pixels].mean() > 0.5)
