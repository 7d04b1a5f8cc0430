"""Which found object is which true one, in a frame."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapecat.evaluation.identities import SeenTogether
from shapecat.evaluation.labellings import Item
from shapecat.evaluation.overlap import Overlap, box_iou, match_masks

__all__ = ["SAME_BOX", "SAME_MASK", "Matched", "item_box_iou", "match_objects", "seen_together"]

SAME_MASK = 0.5
"""Intersection over union from which two masks are the same object (PASCAL VOC)."""
SAME_BOX = 0.25
"""The same of boxes in 3D, whose hidden sides are guesses (SUN RGB-D, Song 2015)."""


class Matched(NamedTuple):
    """Pairs of found and true objects of a frame.

    ``similarity`` (found, true) is of all; ``f`` (found, true) and ``overlap`` are None without
    masks.
    """

    pairs: dict[int, int]
    similarity: Any
    f: Any
    overlap: Overlap | None


def match_objects(found: Sequence[Item], true: Sequence[Item]) -> Matched:
    """Match by masks where both have them, else by boxes."""
    masks = [[i.pixels for i in items if i.pixels is not None] for items in (found, true)]
    if len(masks[0]) == len(found) and len(masks[1]) == len(true):
        by_mask = match_masks(masks[0], masks[1])
        same = {i: j for i, j in by_mask.pairs if by_mask.iou[i, j] >= SAME_MASK}
        return Matched(same, by_mask.iou, by_mask.f, by_mask.overlap)
    iou = np.array([[item_box_iou(a, b) or 0.0 for b in true] for a in found])
    iou = iou.reshape(len(found), len(true))
    return Matched(_best(iou), iou, None, None)


def _best(iou: Any) -> dict[int, int]:
    pairs = zip(*(places.tolist() for places in linear_sum_assignment(-iou)), strict=True)
    return {i: j for i, j in pairs if iou[i, j] >= SAME_BOX}


def item_box_iou(a: Item, b: Item) -> float | None:
    """Return the 3D overlap of two boxes; None if a box is missing."""
    return None if a.box is None or b.box is None else box_iou(a.box, b.box)


def seen_together(found: Sequence[Item], true: Sequence[Item], matched: Matched) -> SeenTogether:
    """Return the objects for the tracking scores; of a merged track the most similar part."""
    best: dict[int, int] = {}
    for i, item in enumerate(found):
        if item.track is None:
            continue
        now = best.setdefault(item.track, i)
        if matched.similarity[i].max(initial=0) > matched.similarity[now].max(initial=0):
            best[item.track] = i
    asked = {item.track: j for j, item in enumerate(true) if item.track is not None}
    similarity = matched.similarity[np.ix_(list(best.values()), list(asked.values()))].T
    return SeenTogether(list(asked), list(best), similarity)
