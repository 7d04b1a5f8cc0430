"""From the detections of a recording to its tracks, with the future known."""

from collections.abc import Collection, Iterable, Sequence
from heapq import merge

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.config import TrackingSettings
from shapecat.tracking.common_motion import CommonMotion, find_common_motion
from shapecat.tracking.fusion import causal, fuse, fuse_novelty
from shapecat.tracking.hindsight import Fragments, merge_fragments, scene_cuts
from shapecat.tracking.hits import Hits
from shapecat.tracking.pieces import join_pieces
from shapecat.tracking.records import FrameDetections, Track
from shapecat.tracking.surplus import without_pieces, without_shadows
from shapecat.tracking.tracker import Tracker

__all__ = ["track_recording"]

_BURST_NS = 500_000_000
"""A track proves itself by its hits among the frames this near its first one."""

_STILL_M = 0.05  # a centre strays less while its object stands still
_GAP_S, _GAP_FRAMES = 0.7, 5  # unseen for longer, another detection begins a fragment
_LINE = 10  # detections at either end of a track that tell its motion


def track_recording(
    frames: Iterable[FrameDetections],
    settings: TrackingSettings,
    *,
    together: Collection[str] = (),
) -> tuple[Track, ...]:
    """Track the objects of a recording, stream by stream.

    Parameters
    ----------
    frames : all frames, also those without detections, each stream in its order of recording.
    together : topics whose centres are in one and the same frame: an object that several of
        these sensors see is one track.

    Returns
    -------
    Confirmed tracks, numbered from 1 in order of birth (time, then stream, then position). A
    track is confirmed by ``settings.min_hits`` detections, or by as many as there are frames of
    the same scene within half a second of its first; so a recording of single pictures, one per
    second, keeps every detection. Detections of no confirmed track are taken for false.

    Notes
    -----
    Time and memory grow linearly with the number of detections.
    """
    streams: dict[str, list[FrameDetections]] = {}
    for frame in frames:
        streams.setdefault("" if frame.topic in together else frame.topic, []).append(frame)
    if len(together) > 1 and "" in streams:
        streams[""] = _interleaved(streams[""])
    found = [track for stream in streams.values() for track in _track_stream(stream, settings)]
    found.sort(key=lambda track: int(track.stamps_ns[0]))  # stable: then stream, then birth
    return tuple(_renumbered(track, k + 1) for k, track in enumerate(found))


def _interleaved(frames: Iterable[FrameDetections]) -> list[FrameDetections]:
    """Merge streams by time, each kept in its order of recording."""
    streams: dict[str, list[FrameDetections]] = {}
    for frame in frames:
        streams.setdefault(frame.topic, []).append(frame)
    return list(merge(*streams.values(), key=lambda frame: frame.stamp_ns))


def _track_stream(frames: Sequence[FrameDetections], settings: TrackingSettings) -> list[Track]:
    """Track a stream; where its objects move as one, as if they stood still."""
    hits, members = _follow(frames, settings)
    motion = find_common_motion(hits, members)
    if motion is not None:
        hits, members = _follow(motion.still(frames), settings)
    return [_build_track(hits, member, settings, motion) for member in members]


def _follow(frames: Sequence[FrameDetections], settings: TrackingSettings) -> tuple[Hits, list[I4]]:
    """Return all detections of a stream, and which of them are of the same object."""
    cuts = scene_cuts(frames, settings)
    hits, scenes = Hits.of(frames), np.cumsum(cuts)
    fragments = [
        group
        for track in _groups(_associate(frames, cuts, settings))
        for group in _without_gaps(hits, track)
        if len(group)
        and len(group) >= _needed(frames, scenes, int(hits.rows[group[0]]), settings.min_hits)
    ]
    chains = _groups(merge_fragments(_describe(hits, fragments, scenes), settings))
    members = [np.sort(np.concatenate([fragments[k] for k in c])) for c in chains if len(c)]
    members = join_pieces(hits, members)
    return hits, without_pieces(hits, without_shadows(hits, members), settings.max_missed_s)


def _associate(frames: Sequence[FrameDetections], cuts: Bool, settings: TrackingSettings) -> I4:
    """Return the tracker's number of every detection, frame after frame."""
    tracker, ids = Tracker(settings), [np.zeros(0, np.int32)]
    for frame, cut in zip(frames, cuts, strict=True):
        if cut:
            tracker.reset()
        ids.append(
            tracker.step(
                frame.stamp_ns, frame.centers, frame.sizes, frame.posteriors, partial=frame.partial
            )
        )
    return np.concatenate(ids)


