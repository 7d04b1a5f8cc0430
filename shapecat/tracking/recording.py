"""From the detections of a recording to its tracks, offline: later frames are known."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.config import TrackingSettings
from shapecat.tracking.common_motion import CommonMotion, find_common_motion
from shapecat.tracking.fusion import causal, fuse, fuse_novelty
from shapecat.tracking.hindsight import Fragments, merge_fragments, scene_cuts
from shapecat.tracking.hits import Hits, gather
from shapecat.tracking.pieces import join_pieces
from shapecat.tracking.records import FrameDetections, Track
from shapecat.tracking.surplus import without_pieces, without_shadows
from shapecat.tracking.tracker import Tracker

__all__ = ["track_recording"]

_BURST_NS = 500_000_000
"""Frames this near to a track's first one decide how many hits confirm it."""

_STILL_M = 0.05  # a track's centres spread less than this while its object stands still
_GAP_S, _GAP_FRAMES = 0.7, 5  # after a longer gap, the next detection begins a new fragment
_LINE = 10  # detections at either end of a track from which its motion is estimated


def track_recording(
    frames: Iterable[FrameDetections],
    settings: TrackingSettings,
    *,
    together: Collection[str] = (),
) -> Iterator[Track]:
    """Track the objects of a recording, stream by stream.

    Parameters
    ----------
    frames : all frames, including those without detections, each stream in recording order.
    together : topics whose centres are in the same coordinate frame; an object seen by several of
        these sensors gets one track.

    Returns
    -------
    Confirmed tracks, made on demand, numbered from 1 in order of birth (time, then stream, then
    position). A track is confirmed by ``settings.min_hits`` detections, or by fewer if fewer frames
    of the same scene lie within half a second of its first. So a recording of single images, one
    per second, keeps every detection. Detections without a confirmed track count as false.

    Notes
    -----
    Time and memory grow linearly with the number of detections, memory by some 100 bytes each.
    """
    streams = [_track_stream(hits, settings) for hits in gather(frames, together)]
    found = [(stream, member) for stream in streams for member in stream.members]
    found.sort(key=lambda item: item[0].born_ns(item[1]))  # stable: then stream, then birth
    return (_build_track(k, *item, settings) for k, item in enumerate(found, 1))


@dataclass(frozen=True)
class _Followed:
    """A tracked stream: its hits, without the common motion if there is one, and its tracks."""

    hits: Hits
    members: list[I4]
    motion: CommonMotion | None

    def born_ns(self, member: I4) -> int:
        return int(self.hits.stamps(member[:1])[0])


def _track_stream(hits: Hits, settings: TrackingSettings) -> _Followed:
    """Track a stream; if its objects have a common motion, remove it and track again."""
    members = _follow(hits, settings)
    motion = find_common_motion(hits, members)
    if motion is not None:
        hits = motion.still(hits)
        members = _follow(hits, settings)
    return _Followed(hits.without_boxes(), members, motion)


def _follow(hits: Hits, settings: TrackingSettings) -> list[I4]:
    """Return the hits (k,) of each object of a stream, ascending."""
    cuts = scene_cuts(hits, settings)
    scenes = np.cumsum(cuts)
    fragments = [
        group
        for track in _groups(_associate(hits, cuts, settings))
        for group in _without_gaps(hits, track)
        if len(group)
        and len(group) >= _needed(hits, scenes, int(hits.rows[group[0]]), settings.min_hits)
    ]
    chains = _groups(merge_fragments(_describe(hits, fragments, scenes), settings))
    members = [np.sort(np.concatenate([fragments[k] for k in c])) for c in chains if len(c)]
    members = join_pieces(hits, members)
    return without_pieces(hits, without_shadows(hits, members), settings.max_missed_s)


def _associate(hits: Hits, cuts: Bool, settings: TrackingSettings) -> I4:
    """Return the tracker's track number of each hit, (n,)."""
    tracker, ids = Tracker(settings), np.zeros(len(hits.rows), np.int32)
    for row, (stamp_ns, cut) in enumerate(zip(hits.stamps_ns.tolist(), cuts.tolist(), strict=True)):
        if cut:
            tracker.reset()
        here = hits.of_frame(row)
        ids[here] = tracker.step(
            stamp_ns,
            hits.centers[here],
            hits.sizes[here],
            hits.posteriors[here],
            partial=hits.partial[here],
        )
    return ids


def _groups(labels: I4) -> list[I4]:
    """Return the indices of each label, ascending; labels in ascending order."""
    order = np.argsort(labels, kind="stable").astype(np.int32)
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)


def _without_gaps(hits: Hits, track: I4) -> list[I4]:
    """Split a track at long gaps; `merge_fragments` may join the parts again."""
    if len(track) == 0:
        return []
    gap_s = np.diff(hits.stamps(track)) * 1e-9
    long = (gap_s > _GAP_S) & (np.diff(hits.rows[track]) > _GAP_FRAMES)
    return np.split(track, np.flatnonzero(long) + 1)


