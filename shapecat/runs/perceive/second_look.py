"""Choose the frames to perceive again with the up direction of the whole recording.

If the sensor poses are known, all frames have the same up direction in the fixed frame. If not,
the camera is assumed to be at rest when the frames before and after a frame agree with each other;
their up direction is then used.
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.runs.tables.reading import (
    Key,
    frame_rows,
    numbers,
    numbers_or_nan,
    rows_of,
    topic_codes,
)

__all__ = ["Revision", "frames_to_revise"]

_OFF_DEG = 10.0
"""A frame is revised if its up direction is farther than this from the one expected for it."""
_AGREES_DEG = 5.0
"""A frame is not revised if its given up direction is nearer than this to the expected one."""
_STILL_SHARE = 0.6
"""The camera is at rest if more than this fraction of the nearby frames agree."""
_STILL_DEG = 3.0
"""Largest angle between the up directions of frames that agree and their median."""
_FIXED_SHARE = 0.5
"""Up is known in the fixed frame if more than this fraction of frames agree within `_OFF_DEG`."""
_AROUND = 30
"""Maximum number of nearby frames before a frame, and likewise after it."""
_AROUND_NS = 3_000_000_000
"""Maximum time between a frame and a nearby one."""
_FEWEST = 4
"""Minimum number of frames to compare a frame with; with fewer, it is not revised."""
_STILL_M = 0.03
"""The camera is at rest if the lowest planes of enough nearby frames differ less than this in
height from their median, metres."""
_OFF_M = 0.08
"""A frame lacks the usual support if all its planes differ more than this in height, metres."""


class Revision(NamedTuple):
    """The up direction to use for a frame, and the one that was given before.

    Both are unit vectors (3,) in the sensor frame; ``up_given`` is None if there was none.
    """

    up: F4
    up_given: F4 | None


class _Stream(NamedTuple):
    """The frames of a topic, in their order.

    Attributes
    ----------
    frames, stamps_ns : (n,) frame numbers on the topic, and stamps.
    up : (n, 3) up directions in the sensor frame.
    given : (n, 3) up directions from other sources than planes; NaN if there is none.
    rotation : (n, 3, 3) of ``fixed_from_sensor``; NaN if unknown.
    offsets : for each frame, the offsets (p,) of its planes along up, ascending, metres.
    """

    frames: I4
    stamps_ns: I4
    up: F8
    given: F8
    rotation: F8
    offsets: list[F4]

    @property
    def has_plane(self) -> Bool:
        """Whether each frame has a plane, (n,)."""
        return np.array([len(offsets) > 0 for offsets in self.offsets], np.bool_)


def frames_to_revise(tables: Iterable[tuple[pa.Table, pa.Table]]) -> dict[Key, Revision]:
    """Choose the frames without a plane, or with planes that disagree with other frames.

    Parameters
    ----------
    tables : pairs of frames and planes tables, segment by segment.

    Returns
    -------
    The better up direction for each of these frames, if one is known.

    Notes
    -----
    This keeps a few numbers per frame in memory.
    """
    revisions: dict[Key, Revision] = {}
    for topic, stream in _streams(tables).items():
        posed = np.isfinite(stream.rotation[:, 0, 0])
        expected = (
            _fixed_up(stream, posed) if 2 * posed.sum() > len(posed) else _up_of_neighbours(stream)
        )
        off = ~stream.has_plane | ~(_cosine(stream.up, expected) > _cos(_OFF_DEG))
        off |= ~posed & _lacks_usual_support(stream, off)
        agrees = _cosine(stream.given, expected) > _cos(_AGREES_DEG)
        for k in np.flatnonzero(np.isfinite(expected[:, 0]) & off & ~agrees):
            hint = stream.given[k].astype(np.float32) if np.isfinite(stream.given[k, 0]) else None
            key = (topic, int(stream.frames[k]))
            revisions[key] = Revision(expected[k].astype(np.float32), hint)
    return revisions


def _fixed_up(stream: _Stream, posed: Bool) -> F8:
    """Return, for each frame, the up direction (n, 3) on which most frames agree.

    ``posed`` (n,) is true for frames with a pose. The directions are compared in the fixed frame,
    and the result is in the sensor frame. It is NaN if the frames do not agree, and for frames
    without a pose.
    """
    in_fixed = np.einsum("nij,nj->ni", stream.rotation, stream.up)
    agreed = _agreed(in_fixed[posed & stream.has_plane], _OFF_DEG, _FIXED_SHARE)
    return np.asarray(np.einsum("nji,j->ni", stream.rotation, agreed))


def _up_of_neighbours(stream: _Stream) -> F8:
    """Return the up direction (n, 3), sensor frame, on which the frames around each frame agree.

    It is NaN where these are too few, or disagree, as when the camera moves.
    """
    has_plane, expected = stream.has_plane, np.full(stream.up.shape, np.nan)
    for k in range(len(expected)):
        neighbours = _around(stream, k)
        expected[k] = _agreed(
            stream.up[neighbours][has_plane[neighbours]], _STILL_DEG, _STILL_SHARE
        )
    return expected


def _around(stream: _Stream, k: int) -> I4:
    """Return the indices (m,) of the frames near frame ``k``, without ``k``."""
    rows = np.arange(max(0, k - _AROUND), min(len(stream.frames), k + _AROUND + 1))
    soon = np.abs(stream.stamps_ns[rows] - stream.stamps_ns[k]) <= _AROUND_NS
    return np.asarray(rows[soon & (rows != k)])


def _lacks_usual_support(stream: _Stream, off: Bool) -> Bool:
    """Return whether each frame (n,) has no plane at the height of its neighbours' lowest planes.

    The result is False where these disagree or are too few. ``off`` (n,) is true for frames to
    ignore; their result is False.
    """
    is_other = np.zeros(len(off), np.bool_)
    for k in np.flatnonzero(~off):
        neighbours = _around(stream, int(k))
        lowest = np.array([stream.offsets[m][0] for m in neighbours[~off[neighbours]]])
        if len(lowest) < _FEWEST:
            continue
        usual = np.median(lowest)
        still = np.mean(np.abs(lowest - usual) < _STILL_M) > _STILL_SHARE
        is_other[k] = still and np.min(np.abs(stream.offsets[k] - usual)) > _OFF_M
    return is_other


def _agreed(up: F8, within_deg: float, share: float) -> F8:
    """Return the unit vector (3,) on which more than ``share`` of the directions agree.

    ``up`` (n, 3) are the directions. Those less than ``within_deg`` from their median agree, and
    the result is their mean; NaN if too few agree, or n is less than `_FEWEST`.
    """
    if len(up) < _FEWEST:
        return np.full(3, np.nan)
    inliers = _cosine(up, np.median(up, axis=0)) > _cos(within_deg)
    if inliers.mean() <= share:
        return np.full(3, np.nan)
    mean = up[inliers].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _cosine(a: F8, b: F8) -> F8:
    """Return the cosines (n,) between directions ``a`` (n, 3) and ``b``, (n, 3) or (3,)."""
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray((a * b).sum(axis=-1) / np.maximum(lengths, 1e-9))


def _cos(degrees: float) -> float:
    return float(np.cos(np.radians(degrees)))


def _streams(tables: Iterable[tuple[pa.Table, pa.Table]]) -> dict[str, _Stream]:
    """Join the frames and planes tables of all segments into one stream per topic."""
    parts: dict[str, list[_Stream]] = {}
    for frames, planes in tables:
        for topic, part in _parts(frames, planes):
            parts.setdefault(topic, []).append(part)
    return {topic: _joined(of_topic) for topic, of_topic in parts.items()}


def _parts(frames: pa.Table, planes: pa.Table) -> Iterator[tuple[str, _Stream]]:
    """Yield the frames of each topic in a part of the tables."""
    topics, codes = topic_codes(frames)
    rows, offsets = frame_rows(planes), numbers(planes["offset"]).copy()
    index, stamps = numbers(frames["frame"]), numbers(frames["stamp_ns"])
    keys = list(rows_of(topics, codes, index))
    of_frame = [offsets[rows.get(key, slice(0, 0))] for key in keys]
    up, given, rotation = (
        numbers_or_nan(frames[name]).astype(np.float64)
        for name in ("up", "up_given", "fixed_rotation")
    )
    rotation = rotation.reshape(-1, 3, 3)
    for code, topic in enumerate(topics):
        of = np.flatnonzero(codes == code)
        chosen = [of_frame[k] for k in of]
        yield topic, _Stream(index[of], stamps[of], up[of], given[of], rotation[of], chosen)


def _joined(parts: list[_Stream]) -> _Stream:
    *arrays, offsets = zip(*parts, strict=True)
    frames, stamps, up, given, rotation = map(np.concatenate, arrays)
    return _Stream(frames, stamps, up, given, rotation, list(chain.from_iterable(offsets)))
