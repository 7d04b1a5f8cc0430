"""Track stitching: scene cuts, and the track fragments of one object joined in hindsight."""

from collections.abc import Iterator
from heapq import merge

import numpy as np
from scipy.spatial import cKDTree

from shapecat.arrays import F8, I4, Bool, Record, array
from shapecat.config import TrackingSettings
from shapecat.tracking.association import posterior_difference, size_key
from shapecat.tracking.detection_table import DetectionTable
from shapecat.tracking.tracker import gate_radius

__all__ = ["Fragments", "merge_fragments", "scene_cuts"]

_NEIGHBOURHOOD_M = 0.3  # objects farther apart than this are not compared for scene cuts
_SLOW_S = 0.3  # beyond this interval between frames, motion does not explain a distance
_KNOWN = 8  # whole views needed to know the size, as some views only seem whole
_SAME_SIZE = 0.25  # largest difference of size keys of the same object
_SAME_POSTERIOR = 0.5  # largest total variation distance of posteriors of the same object
_SLOW_REACH = 0.5  # fraction of the gate radius that an object at rest may seem to move
_TOGETHER_M = 0.03  # largest difference of the displacements of objects that moved together
_MOST = 2 / 3  # fraction of the comparable objects that must have moved together
_PARTIAL_SLACK = 1.5  # factor of _SAME_POSTERIOR and _SLOW_REACH for pairs with a partial view
_TRUSTED = 0.4  # added to _SAME_POSTERIOR for equal positions and sizes, if few views are whole
_LOOKAHEAD = 8  # later fragments at the same position that are considered


class Fragments(Record):
    """Parts of tracks between long gaps, found without knowing the future, one per row.

    Attributes
    ----------
    first_ns, last_ns : (f,) times of the first and the last detection.
    start, end : (f, 3) positions at these times, metres.
    start_velocity, end_velocity : (f, 3) velocities at these times, m/s.
    sizes : (f, 3) typical box lengths, metres.
    whole_views : (f,) number of views that seem to show the whole object.
    cut : (f, 2) whether the first and the last view are partial.
    posteriors : (f, c) fused posteriors.
    novelties : (f,) fused novelties; above 1, the posterior is meaningless.
    scenes : (f,) number of the scene; `scene_cuts` separates scenes.
    """

    first_ns: I4 = array("f", "i8")
    last_ns: I4 = array("f", "i8")
    start: F8 = array("f 3", "f8")
    end: F8 = array("f 3", "f8")
    start_velocity: F8 = array("f 3", "f8")
    end_velocity: F8 = array("f 3", "f8")
    sizes: F8 = array("f 3", "f8")
    whole_views: I4 = array("f", "i4")
    cut: Bool = array("f 2", "?")
    posteriors: F8 = array("f c", "f8")
    novelties: F8 = array("f", "f8")
    scenes: I4 = array("f", "i4")


def merge_fragments(fragments: Fragments, settings: TrackingSettings) -> I4:
    """Stitch fragments that agree in position, size and posterior and do not overlap in time.

    The end of a fragment is linked to the start of a later one, the best pair first. Each end and
    each start is used at most once, so that a chain never has two detections at a time. An object
    that was replaced by a similar one while out of view counts as the same.

    Returns
    -------
    For each fragment (f,), the index of the first fragment of its chain.

    Notes
    -----
    Cost: O(f log f) for fragments spread in space. For each, at most eight successors near its end
    position, and 32 that start soon after it, are considered.
    """
    result = np.arange(len(fragments.first_ns))
    used_end, used_start = np.zeros(result.size, bool), np.zeros(result.size, bool)
    for i, j in _links(fragments, settings):
        if not (used_end[i] or used_start[j]):
            used_end[i] = used_start[j] = True
            result[j] = i
    for j in np.argsort(fragments.first_ns, kind="stable"):
        result[j] = result[result[j]]  # the predecessor is older and thus already resolved
    return result.astype(np.int32)


