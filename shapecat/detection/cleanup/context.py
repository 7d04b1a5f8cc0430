"""Context: the classifications of a segment's neighbours.

A finger of a gripper looks like an object, but it is connected to an arm. So the first trees
classify each segment alone, and the second trees also see how the first classify its neighbours.

Source: auto-context (Tu 2008).
"""

import numpy as np

from shapecat.arrays import F4, I4, Records
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.merging.segments import Segments

__all__ = ["CONTEXT_FEATURES", "add_context", "measure_borders"]

_NEIGHBOURS = ("connected", "behind", "in_front", "near")
"""The kinds of neighbours, in the order of the borders from `measure_borders`."""
CONTEXT_FEATURES = np.dtype(
    [
        ("object", OBJECT_FEATURES),
        ("logit", "f4"),  # of the segment, classified alone
        # The mean verdict on each kind of neighbour, from -1, background, to 1, object; 0 if none.
        *((name, "f4") for name in _NEIGHBOURS),
    ],
    align=True,
)
"""The features of a segment, its classification alone, and its neighbours' classifications."""


def measure_borders(segments: Segments, roots: I4) -> F4:
    """Return the lengths of the borders between all pairs of the segments ``roots`` (r,).

    The result (4, r, r), in sides of cells, holds the four kinds of border: the two are connected,
    the second is behind the first, the second is in front, and the two are near but not connected.
    The first and the last kind count each side twice.
    """
    index = np.ix_(roots, roots)
    contact, in_front, near = (segments.pairs[n][index] for n in ("contact", "in_front", "near"))
    borders = np.stack([contact + contact.T, in_front, in_front.T, near + near.T])
    borders[:, np.arange(len(roots)), np.arange(len(roots))] = 0
    return borders


def add_context(features: Records, logits: F4, borders: F4) -> Records:
    """Return the `CONTEXT_FEATURES` of the merged segments of a frame, as records (r,).

    Parameters
    ----------
    features : (r,) `OBJECT_FEATURES` of the segments.
    logits : (r,) log-odds that each segment is an object, classified without its neighbours.
    borders : (4, r, r) lengths of the borders, by kind, from `measure_borders`.
    """
    records = np.zeros(len(features), CONTEXT_FEATURES)
    records["object"], records["logit"] = features, logits
    verdicts = np.tanh(logits / CLEANUP.sure_logit)
    means = borders @ verdicts / np.maximum(borders.sum(axis=2), 1)
    for name, mean in zip(_NEIGHBOURS, means, strict=True):
        records[name] = mean
    return records