def _groups(labels: I4) -> list[I4]:
    """Return the positions of each label, ascending, by ascending label."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)


def _without_gaps(hits: Hits, track: I4) -> list[I4]:
    """Split a track at long gaps; hindsight joins the parts again."""
    if len(track) == 0:
        return []
    gap_s = np.diff(hits.stamps(track)) * 1e-9
    long = (gap_s > _GAP_S) & (np.diff(hits.rows[track]) > _GAP_FRAMES)
    return np.split(track, np.flatnonzero(long) + 1)


def _describe(hits: Hits, fragments: Sequence[I4], scenes: I4) -> Fragments:
    """Summarise fragments: sizes by medians, which a few odd views do not move."""
    n = len(fragments)
    stamps = np.array([frame.stamp_ns for frame in hits.frames], np.int64)
    at = stamps[hits.rows]
    starts = [_line(at[f[:_LINE]], hits.centers[f[:_LINE]], 0) for f in fragments]
    ends = [_line(at[f[-_LINE:]], hits.centers[f[-_LINE:]], -1) for f in fragments]
    views = [(f, hits.weights(f)) for f in fragments]
    return Fragments(
        np.array([at[f[0]] for f in fragments], np.int64),
        np.array([at[f[-1]] for f in fragments], np.int64),
        np.reshape([place for place, _ in starts], (n, 3)),
        np.reshape([place for place, _ in ends], (n, 3)),
        np.reshape([velocity for _, velocity in starts], (n, 3)),
        np.reshape([velocity for _, velocity in ends], (n, 3)),
        np.reshape([_extent(hits, f) for f in fragments], (n, 3)),
        np.array([np.sum(~hits.partial[f]) for f in fragments], np.int32),
        np.reshape([_rest(hits, f) for f in fragments], (n, 3)),
        np.reshape([hits.partial[f[[0, -1]]] for f in fragments], (n, 2)),
        np.reshape([fuse(hits.posteriors[f], weights=w) for f, w in views], (n, -1 if n else 0)),
        np.array([fuse_novelty(hits.novelties[f], w) for f, w in views]),
        np.array([scenes[hits.rows[f[0]]] for f in fragments], np.int32),
    )


def _extent(hits: Hits, member: I4) -> F8:
    """Return the typical lengths of the whole views, or else the largest ones of the cut views."""
    whole = member[~hits.partial[member]]
    if len(whole):
        return np.asarray(np.median(hits.sizes[whole], axis=0))
    return np.asarray(hits.sizes[member].max(axis=0))


def _rest(hits: Hits, member: I4) -> F8:
    """Return where the whole views are if they are in one place, else nan."""
    whole = hits.centers[member[~hits.partial[member]]]
    if (
        len(whole) < _LINE
        or np.ptp(np.quantile(whole, [0.1, 0.9], axis=0), axis=0).max() > _STILL_M
    ):
        return np.full(3, np.nan)
    return np.asarray(np.median(whole, axis=0))


def _line(stamps: I4, centers: F8, at: int) -> tuple[F8, F8]:
    """Fit a uniform motion; return the place at one of the stamps, and the velocity in m/s.

    A prior of standing still keeps the velocity of a few noisy points small.
    """
    t = (stamps - stamps[at]) * 1e-9
    middle, mean = t.mean(), centers.mean(axis=0)
    velocity = (t - middle) @ (centers - mean) / (((t - middle) ** 2).sum() + 0.1)
    return mean - middle * velocity, velocity


def _needed(frames: Sequence[FrameDetections], scenes: I4, row: int, min_hits: int) -> int:
    """Return how many detections confirm a track that was born in frame ``row``."""
    near = 1
    for direction in (1, -1):
        for k in range(row + direction, row + direction * min_hits, direction):
            if not (0 <= k < len(frames)) or scenes[k] != scenes[row]:
                break
            near += abs(frames[k].stamp_ns - frames[row].stamp_ns) <= _BURST_NS
    return min(min_hits, near)


def _build_track(
    hits: Hits, member: I4, settings: TrackingSettings, motion: CommonMotion | None
) -> Track:
    rows, source = hits.life(member, settings.max_missed_s)
    seen = hits.rows[member]
    weights = hits.weights(member)
    so_far = causal(hits.posteriors[member], settings.fusion, weights)
    stamps = np.array([hits.frames[r].stamp_ns for r in rows], np.int64)
    at = np.searchsorted(seen, rows, side="right") - 1  # the last detection up to each row
    places = hits.places(member, rows)
    return Track(
        0,
        tuple(hits.frames[r].topic for r in rows),
        len(member),
        np.array([hits.frames[r].frame for r in rows]),
        stamps,
        np.where(source, hits.numbers[member][at], -1),
        places if motion is None else motion.moved(rows, places),
        so_far[at],
        so_far[-1],
        float(so_far[-1].max()),
        fuse_novelty(hits.novelties[member], weights),
    )


def _renumbered(track: Track, number: int) -> Track:
    return Track(
        number,
        track.topics,
        track.hits,
        track.frames,
        track.stamps_ns,
        track.detections,
        track.centers,
        track.causal,
        track.posterior,
        track.confidence,
        track.novelty,
    )
