"""From the detections of a recording to its tracks, with the future known."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from heapq import merge

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.config import TrackingSettings
from shapecat.tracking.fusion import causal, view_weights
from shapecat.tracking.hindsight import Fragments, merge_fragments, scene_cuts
from shapecat.tracking.records import FrameDetections, Track
from shapecat.tracking.tracker import Tracker

__all__ = ["track_recording"]

_BURST_NS = 500_000_000
"""A track proves itself by its hits among the frames this near its first one."""

_SHADOW = 5  # a track this many times longer may have another one as its shadow
_LINE = 10  # detections at either end of a track that tell its motion


@dataclass(frozen=True)
class _Hits:
    """All detections of a stream, in columns: ``rows`` (n,) are positions in its frames."""

    frames: Sequence[FrameDetections]
    rows: I4
    numbers: I4
    centers: F8
    sizes: F8
    posteriors: F8
    partial: Bool
    novelties: F8

    def stamps(self, hits: I4) -> I4:
        """Return the times of some hits."""
        return np.array([self.frames[r].stamp_ns for r in self.rows[hits]], np.int64)


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
    cuts = scene_cuts(frames, settings)
    hits, scenes = _columns(frames), np.cumsum(cuts)
    fragments = [
        group
        for group in _groups(_associate(frames, cuts, settings))
        if len(group)
        and len(group) >= _needed(frames, scenes, int(hits.rows[group[0]]), settings.min_hits)
    ]
    chains = _groups(merge_fragments(_describe(hits, fragments, scenes), settings))
    members = [np.sort(np.concatenate([fragments[k] for k in c])) for c in chains if len(c)]
    return [_build_track(hits, member, settings) for member in _without_shadows(hits, members)]


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


def _columns(frames: Sequence[FrameDetections]) -> _Hits:
    filled = [frame for frame in frames if len(frame.centers)] or frames[:1]
    counts = [len(frame.centers) for frame in frames]
    return _Hits(
        frames,
        np.repeat(np.arange(len(frames)), counts),
        np.concatenate([frame.detections for frame in filled]),
        np.concatenate([frame.centers for frame in filled]),
        np.concatenate([frame.sizes for frame in filled]).astype(np.float64),
        np.concatenate([frame.posteriors for frame in filled]).astype(np.float64),
        np.concatenate([frame.partial for frame in filled]),
        np.concatenate([frame.novelties for frame in filled]).astype(np.float64),
    )


def _groups(labels: I4) -> list[I4]:
    """Return the positions of each label, ascending, by ascending label."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)


def _describe(hits: _Hits, fragments: Sequence[I4], scenes: I4) -> Fragments:
    """Summarise fragments: sizes by medians, which a few odd views do not move."""
    n = len(fragments)
    stamps = np.array([frame.stamp_ns for frame in hits.frames], np.int64)
    at = stamps[hits.rows]
    starts = [_line(at[f[:_LINE]], hits.centers[f[:_LINE]], 0) for f in fragments]
    ends = [_line(at[f[-_LINE:]], hits.centers[f[-_LINE:]], -1) for f in fragments]
    return Fragments(
        np.array([at[f[0]] for f in fragments], np.int64),
        np.array([at[f[-1]] for f in fragments], np.int64),
        np.reshape([place for place, _ in starts], (n, 3)),
        np.reshape([place for place, _ in ends], (n, 3)),
        np.reshape([velocity for _, velocity in starts], (n, 3)),
        np.reshape([velocity for _, velocity in ends], (n, 3)),
        np.reshape([np.median(hits.sizes[f], axis=0) for f in fragments], (n, 3)),
        np.reshape([hits.posteriors[f].mean(axis=0) for f in fragments], (n, -1 if n else 0)),
        np.array([scenes[hits.rows[f[0]]] for f in fragments], np.int32),
    )


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


def _without_shadows(hits: _Hits, members: Sequence[I4]) -> list[I4]:
    """Drop short tracks inside longer ones: pieces of an object that was split for a moment.

    No object has its centre in the inner half of another one's for all the time it is seen.
    """
    lengths = np.array([len(member) for member in members])
    first = np.array([hits.rows[member[0]] for member in members])
    last = np.array([hits.rows[member[-1]] for member in members])
    kept = []
    for member in members:
        low, high = hits.rows[member[0]], hits.rows[member[-1]]
        hosts = (_SHADOW * len(member) <= lengths) & (first <= high) & (last >= low)
        if not any(_inside(hits, member, members[k]) for k in np.flatnonzero(hosts).tolist()):
            kept.append(member)
    return kept


def _inside(hits: _Hits, member: I4, host: I4) -> bool:
    rows, seen = hits.rows[member], hits.rows[host]
    place = np.column_stack([np.interp(rows, seen, hits.centers[host, k]) for k in range(3)])
    radius = 0.6 * np.median(hits.sizes[host], axis=0).min()
    distance = np.linalg.norm(hits.centers[member] - place, axis=1)
    return bool(np.median(distance) <= radius)


def _build_track(hits: _Hits, member: I4, settings: TrackingSettings) -> Track:
    rows, source = _rows_with_gaps(hits, member, settings.max_missed_s)
    seen = hits.rows[member]
    sensors = {hits.frames[r].topic for r in seen}
    own = np.array([hits.frames[r].topic in sensors for r in rows])
    rows, source = rows[own], source[own]
    weights = view_weights(hits.partial[member])
    so_far = causal(hits.posteriors[member], settings.fusion, weights)
    stamps = np.array([hits.frames[r].stamp_ns for r in rows], np.int64)
    at = np.searchsorted(seen, rows, side="right") - 1  # the last detection up to each row
    return Track(
        0,
        tuple(hits.frames[r].topic for r in rows),
        len(member),
        np.array([hits.frames[r].frame for r in rows]),
        stamps,
        np.where(source, hits.numbers[member][at], -1),
        np.column_stack([np.interp(rows, seen, hits.centers[member, axis]) for axis in range(3)]),
        so_far[at],
        so_far[-1],
        float(so_far[-1].max()),
        float(np.average(hits.novelties[member], weights=weights)),
    )


def _rows_with_gaps(hits: _Hits, member: I4, max_gap_s: float) -> tuple[I4, Bool]:
    """Return the frames of a track, and in which of them it is detected."""
    seen = hits.rows[member]
    gap_s = np.diff(hits.stamps(member)) * 1e-9
    pieces = [
        np.arange(a, b if gap <= max_gap_s else a + 1)
        for a, b, gap in zip(seen[:-1], seen[1:], gap_s, strict=True)
    ]
    rows = np.concatenate([*pieces, seen[-1:]])
    return rows, np.isin(rows, seen)


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
