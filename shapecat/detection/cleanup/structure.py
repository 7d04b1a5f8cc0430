"""Structure rejection: boosted trees separate objects from background structure and noise.

Background means walls of bins, sides and edges of shelves, furniture, bent ends of tables and blobs
of noise. No single feature separates it from objects; many weak ones together do. The trees are
trained on simulated scenes (`shapecat.models.structure`), including rooms with arms and people.
They classify each segment alone, and then in the context of the others (`context`).
"""

from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, Bool, Records
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup.context import CONTEXT_FEATURES, add_context, measure_borders
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.depth_grid import DepthGrid, smallest_object_at
from shapecat.detection.merging.segments import Segments, roots_of
from shapecat.detection.planes.height_map import CUT_OFF_M
from shapecat.jit import kernel
from shapecat.trees import BoostedTrees, logit_of, read_trees

__all__ = [
    "FILES",
    "RejectionTrees",
    "as_rows",
    "find_background",
    "is_uncertain",
    "load_trees",
    "logits_of",
    "number_objects",
]


class RejectionTrees(NamedTuple):
    """Trees that classify a segment ``alone``, and then ``in_context``, among the others."""

    alone: BoostedTrees
    in_context: BoostedTrees


FILES = {"structure.npz": OBJECT_FEATURES, "structure_in_context.npz": CONTEXT_FEATURES}
"""The files of both kinds of trees, in the order of `RejectionTrees`, and their features."""


@cache
def load_trees() -> RejectionTrees:
    """Load shapecat's trees for rejecting structure."""
    folder = files("shapecat.detection.cleanup")
    trees = (
        read_trees(folder.joinpath(name).read_bytes(), features) for name, features in FILES.items()
    )
    return RejectionTrees(*trees)


def find_background(
    segments: Segments,
    features: Records,
    grid: DepthGrid,
    settings: DetectionSettings,
    trees: RejectionTrees,
) -> Bool:
    """Return which segments to reject after merging, as structure or for their size: (n + 1,) bool.

    It is False for segments that were merged into another. ``features`` (n + 1,) are from
    `measure_object_features`.
    """
    roots = roots_of(segments)
    merged = features[roots]
    logits = logits_of(as_rows(merged), trees.alone)
    uncertain = is_uncertain(logits)
    if uncertain.any():
        context = add_context(merged, logits, measure_borders(segments, roots))[uncertain]
        logits[uncertain] = logits_of(as_rows(context), trees.in_context)
    segment, cells = merged["segment"], merged["visibility"]["cells"]
    depths = merged["visibility"]["depth_m"]
    large = cells > CLEANUP.large_share * grid.inverse_depth.size
    min_logits = np.where(large, CLEANUP.min_large_logit, CLEANUP.min_logit)
    min_logits[depths > CLEANUP.far_m] = CLEANUP.min_far_logit
    background = logits < min_logits
    background |= cells < CLEANUP.tiny_share * smallest_object_at(grid, depths)
    background |= segment["width_m"] > settings.max_size_m
    background |= segment["top_m"] > settings.max_height_m - CUT_OFF_M
    # Large and cut off by the image border: an arm or furniture; the trees keep some.
    background |= large & (merged["surroundings"]["image_border"] > CLEANUP.cut_share)
    rejected = np.zeros(len(features), np.bool_)
    rejected[roots] = background
    return rejected


def as_rows(features: Records) -> F4:
    """Return records of float32 fields (n,) as an array (n, fields)."""
    return features.view(np.float32).reshape(len(features), features.dtype.itemsize // 4)


def is_uncertain(logits: F4) -> Bool:
    """Return which segments (n,) to classify again in context, given their ``logits`` (n,)."""
    uncertain: Bool = np.abs(logits) < CLEANUP.uncertain_logit
    return uncertain


@kernel
def logits_of(features: F4, ensemble: BoostedTrees) -> F4:
    """Return the log-odds (n,) that segments with these ``features`` (n, f) are objects.

    They are limited to ± `CleanupSettings.certain_logit`.
    """
    certain = CLEANUP.certain_logit
    logits = np.zeros(len(features), np.float32)
    for p in range(len(features)):
        logit = logit_of(ensemble, features[p], -certain, certain)
        logits[p] = min(max(logit, -certain), certain)
    return logits


@kernel
def number_objects(parent: I4, rejected: Bool, labels: I4, spans: I4) -> I4:
    """Assign numbers to the objects that are not rejected, and write them to the labels.

    Parameters
    ----------
    parent : (n + 1,) from `Segments`.
    rejected : (n + 1,) from `find_background`.
    labels : (rows, columns) the segments, replaced by the objects 1, 2, ..., 0 elsewhere.
    spans : (rows, 2) as in `SurfaceGraph`.

    Returns
    -------
    (objects + 1,) the representative of each object: the segment that its segments are merged into;
    0 for label 0.
    """
    representatives, n = np.zeros(parent.size, np.int64), 0
    numbers = np.zeros(parent.size, np.int16)
    for p in range(1, parent.size):
        if parent[p] == p and not rejected[p]:
            n += 1
            representatives[n], numbers[p] = p, n
    for p in range(1, parent.size):
        numbers[p] = numbers[parent[p]]
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            labels[i, j] = numbers[labels[i, j]]
    return representatives[: n + 1]
