"""From the detections of a recording to its tracks, offline: later frames are known."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.config import TrackingSettings
from shapecat.tracking.common_motion import CommonMotion, find_common_motion
from shapecat.tracking.detection_table import DetectionTable
from shapecat.tracking.false_tracks import without_pieces
from shapecat.tracking.fusion import causal, fuse, fuse_novelty
from shapecat.tracking.pieces import join_pieces
from shapecat.tracking.records import Track
from shapecat.tracking.stitching import Fragments, merge_fragments, scene_cuts
from shapecat.tracking.tracker import Tracker

__all__ = ["track_recording"]

_BURST_NS = 500_000_000
"""Frames this near to a track's first one decide how many detections confirm it."""

_GAP_S, _GAP_FRAMES = 0.7, 5  # after a gap longer than both, a new fragment begins
_LINE = 10  # detections at either end of a track from which its motion is estimated


def track_recording(
    tables: Iterable[DetectionTable], settings: TrackingSettings
) -> Iterator[Track]:
    """Track the objects of a recording, stream by stream.

    Parameters
    ----------
    tables : the detections of each stream; frames without any are included. A stream is one topic,
        or several whose centres are in the same coordinate frame: an object seen by several of
        these sensors gets one track.

    Returns
    -------
    Confirmed tracks, made on demand, numbered from 1 in order of birth (time, then stream, then
    position). A track is confirmed by ``settings.min_hits`` detections, or by fewer if fewer frames
    of the same topic and scene lie within half a second of its first. So a recording of single
    images, one per second, keeps every detection. Detections without a confirmed track count as
    false.

    Notes
    -----
    Time and memory grow linearly with the number of detections, memory by some 100 bytes each.
    """
    streams = [_track_stream(table, settings) for table in tables]
    tracks = [(stream, track) for stream in streams for track in stream.tracks]
    tracks.sort(key=lambda item: item[0].born_ns(item[1]))  # stable: then stream, then birth
    return (_build_track(k, *item, settings) for k, item in enumerate(tracks, 1))


@dataclass(frozen=True)
class _TrackedStream:
    """A tracked stream: its detections, the detections of each track, and the common motion.

    If there is a common motion, it is removed from the detections.
    """

    table: DetectionTable
    tracks: list[I4]
    motion: CommonMotion | None

    def born_ns(self, track: I4) -> int:
        return int(self.table.stamps(track[:1])[0])


def _track_stream(table: DetectionTable, settings: TrackingSettings) -> _TrackedStream:
    """Track a stream; if its objects have a common motion, remove it and track again."""
    tracks = _follow(table, settings)
    motion = find_common_motion(table, tracks)
    if motion is not None:
        table = motion.stabilised(table)
        tracks = _follow(table, settings)
    return _TrackedStream(table.without_boxes(), tracks, motion)


def _follow(table: DetectionTable, settings: TrackingSettings) -> list[I4]:
    """Return the detections (k,) of each object of a stream, ascending."""
    cuts = scene_cuts(table, settings)
    scenes: I4 = np.cumsum(cuts, dtype=np.int64)
    fragments = [
        group
        for track in _groups(_associate(table, cuts, settings))
        for group in _without_gaps(table, track)
        if len(group)
        and len(group)
        >= _hits_to_confirm(table, scenes, int(table.rows[group[0]]), settings.min_hits)
    ]
    chains = _groups(merge_fragments(_describe(table, fragments, scenes), settings))
    tracks = [np.sort(np.concatenate([fragments[k] for k in c])) for c in chains if len(c)]
    return without_pieces(table, join_pieces(table, tracks), settings.max_missed_s)


def _associate(table: DetectionTable, cuts: Bool, settings: TrackingSettings) -> I4:
    """Return the tracker's track number of each detection, (n,).

    ``cuts`` (f,) marks the frames that begin a new scene.
    """
    tracker, ids = Tracker(settings), np.zeros(len(table.rows), np.int32)
    frames = zip(table.stamps_ns.tolist(), cuts.tolist(), strict=True)
    for row, (stamp_ns, cut) in enumerate(frames):
        if cut:
            tracker.reset()
        detections = table.of_frame(row)
        ids[detections] = tracker.step(
            stamp_ns,
            table.centers[detections],
            table.sizes[detections],
            table.posteriors[detections],
            partial=table.partial[detections],
            topic=int(table.topics[row]),
        )
    return ids


def _groups(labels: I4) -> list[I4]:
    """Return, for each label in ascending order, the ascending indices of its items, (k,)."""
    order = np.argsort(labels, kind="stable").astype(np.int32)
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)


def _without_gaps(table: DetectionTable, track: I4) -> list[I4]:
    """Split a track at long gaps; `merge_fragments` may join the parts again."""
    if len(track) == 0:
        return []
    gap_s, rows = np.diff(table.stamps(track)) * 1e-9, table.rows[track]
    frames = table.sees(track, np.arange(rows[0], rows[-1] + 1)).cumsum()
    long = (gap_s > _GAP_S) & (np.diff(frames[rows - rows[0]]) > _GAP_FRAMES)
    return np.split(track, np.flatnonzero(long) + 1)


