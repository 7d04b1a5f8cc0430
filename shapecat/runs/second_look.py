"""Choose the frames to revise, with the up direction of the whole recording.

Where the sensor's poses are known, up is one direction of the fixed frame in all frames. Where
they are not, but the frames before and after agree, the camera was still, and up is theirs.
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.runs.tables import Key, frame_rows, numbers, rows_of, topic_codes

__all__ = ["COLUMNS", "Revision", "frames_to_revise"]

COLUMNS = {
    "frames": ("topic", "frame", "stamp_ns", "up", "up_given", "fixed_rotation"),
    "planes": ("topic", "frame", "offset"),
}
"""What is read of the tables."""

_OFF_DEG = 10.0
"""A frame disagrees whose up is so far off the recording's."""
_AGREES_DEG = 5.0
"""A frame that was given an up so near the recording's would be seen the same again."""
_STILL_DEG, _STILL_SHARE = 3.0, 0.6
"""The camera is still if so many of the frames around agree so well."""
_FIXED_SHARE = 0.5
"""The fixed frame has an up if more of the frames agree than not, to `_OFF_DEG`."""
_AROUND, _AROUND_NS = 30, 3_000_000_000
"""Frames before and after, and nanoseconds, over which a camera may be known to be still."""
_FEWEST = 4
"""Frames that have to agree."""
_STILL_M, _OFF_M = 0.03, 0.08
"""A still camera keeps its height above the support; a support so far from it is another one."""


class Revision(NamedTuple):
    """The revision of a frame: the up to use, and the up it was given before.

    Both are unit vectors (3,) in the sensor frame; the second is None if there was none.
    """

    up: F4
    up_given: F4 | None


class _Stream(NamedTuple):
    """The frames of a topic, in their order.

    ``up`` and ``given`` (n, 3) are in the sensor frame, ``given`` NaN where nothing was;
    ``rotation`` (n, 3, 3) is of ``fixed_from_sensor``, NaN where it is not known; ``offsets`` of
    each frame's planes along its up, in metres.
    """

    frames: I4
    stamps_ns: I4
    up: F8
    given: F8
    rotation: F8
    offsets: list[F4]

    @property
    def level(self) -> Bool:
        """Whether a plane was found, per frame."""
        return np.array([len(offsets) > 0 for offsets in self.offsets], np.bool_)


def frames_to_revise(tables: Iterable[tuple[pa.Table, pa.Table]]) -> dict[Key, Revision]:
    """Return the frames without a plane, or with one that the recording disagrees with.

    Parameters
    ----------
    tables : frames beside planes, portion by portion, with `COLUMNS`.

    Returns
    -------
    The frames whose up is known better than when they were seen, in their order.

    Notes
    -----
    Holds a few numbers per frame.
    """
    found: dict[Key, Revision] = {}
    for topic, stream in _streams(tables).items():
        posed = np.isfinite(stream.rotation[:, 0, 0])
        expected = _fixed_up(stream, posed) if 2 * posed.sum() > len(posed) else _still_up(stream)
        off = ~stream.level | ~(_cosine(stream.up, expected) > _cos(_OFF_DEG))
        off |= ~posed & _other_support(stream, off)
        agrees = _cosine(stream.given, expected) > _cos(_AGREES_DEG)
        for k in np.flatnonzero(np.isfinite(expected[:, 0]) & off & ~agrees):
            given = stream.given[k].astype(np.float32) if np.isfinite(stream.given[k, 0]) else None
            key = (topic, int(stream.frames[k]))
            found[key] = Revision(expected[k].astype(np.float32), given)
    return found


def _fixed_up(stream: _Stream, posed: Bool) -> F8:
    """Return up (n, 3) by what most frames say of the fixed frame's; NaN where it is not known."""
    in_fixed = np.einsum("nij,nj->ni", stream.rotation, stream.up)
    agreed = _agreed(in_fixed[posed & stream.level], _OFF_DEG, _FIXED_SHARE)
    return np.asarray(np.einsum("nji,j->ni", stream.rotation, agreed))