def _links(fragments: Fragments, settings: TrackingSettings) -> list[tuple[int, int]]:
    """Return the possible links (earlier, later), the cheapest first."""
    keys = size_key(fragments.sizes)
    limit = gate_radius(keys, settings.gate_m)
    # An object disappears at one side of an occluder and emerges at the other.
    hidden = 2 * gate_radius(keys, np.inf)
    size_known = fragments.whole_views >= _KNOWN
    vague = (fragments.whole_views == 0) | (fragments.novelties > 1)  # the posterior is meaningless
    links = []
    for i, after in enumerate(_successors(fragments, limit, settings)):
        within = np.where(fragments.cut[i, 1] & fragments.cut[after, 0], hidden[i], limit[i])
        distance = _distances(fragments, i, after, settings) / np.maximum(within, 1e-9)
        size = _contradiction(keys[i], keys[after], size_known[i], size_known[after])
        posterior = posterior_difference(
            fragments.posteriors[i : i + 1], fragments.posteriors[after]
        )[0]
        gap_s = (fragments.first_ns[after] - fragments.last_ns[i]) * 1e-9
        cost = distance + size / _SAME_SIZE + posterior + gap_s / (gap_s + 10)
        alike = (distance <= 1) & (size <= _SAME_SIZE)
        agreement = (1 - distance) * (1 - size / _SAME_SIZE) * ~(size_known[i] & size_known[after])
        similar = posterior <= _SAME_POSTERIOR + _TRUSTED * agreement
        alike &= vague[i] | vague[after] | similar
        links += [(float(c), i, int(j)) for c, j in zip(cost[alike], after[alike], strict=True)]
    return [(i, j) for _, i, j in sorted(links)]


def _contradiction(keys: F8, other_keys: F8, size_known: Bool, other_size_known: Bool) -> F8:
    """Return how much `size_key` results (..., 3) contradict others (..., 3), broadcast to (...).

    An object of unknown size may be larger than seen so far, so only lengths beyond a known size
    count. ``size_known`` and ``other_size_known`` (...) say which sizes are known.
    """
    excess = keys - other_keys
    counts = np.where(excess > 0, other_size_known[..., None], size_known[..., None])
    return np.asarray((np.abs(excess) * counts).mean(axis=-1))


def _successors(fragments: Fragments, limit: F8, settings: TrackingSettings) -> Iterator[I4]:
    """Yield, for each fragment, later ones that start near its end position or soon after its end.

    These are indices (k,) of fragments in the same scene. ``limit`` (f,) is the largest distance
    from each end position, metres.
    """
    if len(limit) == 0:
        return
    tree = cKDTree(fragments.start)
    order = np.argsort(fragments.first_ns, kind="stable")
    first = fragments.first_ns[order]
    window = int(min(settings.max_missed_s * 1e9, 2**62))
    for i, end in enumerate(fragments.last_ns):
        # One by one: after some hours, lists of all of them would have millions of numbers.
        near = tree.query_ball_point(fragments.end[i], limit[i], return_sorted=True)
        for_place = np.array(near, np.int64)
        low, high = np.searchsorted(first, [end, end + window], side="right")
        for_place = for_place[fragments.first_ns[for_place] > end]
        for_place = for_place[np.argsort(fragments.first_ns[for_place], kind="stable")]
        after = np.union1d(for_place[:_LOOKAHEAD], order[low:high][: 4 * _LOOKAHEAD])
        yield after[fragments.scenes[after] == fragments.scenes[i]]


def _distances(fragments: Fragments, i: int, after: I4, settings: TrackingSettings) -> F8:
    """Return the distances (k,), metres, between the end of fragment i and the starts of ``after``.

    ``after`` (k,) are indices of fragments. Over a short gap, both positions are also extrapolated
    with their velocities to the middle of the gap; the smaller distance counts.
    """
    resting = np.linalg.norm(fragments.start[after] - fragments.end[i], axis=1)
    gap_s = (fragments.first_ns[after] - fragments.last_ns[i])[:, None] * 1e-9
    meeting = (fragments.start[after] - 0.5 * gap_s * fragments.start_velocity[after]) - (
        fragments.end[i] + 0.5 * gap_s * fragments.end_velocity[i]
    )
    moving = np.where(gap_s[:, 0] <= settings.max_missed_s, np.linalg.norm(meeting, axis=1), np.inf)
    return np.asarray(np.minimum(resting, moving))


