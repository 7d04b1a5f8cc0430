"""Joining the tracks of one object that was split into pieces in some frames."""

from collections import Counter
from collections.abc import Sequence
from functools import cache, partial

import numpy as np
from scipy.spatial import cKDTree

from shapecat.arrays import F8, I4, Bool
from shapecat.tracking.association import sorted_sides
from shapecat.tracking.hits import Hits

__all__ = ["join_pieces"]

_NEAR_M = 0.35  # largest distance between the centres of pieces
_SLACK, _SLACK_M = 1.1, 0.01  # factor and length by which the pieces may exceed the whole object
_LACKING = 0.95  # some length of a piece is less than this fraction of the whole object's
_MOSTLY = 0.34  # fraction of the common frames in which two tracks must be pieces
_PASSING = 0.25  # largest overlap in time of two tracks while an object passes an occluder
_CHANGING = 0.5  # the same, if one detection sometimes covers both sides of the occluder


def join_pieces(hits: Hits, members: Sequence[I4]) -> list[I4]:
    """Join tracks that are pieces of one object.

    The size of the whole object is known from frames in which it was not split. The box around two
    pieces is no larger than that; the box around two objects side by side is. Of two pieces in the
    same frame, the larger one stays in the track.

    An object that moves behind a narrow occluder appears on one side before it has disappeared on
    the other, so that one track ends soon after the other one began. In both tracks only a part of
    the object was visible, so the shorter side of the whole object may be as long as its longer
    side. If one detection sometimes covered both sides of the occluder, the size of this detection
    counts.

    Parameters
    ----------
    members : hits of each track, ascending.

    Returns
    -------
    The hits (k,) of each object, ascending, in the order of their first track.
    """
    if hits.orientations is None or len(members) < 2:
        return list(members)
    counts = _count_fits(hits, members)
    root = np.arange(len(members))
    for (a, b), count in sorted((+counts).items(), key=lambda item: (-item[1], item[0])):
        common = np.intersect1d(hits.rows[members[a]], hits.rows[members[b]]).size
        if count > _MOSTLY * common:
            root[root == max(root[a], root[b])] = min(root[a], root[b])
    groups = [[members[k] for k in _where(root == r)] for r in np.unique(root)]
    return [_largest(hits, np.concatenate(group)) for group in groups]


def _count_fits(hits: Hits, members: Sequence[I4]) -> Counter[tuple[int, int]]:
    """Return the number of frames in which two tracks are pieces of one object, for each pair."""
    owner, counts = hits.owners(members), Counter[tuple[int, int]]()
    rooms = _Rooms(hits, members)
    for block in hits.blocks():
        pairs = _neighbours(hits, owner, block)
        duos, which = np.unique(np.sort(owner[pairs], axis=1), axis=0, return_inverse=True)
        fits = _fit(hits, pairs, rooms.of(pairs, owner, duos, which.ravel()))
        fitting = np.bincount(which.ravel()[fits], minlength=len(duos))
        counts.update(dict(zip(map(tuple, duos.tolist()), fitting.tolist(), strict=True)))
    return counts


class _Rooms:
    """Sizes of the whole object that two pieces may belong to."""

    def __init__(self, hits: Hits, members: Sequence[I4]) -> None:
        self._hits, self._members = hits, members
        self._wholes = np.array([_wholes(hits, member) for member in members])
        # A cached method would make a reference cycle, which could keep gigabytes of hits alive.
        self._in_one = cache(partial(_seen_in_one, hits, members))

    def of(self, pairs: I4, owner: I4, duos: I4, which: I4) -> F8:
        """Return the lengths (p, 2, 3) of the whole object from either track, metres.

        ``pairs`` (p, 2) are pairs of hits, ``duos`` (q, 2) the pairs of tracks, and ``which`` (p,)
        the position of each pair's tracks in ``duos``.
        """
        hits = self._hits
        rooms = self._wholes[owner[pairs], hits.topics[hits.rows[pairs]]]
        share = _changes(hits, self._members, duos)
        passing = (share <= _PASSING)[which] & hits.partial[pairs].all(axis=1)
        rooms[passing, :, 1] = rooms[passing, :, 0]
        for k in _where(share <= _CHANGING):
            rooms[which == k] = np.maximum(rooms[which == k], self._in_one(*duos[k].tolist()))
        return np.asarray(rooms)


