"""Overlap of found and true objects on simulated clutter and on real tables."""

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.scenes import Array, Labelled, detected, labelled_clutter, labelled_tables
from shapecat.evaluation.comparison.overlap import Overlap, match_masks
from shapecat.types import Frame

Finder = Callable[[Frame], list[Array]]
"""Returns the pixel indices (k,) of each object that it finds in a frame."""


def labelled_sets(count: int, first_seed: int) -> dict[str, list[Labelled]]:
    """Return frames of ``count`` simulated cluttered tables and, if available, real tables."""
    sets = {
        "simulated clutter": list(labelled_clutter(count, first_seed)),
        "real tables": labelled_tables(),
    }
    return {name: frames for name, frames in sets.items() if frames}


def objects_in(frame: Frame) -> list[Array]:
    """Find objects with shapecat's detection; a `Finder`."""
    return [candidate.indices for candidate in detected(frame).candidates]


def score(frames: Sequence[Labelled], finder: Finder) -> dict[str, float]:
    """Match objects one to one; return overlap F, the fraction with F >= 0.75, and their number."""
    total = Overlap()
    for frame, labels, objects in frames:
        masks = [np.flatnonzero(np.isin(labels, parts)) for parts in objects]
        total += match_masks([index[labels[index] > 0] for index in finder(frame)], masks).overlap
    return {
        "F": round(total.f, 4),
        "obj75": round(total.share_found, 4),
        "objects": float(total.objects),
    }