def _describe(hits: Hits, fragments: Sequence[I4], scenes: I4) -> Fragments:
    """Summarise fragments, given by their hits; ``scenes`` (f,) is the scene of each frame."""
    n = len(fragments)
    starts = [_line(hits, f[:_LINE], 0) for f in fragments]
    ends = [_line(hits, f[-_LINE:], -1) for f in fragments]
    fused = [_fused(hits, f) for f in fragments]
    return Fragments(
        first_ns=np.array([hits.stamps(f[0]) for f in fragments], np.int64),
        last_ns=np.array([hits.stamps(f[-1]) for f in fragments], np.int64),
        start=np.reshape([place for place, _ in starts], (n, 3)),
        end=np.reshape([place for place, _ in ends], (n, 3)),
        start_velocity=np.reshape([velocity for _, velocity in starts], (n, 3)),
        end_velocity=np.reshape([velocity for _, velocity in ends], (n, 3)),
        sizes=np.reshape([_extent(hits, f) for f in fragments], (n, 3)),
        whole=np.array([np.sum(~hits.partial[f]) for f in fragments], np.int32),
        rest=np.reshape([_rest(hits, f) for f in fragments], (n, 3)),
        cut=np.reshape([hits.partial[f[[0, -1]]] for f in fragments], (n, 2)),
        posteriors=np.reshape([posterior for posterior, _ in fused], (n, -1 if n else 0)),
        novelties=np.array([novelty for _, novelty in fused]),
        scenes=np.array([scenes[hits.rows[f[0]]] for f in fragments], np.int32),
    )


def _fused(hits: Hits, member: I4) -> tuple[F8, float]:
    """Return the fused posterior (c,) and novelty of hits of one object.

    Fragments are compared by the product of their views, whatever the fusion of the settings.
    """
    weights = hits.weights(member)
    posterior = fuse(hits.posteriors[member], weights=weights)
    return posterior, fuse_novelty(hits.novelties[member], weights)


def _extent(hits: Hits, member: I4) -> F8:
    """Return the median lengths (3,) of whole views, or else the largest ones of partial views."""
    whole = member[~hits.partial[member]]
    if len(whole):
        return np.asarray(np.median(hits.sizes[whole].astype(np.float64), axis=0))
    return np.asarray(hits.sizes[member].max(axis=0))


def _rest(hits: Hits, member: I4) -> F8:
    """Return the median position (3,) of the whole views; NaN if they move or are too few."""
    whole = hits.centers[member[~hits.partial[member]]]
    if (
        len(whole) < _LINE
        or np.ptp(np.quantile(whole, [0.1, 0.9], axis=0), axis=0).max() > _STILL_M
    ):
        return np.full(3, np.nan)
    return np.asarray(np.median(whole, axis=0))


def _line(hits: Hits, some: I4, at: int) -> tuple[F8, F8]:
    """Fit a constant velocity to hits; return position (metres) at hit ``at`` and velocity (m/s).

    A prior for standing still keeps the velocity of a few noisy points small.
    """
    stamps, centers = hits.stamps(some), hits.centers[some]
    t = (stamps - stamps[at]) * 1e-9
    middle, mean = t.mean(), centers.mean(axis=0)
    velocity = (t - middle) @ (centers - mean) / (((t - middle) ** 2).sum() + 0.1)
    return mean - middle * velocity, velocity


def _needed(hits: Hits, scenes: I4, row: int, min_hits: int) -> int:
    """Return the number of hits that confirm a track born in frame ``row``.

    Frames of other topics do not count, as their sensors may not see the object.
    """
    near, stamps, topics = 1, hits.stamps_ns, hits.topics
    for direction in (1, -1):
        left, k = min_hits - 1, row + direction
        while left and 0 <= k < len(stamps) and scenes[k] == scenes[row]:
            if abs(stamps[k] - stamps[row]) > _BURST_NS:
                break
            own = bool(topics[k] == topics[row])
            near, left, k = near + own, left - own, k + direction
    return min(min_hits, near)


def _build_track(number: int, stream: _Followed, member: I4, settings: TrackingSettings) -> Track:
    hits = stream.hits
    rows, source = hits.life(member, settings.max_missed_s)
    views, weights = hits.posteriors[member], hits.weights(member)
    posterior = fuse(views, settings.fusion, weights)
    # The last hit up to each row.
    at = np.searchsorted(hits.rows[member], rows, side="right") - 1
    places = hits.places(member, rows)
    return Track(
        id=number,
        topics=tuple(map(hits.names.__getitem__, hits.topics[rows].tolist())),
        hits=len(member),
        frames=hits.frames[rows],
        stamps_ns=hits.stamps_ns[rows],
        detections=np.where(source, hits.numbers[member][at], -1),
        centers=places if stream.motion is None else stream.motion.moved(rows, places),
        causal=causal(views, settings.fusion, weights)[at],
        posterior=posterior,
        confidence=float(posterior.max()),
        novelty=fuse_novelty(hits.novelties[member], weights),
    )
