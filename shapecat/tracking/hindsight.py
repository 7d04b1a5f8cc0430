"""Hindsight: find scene cuts, and join the fragments of one object."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from shapecat.arrays import F8, I4, Bool, Record, array
from shapecat.config import TrackingSettings
from shapecat.tracking.association import posterior_difference, size_difference, size_key
from shapecat.tracking.hits import Hits
from shapecat.tracking.tracker import reach

__all__ = ["Fragments", "merge_fragments", "scene_cuts"]

_NEIGHBOURHOOD_M = 0.3  # objects that far apart say nothing about each other
_SLOW_S = 0.3  # frames this far apart are not expected to show a motion
_KNOWN = 8  # whole views that tell a size; some that seem whole are not
_SAME_SIZE = 0.25  # mean absolute logarithm of the ratio of sizes
_SAME_POSTERIOR = 0.5  # total variation
_TRUSTED = 0.4  # so much more where few views are whole, at the very place and in the very size
_LOOKAHEAD = 8  # later fragments at the same place that are considered


class Fragments(Record):
    """Tracks as they were found without knowing the future, one per row, in order of birth.

    ``first_ns`` and ``last_ns`` (f,) times of the first and last detection; ``start`` and ``end``
    (f, 3) metres, where it was then, and ``start_velocity``, ``end_velocity`` (f, 3) m/s;
    ``sizes`` (f, 3) typical box lengths, metres, ``whole`` (f,) how many views seem to show all
    of it, and ``rest`` (f, 3) where it is then, nan if it moves; ``cut`` (f, 2) whether the first
    and the last view show only a part of it; ``posteriors`` (f, c), and ``novelties`` (f,), above
    1 where they say nothing; ``scenes`` (f,) number of the scene, counted by `scene_cuts`.
    """

    first_ns: I4 = array("f", "i8")
    last_ns: I4 = array("f", "i8")
    start: F8 = array("f 3", "f8")
    end: F8 = array("f 3", "f8")
    start_velocity: F8 = array("f 3", "f8")
    end_velocity: F8 = array("f 3", "f8")
    sizes: F8 = array("f 3", "f8")
    whole: I4 = array("f", "i4")
    rest: F8 = array("f 3", "f8")
    cut: Bool = array("f 2", "?")
    posteriors: F8 = array("f c", "f8")
    novelties: F8 = array("f", "f8")
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
    hidden = 2 * reach(keys, np.inf)  # one side goes behind something, the other comes out
    known = fragments.whole >= _KNOWN
    vague = (fragments.whole == 0) | (fragments.novelties > 1)  # looks like anything
    found = []
    for i, after in enumerate(_successors(fragments, limit, settings)):
        within = np.where(fragments.cut[i, 1] & fragments.cut[after, 0], hidden[i], limit[i])
        distance = _distances(fragments, i, after, settings) / np.maximum(within, 1e-9)
        size = _contradiction(keys[i], keys[after], known[i], known[after])
        posterior = posterior_difference(
            fragments.posteriors[i : i + 1], fragments.posteriors[after]
        )[0]
        gap_s = (fragments.first_ns[after] - fragments.last_ns[i]) * 1e-9
        cost = distance + size / _SAME_SIZE + posterior + gap_s / (gap_s + 10)
        alike = (distance <= 1) & (size <= _SAME_SIZE)
        agreement = (1 - distance) * (1 - size / _SAME_SIZE) * ~(known[i] & known[after])
        similar = posterior <= _SAME_POSTERIOR + _TRUSTED * agreement
        alike &= vague[i] | vague[after] | similar
        found += [(float(c), i, int(j)) for c, j in zip(cost[alike], after[alike], strict=True)]
    return [(i, j) for _, i, j in sorted(found)]


def _contradiction(key: F8, others: F8, known: Bool, others_known: Bool) -> F8:
    """Return (k,) differences of a `size_key` to others (k, 3), as far as they contradict.

    An object whose size is not known may be larger than it was seen.
    """
    excess = key - others
    counts = np.where(excess > 0, others_known[:, None], known)
    return np.asarray((np.abs(excess) * counts).mean(axis=1))


def _successors(fragments: Fragments, limit: F8, settings: TrackingSettings) -> Iterator[I4]:
    """Yield, for each fragment, the later ones that start at its place or soon after its end."""
    if len(limit) == 0:
        return
    rests = np.isfinite(fragments.rest)
    starts = (fragments.start, np.where(rests, fragments.rest, fragments.start))
    ends = (fragments.end, np.where(rests, fragments.rest, fragments.end))
    trees = [cKDTree(places) for places in starts]
    order = np.argsort(fragments.first_ns, kind="stable")
    first = fragments.first_ns[order]
    window = int(settings.max_missed_s * 1e9)
    for i, end in enumerate(fragments.last_ns):
        # One by one: all of them together are lists of millions of numbers after some hours.
        places = [tree.query_ball_point(e[i], limit[i]) for tree in trees for e in ends]
        low, high = np.searchsorted(first, [end, end + window], side="right")
        for_place = np.unique(np.concatenate([np.array(p, np.int64) for p in places]))
        for_place = for_place[fragments.first_ns[for_place] > end]
        for_place = for_place[np.argsort(fragments.first_ns[for_place], kind="stable")]
        after = np.union1d(for_place[:_LOOKAHEAD], order[low:high][: 4 * _LOOKAHEAD])
        yield after[fragments.scenes[after] == fragments.scenes[i]]


def _distances(fragments: Fragments, i: int, after: I4, settings: TrackingSettings) -> F8:
    """Return how far the starts of ``after`` (k,) are from the end of fragment i, in metres.

    Where one stood still, that place counts as well: where it comes into view or goes out of it,
    only a part of it was seen. Over a short gap a moving object may have gone on: both ends are
    continued to the middle of the gap. The smallest distance counts.
    """
    ways = (
        fragments.start[after] - fragments.end[i],
        fragments.start[after] - fragments.rest[i],
        fragments.rest[after] - fragments.end[i],
        fragments.rest[after] - fragments.rest[i],
    )
    resting = np.min(np.nan_to_num(np.linalg.norm(ways, axis=2), nan=np.inf), axis=0)
    gap_s = (fragments.first_ns[after] - fragments.last_ns[i])[:, None] * 1e-9
    meeting = (fragments.start[after] - 0.5 * gap_s * fragments.start_velocity[after]) - (
        fragments.end[i] + 0.5 * gap_s * fragments.end_velocity[i]
    )
    moving = np.where(gap_s[:, 0] <= settings.max_missed_s, np.linalg.norm(meeting, axis=1), np.inf)
    return np.asarray(np.minimum(resting, moving))


def scene_cuts(hits: Hits, settings: TrackingSettings) -> Bool:
    """Return (k,) which frames of one stream show another scene than the frames before.

    Recordings made of single pictures put different objects at the same place from one frame to
    the next. Two frames speak for a cut when fewer than half of the objects that have any
    neighbour in the other frame are found again. A single odd frame is no cut: the frames on
    both sides of it must disagree too. Frames without detections say nothing. A clock that
    jumps back by more than ``max_missed_s`` is a cut as well.
    """
    stamps = hits.stamps_ns
    result = np.diff(stamps, prepend=stamps[:1]) < -settings.max_missed_s * 1e9
    filled = np.unique(hits.rows).tolist()
    for n in range(1, len(filled)):
        last, k = filled[n - 1], filled[n]
        slow = bool(stamps[k] - stamps[k - 1] > _SLOW_S * 1e9)
        if k - last > 1 and not slow:
            continue  # unseen for some frames, an object may have moved anywhere
        pairs = [(last, k)]
        if n + 1 < len(filled):
            pairs.append((last, filled[n + 1]))
        if n > 1 and not result[last]:
            pairs.append((filled[n - 2], k))
        result[k] |= not any(_continues(hits, i, j, slow=slow, settings=settings) for i, j in pairs)
    return np.asarray(result)


def _continues(hits: Hits, i: int, j: int, *, slow: bool, settings: TrackingSettings) -> bool:
    """Return whether frame j may show the scene of frame i: most objects there are the same.

    Where frames are ``slow`` to follow each other, a motion is no excuse for a distance.
    """
    a, b = hits.of_frame(i), hits.of_frame(j)
    distance = np.linalg.norm(hits.centers_of(a)[:, None] - hits.centers_of(b)[None], axis=2)
    near = distance < _NEIGHBOURHOOD_M
    comparable = min(int(near.any(axis=1).sum()), int(near.any(axis=0).sum()))
    if comparable == 0:
        return True
    keys_a, keys_b = size_key(hits.sizes[a]), size_key(hits.sizes[b])
    limit = 0.5 * reach(keys_a, settings.gate_m) if slow else np.full(len(keys_a), settings.gate_m)
    other = posterior_difference(hits.posteriors[a], hits.posteriors[b])
    same = (
        (distance <= limit[:, None])
        & (size_difference(keys_a, keys_b) <= _SAME_SIZE)
        & (other <= (_SAME_POSTERIOR if slow else 1.0))
    )
    found = min(int(same.any(axis=1).sum()), int(same.any(axis=0).sum()))
    return 2 * found >= comparable
