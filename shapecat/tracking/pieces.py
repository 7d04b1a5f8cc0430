"""Joining the tracks of one object that was split into pieces in some frames."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from shapecat.arrays import F8, I4, Bool
from shapecat.tracking.association import sorted_sides
from shapecat.tracking.detection_table import DetectionTable

__all__ = ["join_pieces"]

_NEAR_M = 0.35  # largest distance between the centres of pieces
_SLACK, _SLACK_M = 1.1, 0.01  # factor and length by which the pieces may exceed the whole object
_LACKING = 0.95  # along some axis, both pieces are shorter than this fraction of their joint box
_MOSTLY = 0.5  # fraction of the common frames in which two tracks must be pieces


def join_pieces(table: DetectionTable, tracks: Sequence[I4]) -> list[I4]:
    """Join tracks that are pieces of one object.

    The size of the whole object is known from frames in which it was not split. The box around two
    pieces is no larger than the whole object, but the box around two objects side by side is. Of
    two pieces in the same frame, the larger one stays in the track.

    Parameters
    ----------
    tracks : the indices (k,) of the detections of each track, ascending.

    Returns
    -------
    The detections (k,) of each object, ascending, in the order of their first track.
    """
    if len(tracks) < 2:
        return list(tracks)
    counts = _count_fits(table, tracks)
    root = np.arange(len(tracks))
    for (a, b), count in sorted((+counts).items(), key=lambda item: (-item[1], item[0])):
        common = np.intersect1d(table.rows[tracks[a]], table.rows[tracks[b]]).size
        if count > _MOSTLY * common:
            root[root == max(root[a], root[b])] = min(root[a], root[b])
    groups = [[tracks[k] for k in _where(root == r)] for r in np.unique(root)]
    return [_largest(table, np.concatenate(group)) for group in groups]


def _count_fits(table: DetectionTable, tracks: Sequence[I4]) -> Counter[tuple[int, int]]:
    """Count, for each pair of tracks, the frames in which they could be pieces of one object.

    ``tracks`` are the detections (n,) of each track. The keys are indices into it, the smaller
    first.
    """
    owner, counts = table.track_of_each(tracks), Counter[tuple[int, int]]()
    whole_lengths = np.array([_whole_lengths_by_topic(table, track) for track in tracks])
    for block in table.blocks():
        pairs = _neighbours(table, owner, block)
        track_pairs, which = np.unique(np.sort(owner[pairs], axis=1), axis=0, return_inverse=True)
        fits = _fit(table, pairs, whole_lengths[owner[pairs], table.topics[table.rows[pairs]]])
        fitting = np.bincount(which.ravel()[fits], minlength=len(track_pairs))
        counts.update(dict(zip(map(tuple, track_pairs.tolist()), fitting.tolist(), strict=True)))
    return counts


def _where(mask: Bool) -> list[int]:
    return [int(k) for k in np.flatnonzero(mask)]


def _whole_lengths_by_topic(table: DetectionTable, track: I4) -> F8:
    """Return `_whole_lengths` (topics, 3) of a track as seen by each topic, metres; 0 if unseen."""
    topics = table.topics[table.rows[track]]
    result = np.zeros((len(table.names), 3))
    for topic in _where(np.bincount(topics) > 0):
        result[topic] = _whole_lengths(table, track[topics == topic])
    return result


def _whole_lengths(table: DetectionTable, track: I4) -> F8:
    """Return the 75th percentile (3,) of `sorted_sides` of whole views; of all if none is whole."""
    uncut = track[~table.partial[track]]
    lengths = sorted_sides(table.sizes[track if len(uncut) == 0 else uncut])
    return np.asarray(np.quantile(lengths, 0.75, axis=0))


def _neighbours(table: DetectionTable, owner: I4, block: slice) -> I4:
    """Return the pairs (p, 2) of tracked detections in the same frame that are near each other.

    ``block`` selects the detections, ``owner`` (n,) is the track of each, negative if none.
    """
    tracked = block.start + np.flatnonzero(owner[block] >= 0)
    frames = 2 * _NEAR_M * table.rows[tracked]  # no detection is near one of another frame
    positions = np.column_stack([table.centers[tracked], frames])
    near = cKDTree(positions).query_pairs(_NEAR_M, output_type="ndarray")
    pairs = tracked[near]
    return np.asarray(pairs[np.lexsort(pairs.T)])


def _fit(table: DetectionTable, pairs: I4, whole_lengths: F8) -> Bool:
    """Return the mask (p,) of pairs of detections (p, 2) that are pieces of one object.

    ``whole_lengths`` (p, 2, 3) are the lengths of the whole object, estimated from each of the two
    tracks. The joint box of two pieces is no larger than the whole object, and neither piece fills
    it, as a bowl with an object in it would.
    """
    joint = np.minimum(_joint(table, pairs), _joint(table, pairs[:, ::-1]))
    lengths = sorted_sides(table.sizes[pairs.ravel()]).reshape(-1, 2, 3)
    room = whole_lengths * _SLACK + _SLACK_M
    lacking = np.any(lengths.max(axis=1) < _LACKING * joint, axis=1)
    fitting = np.all(joint[:, None] <= room, axis=2)
    return np.asarray(lacking & np.any(fitting, axis=1))


def _joint(table: DetectionTable, pairs: I4) -> F8:
    """Return the `sorted_sides` (p, 3) of a box around each pair, along the first box's axes."""
    i, j = pairs.T
    axes_i, axes_j = table.axes(i), table.axes(j)
    offset = np.einsum("pji,pj->pi", axes_i, table.centers[j] - table.centers[i])
    turned = np.abs(np.einsum("pji,pjk->pik", axes_i, axes_j))
    half_j = 0.5 * np.einsum("pik,pk->pi", turned, table.sizes[j])
    half_i = 0.5 * table.sizes[i].astype(np.float64)
    return sorted_sides(np.maximum(half_i, offset + half_j) - np.minimum(-half_i, offset - half_j))


def _largest(table: DetectionTable, track: I4) -> I4:
    """Return the largest of the detections ``track`` (n,) in each of their frames, (f,)."""
    volume = table.sizes[track].astype(np.float64).prod(axis=1)
    order = track[np.lexsort([-volume, table.rows[track]])]
    first = np.concatenate([[True], np.diff(table.rows[order]) > 0])
    return np.asarray(order[first])