def _describe(table: DetectionTable, fragments: Sequence[I4], scenes: I4) -> Fragments:
    """Summarise fragments of tracks; ``scenes`` (f,) is the scene of each frame."""
    n = len(fragments)
    starts = [_line(table, f[:_LINE], 0) for f in fragments]
    ends = [_line(table, f[-_LINE:], -1) for f in fragments]
    fused = [_fused(table, f) for f in fragments]
    return Fragments(
        first_ns=np.array([table.stamps(f[0]) for f in fragments], np.int64),
        last_ns=np.array([table.stamps(f[-1]) for f in fragments], np.int64),
        start=np.reshape([place for place, _ in starts], (n, 3)),
        end=np.reshape([place for place, _ in ends], (n, 3)),
        start_velocity=np.reshape([velocity for _, velocity in starts], (n, 3)),
        end_velocity=np.reshape([velocity for _, velocity in ends], (n, 3)),
        sizes=np.reshape([_extent(table, f) for f in fragments], (n, 3)),
        whole_views=np.array([np.sum(~table.partial[f]) for f in fragments], np.int32),
        cut=np.reshape([table.partial[f[[0, -1]]] for f in fragments], (n, 2)),
        posteriors=np.reshape([posterior for posterior, _ in fused], (n, -1 if n else 0)),
        novelties=np.array([novelty for _, novelty in fused]),
        scenes=np.array([scenes[table.rows[f[0]]] for f in fragments], np.int32),
    )


def _fused(table: DetectionTable, track: I4) -> tuple[F8, float]:
    """Return the fused posterior (c,) and novelty of detections of one object.

    Fragments are compared by the product of their views, whatever the setting ``fusion`` says.
    """
    weights = table.weights(track)
    posterior = fuse(table.posteriors[track], weights=weights)
    return posterior, fuse_novelty(table.novelties[track], weights)


def _extent(table: DetectionTable, track: I4) -> F8:
    """Return the median lengths (3,) of whole views, or else the largest ones of partial views."""
    complete = track[~table.partial[track]]
    if len(complete):
        return np.asarray(np.median(table.sizes[complete].astype(np.float64), axis=0))
    return np.asarray(table.sizes[track].max(axis=0))


def _line(table: DetectionTable, detections: I4, at: int) -> tuple[F8, F8]:
    """Fit a constant velocity to detections; return a position, metres, and the velocity, m/s.

    The position is the one at detection number ``at``, 0 or -1, of ``detections`` (n,). Both
    results are (3,). A prior for standing still keeps the velocity of a few noisy points small.
    """
    stamps, centers = table.stamps(detections), table.centers[detections]
    t = (stamps - stamps[at]) * 1e-9
    middle, mean = t.mean(), centers.mean(axis=0)
    velocity = (t - middle) @ (centers - mean) / (((t - middle) ** 2).sum() + 0.1)
    return mean - middle * velocity, velocity


def _hits_to_confirm(table: DetectionTable, scenes: I4, row: int, min_hits: int) -> int:
    """Return the number of detections that confirm a track born in frame ``row``.

    That is ``min_hits``, or the number of frames of the same topic and scene within `_BURST_NS` of
    this frame, if smaller. ``scenes`` (f,) numbers the scenes, the parts of the recording between
    cuts. Sensors of other topics may not see the object.
    """
    frames_near, stamps, topics = 1, table.stamps_ns, table.topics
    for direction in (1, -1):
        missing, k = min_hits - 1, row + direction
        while missing and 0 <= k < len(stamps) and scenes[k] == scenes[row]:
            if abs(stamps[k] - stamps[row]) > _BURST_NS:
                break
            same_topic = bool(topics[k] == topics[row])
            frames_near, missing, k = frames_near + same_topic, missing - same_topic, k + direction
    return min(min_hits, frames_near)


def _build_track(
    number: int, stream: _TrackedStream, track: I4, settings: TrackingSettings
) -> Track:
    """Return a `Track` with id ``number`` and the detections with the indices ``track`` (n,)."""
    table = stream.table
    rows, source = table.frame_span(track, settings.max_missed_s)
    views, weights = table.posteriors[track], table.weights(track)
    posterior = fuse(views, settings.fusion, weights)
    # The last detection up to each row.
    at = np.searchsorted(table.rows[track], rows, side="right") - 1
    places = table.positions(track, rows)
    return Track(
        id=number,
        topics=tuple(map(table.names.__getitem__, table.topics[rows].tolist())),
        hits=len(track),
        frames=table.frames[rows],
        stamps_ns=table.stamps_ns[rows],
        detections=np.where(source, table.numbers[track][at], -1),
        centers=places if stream.motion is None else stream.motion.unstabilised(rows, places),
        causal=causal(views, settings.fusion, weights)[at],
        posterior=posterior,
        confidence=float(posterior.max()),
        novelty=fuse_novelty(table.novelties[track], weights),
    )
