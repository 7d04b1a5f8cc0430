"""Removal of false tracks: pieces of objects that were split in some frames."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.tracking.detection_table import DetectionTable

__all__ = ["without_pieces"]

_COVERED = 0.5  # ratio of covered frames to detections above which a track is a piece


def without_pieces(table: DetectionTable, tracks: Sequence[I4], max_gap_s: float) -> list[I4]:
    """Return the tracks without those that are often a part of another object.

    If an object is split in some frames, the centre of a piece's track lies, in the other frames,
    in the box of the whole object. An object that only stands near another one, or is occluded by
    it, has its centre outside that box. ``tracks`` are the indices (k,) of the detections of each
    track, ascending; gaps in a track that are longer than ``max_gap_s`` are not checked.
    """
    owner = table.track_of_each(tracks)
    covered = [
        _covered(table, track, max_gap_s) + _covered_beside(table, k, tracks, owner)
        for k, track in enumerate(tracks)
    ]
    return [m for m, count in zip(tracks, covered, strict=True) if count <= _COVERED * len(m)]


def _covered(table: DetectionTable, track: I4, max_gap_s: float) -> int:
    """Count the frames in which a track has no detection, but another box contains its place.

    The place is interpolated; ``track`` (d,) are the track's detections. Gaps of more than
    ``max_gap_s`` are left out.
    """
    rows, detected = table.frame_span(track, max_gap_s)
    others, which = table.of_frames(rows[~detected])
    place = table.positions(track, rows[~detected])[which]
    return len(np.unique(which[_in_box(table, others, place)]))


def _covered_beside(table: DetectionTable, k: int, tracks: Sequence[I4], owner: I4) -> int:
    """Count the frames before and after track k in which a neighbour's box contains its centre.

    ``owner`` (n,) is the track of each detection in ``table``, negative if none. The track is
    assumed to move along with the neighbour. On either side, half as many frames are checked as the
    track has detections. One side alone does not count, as an object may be put into a bowl, or
    pushed against another object and merged with it from then on.
    """
    track, counts = tracks[k], list[int]()
    span = len(track) // 2
    for end, direction in ((0, -1), (-1, 1)):
        beside, _ = table.of_frames(table.rows[track[[end]]])
        covered = [0]
        for neighbour in beside[(owner[beside] >= 0) & (owner[beside] != k)].tolist():
            host = table.on_topics_of(track, tracks[owner[neighbour]])
            i = int(np.searchsorted(host, neighbour))
            window = host[max(i - span, 0) : i] if direction < 0 else host[i + 1 : i + 1 + span]
            place = table.centers[track[end]] + table.centers[window] - table.centers[neighbour]
            covered.append(int(_in_box(table, window, place).sum()))
        counts.append(max(covered))
    return sum(counts) if all(counts) else 0


def _in_box(table: DetectionTable, which: I4, places: F8) -> Bool:
    """Return whether positions (n, 3) lie in the boxes of detections ``which`` (n,): (n,) bool."""
    local = np.einsum("nji,nj->ni", table.axes(which), places - table.centers[which])
    return np.asarray((np.abs(local) <= 0.5 * table.sizes[which]).all(axis=1))