def _still_up(stream: _Stream) -> F8:
    """Return up (n, 3) by the frames around, where the camera was still; else NaN."""
    level, expected = stream.level, np.full(stream.up.shape, np.nan)
    for k in range(len(expected)):
        near = _around(stream, k)
        expected[k] = _agreed(stream.up[near][level[near]], _STILL_DEG, _STILL_SHARE)
    return expected


def _around(stream: _Stream, k: int) -> I4:
    """Return the numbers of the frames around one, without it."""
    near = np.arange(max(0, k - _AROUND), min(len(stream.frames), k + _AROUND + 1))
    soon = np.abs(stream.stamps_ns[near] - stream.stamps_ns[k]) <= _AROUND_NS
    return np.asarray(near[soon & (near != k)])


def _other_support(stream: _Stream, off: Bool) -> Bool:
    """Return (n,) in which frames no plane is as high as the lowest plane of nearby frames."""
    found = np.zeros(len(off), np.bool_)
    for k in np.flatnonzero(~off):
        near = _around(stream, int(k))
        lowest = np.array([stream.offsets[m][0] for m in near[~off[near]]])
        if len(lowest) < _FEWEST:
            continue
        usual = np.median(lowest)
        still = np.mean(np.abs(lowest - usual) < _STILL_M) > _STILL_SHARE
        found[k] = still and np.min(np.abs(stream.offsets[k] - usual)) > _OFF_M
    return found


def _agreed(up: F8, within_deg: float, share: float) -> F8:
    """Return the direction (3,) that so large a share of some (n, 3) agree with; NaN if none."""
    if len(up) < _FEWEST:
        return np.full(3, np.nan)
    near = _cosine(up, np.median(up, axis=0)) > _cos(within_deg)
    if near.mean() <= share:
        return np.full(3, np.nan)
    mean = up[near].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _cosine(a: F8, b: F8) -> F8:
    """Return the cosine (n,) between directions (n, 3) and others, (n, 3) or one (3,)."""
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray((a * b).sum(axis=-1) / np.maximum(lengths, 1e-9))


def _cos(degrees: float) -> float:
    return float(np.cos(np.radians(degrees)))


def _streams(tables: Iterable[tuple[pa.Table, pa.Table]]) -> dict[str, _Stream]:
    parts: dict[str, list[_Stream]] = {}
    for frames, planes in tables:
        for topic, part in _parts(frames, planes):
            parts.setdefault(topic, []).append(part)
    return {topic: _joined(of_topic) for topic, of_topic in parts.items()}


def _parts(frames: pa.Table, planes: pa.Table) -> Iterator[tuple[str, _Stream]]:
    """Yield the frames of each topic in a portion of the tables."""
    topics, codes = topic_codes(frames)
    rows, offsets = frame_rows(planes), numbers(planes["offset"]).copy()
    index, stamps = numbers(frames["frame"]), numbers(frames["stamp_ns"])
    keys = list(rows_of(topics, codes, index))
    of_frame = [offsets[rows.get(key, slice(0, 0))] for key in keys]
    up, given = _vectors(frames["up"], 3), _vectors(frames["up_given"], 3)
    rotation = _vectors(frames["fixed_rotation"], 9).reshape(-1, 3, 3)
    for code, topic in enumerate(topics):
        of = np.flatnonzero(codes == code)
        chosen = [of_frame[k] for k in of]
        yield topic, _Stream(index[of], stamps[of], up[of], given[of], rotation[of], chosen)


def _joined(parts: list[_Stream]) -> _Stream:
    *arrays, offsets = zip(*parts, strict=True)
    frames, stamps, up, given, rotation = map(np.concatenate, arrays)
    return _Stream(frames, stamps, up, given, rotation, list(chain.from_iterable(offsets)))


def _vectors(column: pa.ChunkedArray, width: int) -> F8:
    """Return a column of vectors (n, width), NaN where there is none."""
    known = column.is_valid().to_numpy()
    vectors = np.full((len(known), width), np.nan)
    if known.any():
        vectors[known] = numbers(column).reshape(-1, width)
    return vectors