def _seen_in_one(hits: Hits, members: Sequence[I4], a: int, b: int) -> F8:
    """Return the largest lengths (3,) of hits where only one of two tracks has a hit, metres.

    Only frames while both tracks last count; 0 if there are none.
    """
    both = np.concatenate([members[a], members[b]])
    start = max(hits.rows[members[k][0]] for k in (a, b))
    stop = min(hits.rows[members[k][-1]] for k in (a, b))
    rows, at, counts = np.unique(hits.rows[both], return_index=True, return_counts=True)
    alone = both[at[(counts == 1) & (rows > start) & (rows < stop)]]
    return np.asarray(sorted_sides(hits.sizes[alone]).max(axis=0, initial=0))


def _where(mask: Bool) -> list[int]:
    return [int(k) for k in np.flatnonzero(mask)]


def _wholes(hits: Hits, member: I4) -> F8:
    """Return the whole object's lengths (topics, 3) as seen by each topic, metres; 0 if unseen."""
    topics = hits.topics[hits.rows[member]]
    result = np.zeros((len(hits.names), 3))
    for topic in _where(np.bincount(topics) > 0):
        result[topic] = _whole(hits, member[topics == topic])
    return result


def _whole(hits: Hits, member: I4) -> F8:
    """Return the 75th percentile (3,) of the lengths of whole views, or of all if none is whole."""
    uncut = member[~hits.partial[member]]
    lengths = sorted_sides(hits.sizes[member if len(uncut) == 0 else uncut])
    return np.asarray(np.quantile(lengths, 0.75, axis=0))


def _neighbours(hits: Hits, owner: I4, block: slice) -> I4:
    """Return the pairs (p, 2) of tracked hits in the same frame that are near each other."""
    tracked = block.start + np.flatnonzero(owner[block] >= 0)
    places = np.column_stack([hits.centers[tracked], hits.rows[tracked]])
    found = cKDTree(places).query_pairs(_NEAR_M, output_type="ndarray")
    pairs = tracked[found]
    return np.asarray(pairs[np.lexsort(pairs.T)])


def _changes(hits: Hits, members: Sequence[I4], duos: I4) -> F8:
    """Return the overlap in time (q,) of pairs of tracks (q, 2), relative to the shorter track.

    It is inf if one track lies within the other.
    """
    first = np.array([hits.rows[member[0]] for member in members])[duos]
    last = np.array([hits.rows[member[-1]] for member in members])[duos]
    share = (last.min(axis=1) - first.max(axis=1) + 1) / (last - first + 1).min(axis=1)
    within = np.argmin(first, axis=1) != np.argmin(last, axis=1)
    return np.where(within, np.inf, share)


def _fit(hits: Hits, pairs: I4, wholes: F8) -> Bool:
    """Return the mask (p,) of pairs of hits (p, 2) that are pieces of one object.

    ``wholes`` (p, 2, 3) are the lengths of the whole object from either track. The joint box of two
    pieces is no larger than the whole object, and neither piece is as large as the whole object, as
    a bowl with an object in it would be.
    """
    joint = np.minimum(_joint(hits, pairs), _joint(hits, pairs[:, ::-1]))
    lengths = sorted_sides(hits.sizes[pairs.ravel()]).reshape(-1, 2, 3)
    room = wholes * _SLACK + _SLACK_M
    lacking = np.any(lengths.max(axis=1)[:, None] < _LACKING * wholes, axis=2)
    fitting = np.all(joint[:, None] <= room, axis=2)
    return np.asarray(np.any(fitting & lacking, axis=1))


def _joint(hits: Hits, pairs: I4) -> F8:
    """Return the lengths (p, 3) of the box around each pair, along the first box's axes, metres."""
    i, j = pairs.T
    own_axes, others = hits.axes(i), hits.axes(j)
    offset = np.einsum("pji,pj->pi", own_axes, hits.centers[j] - hits.centers[i])
    turned = np.abs(np.einsum("pji,pjk->pik", own_axes, others))
    reach = 0.5 * np.einsum("pik,pk->pi", turned, hits.sizes[j])
    own = 0.5 * hits.sizes[i].astype(np.float64)
    return sorted_sides(np.maximum(own, offset + reach) - np.minimum(-own, offset - reach))


def _largest(hits: Hits, member: I4) -> I4:
    """Return the largest hit of each frame."""
    volume = hits.sizes[member].astype(np.float64).prod(axis=1)
    order = member[np.lexsort([-volume, hits.rows[member]])]
    first = np.concatenate([[True], np.diff(hits.rows[order]) > 0])
    return np.asarray(order[first])