def scene_cuts(table: DetectionTable, settings: TrackingSettings) -> Bool:
    """Return the mask (f,) of frames of a stream that begin a new scene.

    Recordings of single images can show different objects at the same position from one frame to
    the next. Objects less than 0.3 m from an object of the other frame are compared. Two frames
    disagree if fewer than half of the compared objects match one of the other frame in position,
    size and, if the frames are more than 0.3 s apart, posterior (see `_continues`). A single odd
    frame is not a cut: the frames on both sides of it must disagree too. Only frames of one topic
    are compared, as other sensors may see other objects. Frames without detections are ignored, but
    a frame at most 0.3 s after one begins no scene, as objects move while out of view. A clock that
    jumps back by more than ``max_missed_s`` also begins a new scene.
    """
    stamps, filled = table.stamps_ns, np.unique(table.rows)
    result = np.diff(stamps, prepend=stamps[:1]) < -settings.max_missed_s * 1e9
    topics = (_with_neighbours(table, filled, topic) for topic in range(len(table.names)))
    for k, last, before, older, later in merge(*topics):
        slow = bool(stamps[k] - stamps[before] > _SLOW_S * 1e9)
        if before > last and not slow:
            continue  # after some frames out of view, an object may be anywhere
        if result[last + 1 : k].any():
            continue  # another topic shows that the scene has changed
        pairs = [(last, k)]
        if later >= 0:
            pairs.append((last, later))
        if older >= 0 and not result[last]:
            pairs.append((older, k))
        continues = (_continues(table, i, j, slow=slow, settings=settings) for i, j in pairs)
        result[k] |= not any(continues)
    return np.asarray(result)


def _with_neighbours(
    table: DetectionTable, filled: I4, topic: int
) -> Iterator[tuple[int, int, int, int, int]]:
    """Yield the row of each frame of a topic with detections, except the first, and four others.

    The others are the rows of the topic's previous frame with detections, its previous frame, its
    second previous frame with detections, and its next frame with detections; -1 if there is none.
    ``filled`` (k,) are the rows of all frames with detections.
    """
    frames, nonempty = np.flatnonzero(table.topics == topic), filled[table.topics[filled] == topic]
    before = frames[np.searchsorted(frames, nonempty) - 1]
    for n in range(1, len(nonempty)):
        older = int(nonempty[n - 2]) if n > 1 else -1
        later = int(nonempty[n + 1]) if n + 1 < len(nonempty) else -1
        yield int(nonempty[n]), int(nonempty[n - 1]), int(before[n]), older, later


def _continues(
    table: DetectionTable, i: int, j: int, *, slow: bool, settings: TrackingSettings
) -> bool:
    """Return whether frames i and j may show the same scene: at least half of the objects match.

    They also may if no objects are near enough to be compared. A partial view may be smaller than
    its object. If the frames are ``slow``, that is, more than 0.3 s apart, positions and posteriors
    must agree more closely, but less so in partial views. Then it is also enough that most objects,
    and at least two, have moved together, on a belt or as seen by a moving sensor: unrelated images
    rarely look like that.
    """
    a, b = table.of_frame(i), table.of_frame(j)
    offsets = table.centers[b][None] - table.centers[a][:, None]
    distance = np.linalg.norm(offsets, axis=2)
    nearby = distance < _NEIGHBOURHOOD_M
    comparable = _pairs(nearby)
    if comparable == 0:
        return True
    keys_a, keys_b = size_key(table.sizes[a]), size_key(table.sizes[b])
    whole_a, whole_b = ~table.partial[a][:, None], ~table.partial[b][None]
    size = _contradiction(keys_a[:, None], keys_b[None], whole_a, whole_b)
    matches = (distance <= settings.gate_m) & (size <= _SAME_SIZE)
    if slow:
        slack = np.where(whole_a & whole_b, 1.0, _PARTIAL_SLACK)
        posterior_gap = posterior_difference(table.posteriors[a], table.posteriors[b])
        alike = matches & (posterior_gap <= slack * _SAME_POSTERIOR)
        reach = slack * _SLOW_REACH * gate_radius(keys_a, settings.gate_m)[:, None]
        matches = alike & (distance <= reach)
        if _moved_together(offsets, alike) >= max(2, _MOST * comparable):
            return True
    return 2 * _pairs(matches) >= comparable


def _moved_together(offsets: F8, alike: Bool) -> int:
    """Return the number of objects that share a displacement.

    ``alike`` (m, n) marks the pairs that may be one object, ``offsets`` (m, n, 3) are the
    displacements of all pairs, metres. The shortest one of each object is tried.
    """
    distance = np.where(alike, np.linalg.norm(offsets, axis=2), np.inf)
    rows = np.flatnonzero(alike.any(axis=1))
    shortest = offsets[rows, distance[rows].argmin(axis=1)]
    differences = (np.linalg.norm(offsets - d, axis=2) for d in shortest)
    return max((_pairs(alike & (d <= _TOGETHER_M)) for d in differences), default=0)


def _pairs(matches: Bool) -> int:
    """Return the number of rows with a match, or of columns with one if that is smaller."""
    return min(int(matches.any(axis=1).sum()), int(matches.any(axis=0).sum()))
