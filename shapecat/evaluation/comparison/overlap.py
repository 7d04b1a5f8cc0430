"""Overlap of found and true objects: of masks, which are matched one to one, and of 3D boxes."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from operator import add
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import ConvexHull, QhullError

from shapecat.arrays import F8, I4, U4
from shapecat.geometry import BOX_EDGES, box_corners, rotation_from_quaternion
from shapecat.types import Box

__all__ = ["MATCHED_F", "Matched", "Overlap", "box_iou", "match_masks"]

MATCHED_F = 0.75
"""Lowest overlap F of an object that counts as found."""


@dataclass(frozen=True)
class Overlap:
    """Counts of pixels and objects over one or more frames; they can be added.

    Attributes
    ----------
    shared : pixels that matched pairs have in common.
    found, true : pixels of all found and of all true objects.
    hits : number of true objects matched with an overlap F of at least `MATCHED_F`.
    objects, detections : number of true and of found objects.
    """

    shared: int = 0
    found: int = 0
    true: int = 0
    hits: int = 0
    objects: int = 0
    detections: int = 0

    def __add__(self, other: "Overlap") -> "Overlap":
        """Return the sum of both counts."""
        return Overlap(*map(add, astuple(self), astuple(other)))

    @property
    def precision(self) -> float:
        """Fraction of the found pixels that are right."""
        return self.shared / max(self.found, 1)

    @property
    def recall(self) -> float:
        """Fraction of the true pixels that were found."""
        return self.shared / max(self.true, 1)

    @property
    def f(self) -> float:
        """The harmonic mean of precision and recall."""
        return 2 * self.shared / max(self.found + self.true, 1)

    @property
    def share_found(self) -> float:
        """Fraction of the true objects that were found."""
        return self.hits / max(self.objects, 1)


class Matched(NamedTuple):
    """Matched objects of a frame.

    Attributes
    ----------
    pairs : index of the true object for each matched found object.
    similarity : (found, true) IoU of the masks, or of the 3D boxes if matched by boxes.
    f : (found, true) overlap F of the masks; None if matched by boxes.
    overlap : counts of the masks' pixels; all 0 if matched by boxes.
    """

    pairs: dict[int, int]
    similarity: Any
    f: Any
    overlap: Overlap


def match_masks(found: Sequence[U4], true: Sequence[U4]) -> Matched:
    """Match found and true masks one to one, maximising the sum of overlap F.

    Each mask is the flat indices (n,) of its pixels. Pairs may have no pixel in common.

    Source: Xie et al. 2020 (overlap F of unseen objects), after Ochs et al. 2014.
    """
    common = _common(found, true)
    sizes = np.array([len(m) for m in found]), np.array([len(m) for m in true])
    total = sizes[0][:, None] + sizes[1]
    f = 2 * common / np.maximum(total, 1)
    iou = common / np.maximum(total - common, 1)
    rows, columns = linear_sum_assignment(-f)
    overlap = Overlap(
        shared=int(common[rows, columns].sum()),
        found=int(sizes[0].sum()),
        true=int(sizes[1].sum()),
        hits=int(np.count_nonzero(f[rows, columns] >= MATCHED_F)),
        objects=len(true),
        detections=len(found),
    )
    return Matched(dict(zip(rows.tolist(), columns.tolist(), strict=True)), iou, f, overlap)


def _common(found: Sequence[U4], true: Sequence[U4]) -> I4:
    """Return the number of pixels that each pair of masks has in common, (found, true).

    A mask is the flat indices (k,) of its pixels.
    """
    size = max((int(mask.max()) + 1 for mask in (*found, *true) if len(mask)), default=0)
    common = np.zeros((len(found), len(true)), np.int64)
    for k, mask in enumerate(true):
        inside = np.zeros(size, np.bool_)
        inside[mask] = True
        common[:, k] = [np.count_nonzero(inside[other]) for other in found]
    return common


def box_iou(a: Box, b: Box) -> float:
    """Return the intersection over union of two oriented boxes in the same coordinate frame.

    The corners of the intersection are the corners of each box inside the other, and the points
    where edges of one box cross faces of the other.

    Examples
    --------
    >>> cube = Box([0, 0, 0], [2, 2, 2], [0, 0, 0, 1])
    >>> box_iou(cube, Box([1, 0, 0], [2, 2, 2], [0, 0, 0, 1]))
    0.3333333333333333
    """
    points = np.concatenate([_inside(a, b), _inside(b, a)])
    volumes = [float(np.prod(box.size, dtype=np.float64)) for box in (a, b)]
    if len(points) < 4 or min(volumes) <= 0:
        return 0.0
    try:
        shared = min(float(ConvexHull(points).volume), *volumes)
    except QhullError:  # flat: they touch
        return 0.0
    return shared / (sum(volumes) - shared)


def _inside(a: Box, b: Box) -> F8:
    """Return the end points (n, 3) of the edges of ``a``, after clipping the edges to ``b``."""
    turn = rotation_from_quaternion(b.orientation)
    corners = (box_corners(a) - b.center) @ turn
    half = b.size.astype(np.float64) / 2
    start, step = corners[BOX_EDGES[:, 0]], corners[BOX_EDGES[:, 1]] - corners[BOX_EDGES[:, 0]]
    still = np.abs(step) < 1e-12
    safe = np.where(still, 1.0, step)
    sides = np.stack([(-half - start) / safe, (half - start) / safe])
    outside = still & (np.abs(start) > half + 1e-9)
    low = np.where(still, 0.0, sides.min(axis=0)).max(axis=1)
    high = np.where(still, 1.0, sides.max(axis=0)).min(axis=1)
    low, high = np.maximum(low, 0), np.minimum(high, 1)
    met = (low <= high) & ~outside.any(axis=1)
    ends = np.concatenate([start + low[:, None] * step, start + high[:, None] * step])
    points = ends[np.tile(met, 2)] @ turn.T + b.center
    return np.asarray(points)
