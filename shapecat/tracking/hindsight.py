"""What only a recording tells: where the scene was exchanged, and which tracks are one object."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from shapecat.arrays import F8, I4, Bool, Record, array
from shapecat.config import TrackingSettings
from shapecat.tracking.association import posterior_difference, size_difference, size_key
from shapecat.tracking.records import FrameDetections
from shapecat.tracking.tracker import reach

__all__ = ["Fragments", "merge_fragments", "scene_cuts"]

_NEIGHBOURHOOD_M = 0.3  # objects that far apart say nothing about each other
_SLOW_S = 0.3  # frames this far apart are not expected to show a motion
_SAME_SIZE = 0.25  # mean absolute logarithm of the ratio of sizes
_SAME_POSTERIOR = 0.5  # total variation
_LOOKAHEAD = 8  # later fragments at the same place that are considered


class Fragments(Record):
    """Tracks as they were found without knowing the future, one per row, in order of birth.

    ``first_ns`` and ``last_ns`` (f,) times of the first and last detection; ``start`` and ``end``
    (f, 3) metres, where it was then; ``sizes`` (f, 3) typical box lengths, metres; ``posteriors``
    (f, c); ``scenes`` (f,) number of the scene, counted by `scene_cuts`.
    """

    first_ns: I4 = array("f", "i8")
    last_ns: I4 = array("f", "i8")
    start: F8 = array("f 3", "f8")
    end: F8 = array("f 3", "f8")
    sizes: F8 = array("f 3", "f8")
    posteriors: F8 = array("f c", "f8")
    scenes: I4 = array("f", "i4")


def merge_fragments(fragments: Fragments, settings: TrackingSettings) -> I4:
    """Join fragments of one object: same place, no overlap in time, alike in size and posterior.

    The end of one fragment is joined to the start of a later one, the best pair first; each end
    and each start is used once, so that a chain never shows two detections at a time. An object
    that was taken away and replaced by its like while nobody looked counts as the same.

    Returns
    -------
    (f,) position of the first fragment of the chain each one belongs to.

    Notes
    -----
    O(f log f) for fragments spread in space; at one place, eight successors are looked at.
    """
    result = np.arange(len(fragments.first_ns))
    used_end, used_start = np.zeros(result.size, bool), np.zeros(result.size, bool)
    for i, j in _links(fragments, settings):
        if not (used_end[i] or used_start[j]):
            used_end[i] = used_start[j] = True
            result[j] = i
    for j in np.argsort(fragments.first_ns, kind="stable"):
        result[j] = result[result[j]]  # the predecessor is older and done
    return result.astype(np.int32)


def _links(fragments: Fragments, settings: TrackingSettings) -> list[tuple[int, int]]:
    """Return possible joins (earlier, later), the most likely first."""
    keys = size_key(fragments.sizes)
    limit = reach(keys, settings.gate_m)
    near = cKDTree(fragments.start).query_ball_point(fragments.end, limit) if len(keys) else []
    found = []
    for i, candidates in enumerate(near):
        after = np.array(candidates, np.int64)
        after = after[
            (fragments.first_ns[after] > fragments.last_ns[i])
            & (fragments.scenes[after] == fragments.scenes[i])
        ]
        after = after[np.argsort(fragments.first_ns[after], kind="stable")[:_LOOKAHEAD]]
        distance = np.linalg.norm(fragments.start[after] - fragments.end[i], axis=1) / limit[i]
        size = size_difference(keys[i : i + 1], keys[after])[0]
        posterior = posterior_difference(
            fragments.posteriors[i : i + 1], fragments.posteriors[after]
        )[0]
        gap_s = (fragments.first_ns[after] - fragments.last_ns[i]) * 1e-9
        cost = distance + size / _SAME_SIZE + posterior + gap_s / (gap_s + 10)
        alike = (size <= _SAME_SIZE) & (posterior <= _SAME_POSTERIOR)
        found += [(float(c), i, int(j)) for c, j in zip(cost[alike], after[alike], strict=True)]
    return [(i, j) for _, i, j in sorted(found)]


def scene_cuts(frames: Sequence[FrameDetections], settings: TrackingSettings) -> Bool:
    """Return (k,) which frames of one stream show another scene than the frames before.

    Recordings made of single pictures put different objects at the same place from one frame to
    the next. Two frames speak for a cut when fewer than half of the objects that have any
    neighbour in the other frame are found again. A single odd frame is no cut: the frames on
    both sides of it must disagree too. Frames without detections say nothing.
    """
    result = np.zeros(len(frames), bool)
    filled = [k for k, frame in enumerate(frames) if len(frame.centers)]
    for n in range(1, len(filled)):
        before, now = frames[filled[n - 1]], frames[filled[n]]
        if _continues(before, now, settings):
            continue
        skips = []
        if n + 1 < len(filled):
            skips.append((before, frames[filled[n + 1]]))
        if n > 1 and not result[filled[n - 1]]:
            skips.append((frames[filled[n - 2]], now))
        result[filled[n]] |= not any(_continues(a, b, settings) for a, b in skips)
    return result


def _continues(a: FrameDetections, b: FrameDetections, settings: TrackingSettings) -> bool:
    """Whether b may show the scene of a: objects in the same area are mostly the same."""
    distance = np.linalg.norm(a.centers[:, None] - b.centers[None], axis=2)
    near = distance < _NEIGHBOURHOOD_M
    comparable = min(int(near.any(axis=1).sum()), int(near.any(axis=0).sum()))
    if comparable == 0:
        return True
    slow = abs(b.stamp_ns - a.stamp_ns) > _SLOW_S * 1e9
    keys_a, keys_b = size_key(a.sizes), size_key(b.sizes)
    limit = 0.5 * reach(keys_a, settings.gate_m) if slow else np.full(len(keys_a), settings.gate_m)
    same = (
        (distance <= limit[:, None])
        & (size_difference(keys_a, keys_b) <= _SAME_SIZE)
        & (posterior_difference(a.posteriors, b.posteriors) <= (_SAME_POSTERIOR if slow else 1.0))
    )
    found = min(int(same.any(axis=1).sum()), int(same.any(axis=0).sum()))
    return 2 * found >= comparable
