"""Removal of false tracks: pieces of objects that were split in some frames."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.tracking.hits import Hits

__all__ = ["without_pieces", "without_shadows"]

_SHADOW = 5  # a track is removed only inside one that has this many times as many hits
_COVERED = 0.5  # ratio of covered frames to hits above which a track is a piece


def without_shadows(hits: Hits, members: Sequence[I4]) -> list[I4]:
    """Remove short tracks near the centre of much longer ones: pieces of a briefly split object.

    A real object is rarely that close to another one's centre. ``members`` are the hits (k,) of
    each track, ascending.
    """
    lengths = np.array([len(member) for member in members])
    first = np.array([hits.rows[member[0]] for member in members])
    last = np.array([hits.rows[member[-1]] for member in members])
    radius = cache(lambda k: 0.6 * float(np.median(hits.sizes[members[k]], axis=0).min()))
    kept = []
    for member in members:
        low, high = hits.rows[member[0]], hits.rows[member[-1]]
        hosts = (_SHADOW * len(member) <= lengths) & (first <= high) & (last >= low)
        places = np.flatnonzero(hosts).tolist()
        if not any(_inside(hits, member, members[k], radius(k)) for k in places):
            kept.append(member)
    return kept


def _inside(hits: Hits, member: I4, host: I4, radius: float) -> bool:
    place = hits.places(host, hits.rows[member])
    distance = np.linalg.norm(hits.centers[member] - place, axis=1)
    return bool(np.median(distance) <= radius)


def without_pieces(hits: Hits, members: Sequence[I4], max_gap_s: float) -> list[I4]:
    """Remove tracks that are often a part of another object.

    If an object is split in some frames, the track of a piece lies, in the other frames, in the box
    of the whole object. An object that only stands near another one, or is hidden by it, has its
    centre outside that box. ``members`` are the hits (k,) of each track, ascending; gaps in a track
    that are longer than ``max_gap_s`` are not checked.
    """
    if hits.orientations is None:
        return list(members)
    owner = hits.owners(members)
    covered = [
        _covered(hits, member, max_gap_s) + _covered_beside(hits, k, members, owner)
        for k, member in enumerate(members)
    ]
    return [m for m, count in zip(members, covered, strict=True) if count <= _COVERED * len(m)]


def _covered(hits: Hits, member: I4, max_gap_s: float) -> int:
    """Count the frames between a track's hits in which it lies in another detection's box."""
    rows, seen = hits.life(member, max_gap_s)
    others, which = hits.at(rows[~seen])
    place = hits.places(member, rows[~seen])[which]
    return len(np.unique(which[_in_box(hits, others, place)]))


def _covered_beside(hits: Hits, k: int, members: Sequence[I4], owner: I4) -> int:
    """Count the frames before and after a track in which it lies in a neighbour's box.

    The track is assumed to move along with the neighbour. On either side, half as many frames are
    checked as the track has hits. One side alone does not count, as an object may be put into a
    bowl, or pushed against another object and merged with it from then on.
    """
    member, counts = members[k], list[int]()
    most = len(member) // 2
    for end, way in ((0, -1), (-1, 1)):
        beside, _ = hits.at(hits.rows[member[[end]]])
        found = [0]
        for hit in beside[(owner[beside] >= 0) & (owner[beside] != k)].tolist():
            host = hits.seen_with(member, members[owner[hit]])
            i = int(np.searchsorted(host, hit))
            then = host[max(i - most, 0) : i] if way < 0 else host[i + 1 : i + 1 + most]
            place = hits.centers[member[end]] + hits.centers[then] - hits.centers[hit]
            found.append(int(_in_box(hits, then, place).sum()))
        counts.append(max(found))
    return sum(counts) if all(counts) else 0


def _in_box(hits: Hits, which: I4, places: F8) -> Bool:
    """Return whether each position (n, 3) lies in the box of the hit ``which`` (n,): (n,) bool."""
    local = np.einsum("nji,nj->ni", hits.axes(which), places - hits.centers[which])
    return np.asarray((np.abs(local) <= 0.5 * hits.sizes[which]).all(axis=1))
