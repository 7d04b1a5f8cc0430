"""Structure rejection: boosted trees separate objects from background structure and noise.

Background structure is walls of bins, sides and edges of shelves, furniture, bent ends of tables
and blobs of noise. No single feature separates it from objects, many weak ones together do. The
trees are grown on simulated scenes (`shapecat.models.structure`), also of rooms with arms and
people.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from shapecat.arrays import F4, I4, Bool
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.merging.segments import Records, Segments, is_root
from shapecat.jit import kernel
from shapecat.trees import BoostedTrees, logit_of, read_trees

__all__ = ["FILE", "find_background", "load_trees", "number_objects"]

FILE = "structure.npz"


@cache
def load_trees() -> BoostedTrees:
    """Load shapecat's trees for rejecting structure."""
    return read_trees(
        files("shapecat.detection.cleanup").joinpath(FILE).read_bytes(), OBJECT_FEATURES
    )


def find_background(
    segments: Segments,
    features: Records,
    grid: DepthGrid,
    settings: DetectionSettings,
    grown: BoostedTrees,
) -> Bool:
    """Return the merged segments to reject, as structure or as too large: (n + 1,) bool.

    ``features`` (n + 1,) are from `measure_object_features`.
    """
    rejected: Bool = _reject(segments, features.view(np.float32).reshape(len(features), -1), grown)
    segment, cells = features["segment"], features["visibility"]["cells"]
    rejected |= segment["width_m"] > settings.max_size_m
    rejected |= segment["top_m"] > settings.max_height_m - CLEANUP.cut_off_m
    # Large and mostly outside the image: furniture, which the trees were not shown.
    large = cells > CLEANUP.large_share * grid.inverse_depth.size
    rejected |= large & (features["surroundings"]["image_border"] > CLEANUP.cut_share)
    return rejected


@kernel
def _reject(segments: Segments, features: F4, grown: BoostedTrees) -> Bool:
    rejected = np.zeros(len(features), np.bool_)
    for p in range(1, len(features)):
        rejected[p] = (
            is_root(segments, p)
            and logit_of(grown, features[p], CLEANUP.hopeless) < CLEANUP.least_logit
        )
    return rejected


@kernel
def number_objects(parent: I4, rejected: Bool, labels: I4, spans: I4) -> I4:
    """Assign numbers to the objects that are not rejected, and write them to the labels.

    Parameters
    ----------
    parent : (n + 1,) from `Segments`; set to 0 for rejected segments.
    rejected : (n + 1,) from `find_background`.
    labels : (rows, columns) the segments, replaced by the objects 1, 2, ..., 0 elsewhere.
    spans : (rows, 2) as in `SurfaceGraph`.

    Returns
    -------
    (objects + 1,) the representative of each object: the segment that its segments are merged into;
    0 for object 0.
    """
    representatives, n = np.zeros(parent.size, np.int64), 0
    numbers = np.zeros(parent.size, np.int16)
    for p in range(1, parent.size):
        if parent[p] == p and not rejected[p]:
            n += 1
            representatives[n], numbers[p] = p, n
    for p in range(1, parent.size):
        q = parent[p]
        numbers[p], parent[p] = numbers[q], 0 if rejected[q] else q
    for i in range(labels.shape[0]):
        for j in range(spans[i, 0], spans[i, 1]):
            labels[i, j] = numbers[labels[i, j]]
    return representatives[: n + 1]
