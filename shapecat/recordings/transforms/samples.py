"""The transforms from one frame to its parent over time, and interpolation between them."""

import math
from array import array
from bisect import bisect_right
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import rotation_from_quaternion
from shapecat.recordings.transforms.delays import Delays
from shapecat.types import Pose

__all__ = [
    "TOLERANCE_NS",
    "TransformSample",
    "TransformTrack",
    "are_close",
    "interpolated",
    "pose_of",
]

TOLERANCE_NS = 100_000_000
"""A transform is assumed constant for this long before its first sample and after its last one, and
near the ends of a gap."""
_NEVER_NS = 2**63
_GAP_NS = 500_000_000
"""Shorter intervals between two samples are not gaps: slow localization publishes as rarely."""
_GAP_RATIO = 3
"""A gap is longer than this many times the mean of the other intervals, so that transforms at a low
rate have no gaps."""
_LONGEST_NS = 10_000_000_000
"""Longer intervals count as this long in the mean: what lies between may not have been read."""
_SET_BACK_NS = 1_000_000_000
"""A clock was set back if a stamp is more than this before the stamp of an earlier message. Late
messages differ by less."""
_MOVED_M = 0.02
"""Samples that differ by less than this and `_TURNED` are close. If the two around a gap are close,
they are interpolated: the frame was at rest, as in transforms that are published only on change, or
localization corrected it."""
_TURNED = math.radians(1)


class TransformSample(NamedTuple):
    """A transform to the parent frame: metres, and a unit quaternion x, y, z, w."""

    parent: str
    translation: tuple[float, float, float]
    quaternion: tuple[float, ...]


class TransformTrack:
    """The transforms from one frame to its parent, sorted by time, in packed arrays.

    Attributes
    ----------
    contradicted : whether a clock was set back, and samples after that differ from those before it
        with about the same stamps.
    delays : log time minus stamp of the messages, in their order in the recording.
    latched : whether the last transform remains valid for ever.
    moves : whether a sample whose delay was kept is not close to the first one; see `_MOVED_M`.
    static : the static transform, valid when no other one is; None if there is none.
    stamps : stamps of the samples, nanoseconds.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self.delays = Delays()
        self.contradicted = self.latched = self.moves = False
        self.static: TransformSample | None = None
        self.stamps = array("q")
        self._intervals = self._span_ns = 0  # number and sum of the intervals between samples
        self._first: TransformSample | None = None
        self._parents: list[str] = []
        self._numbers = array("d")  # seven per sample

    def __getitem__(self, k: int) -> TransformSample:
        """Return sample ``k``, counted from 0."""
        x, y, z, *quaternion = self._numbers[7 * k : 7 * k + 7]
        return TransformSample(self._parents[k], (x, y, z), tuple(quaternion))

    def gaps_ns(self, stamp: int) -> tuple[int, int]:
        """Return the time from the last sample to a stamp, and from the stamp to the first, ns.

        If a time is positive, the stamp is outside the samples, or there are none. Latched samples
        never end.
        """
        if not self.stamps:
            return _NEVER_NS, _NEVER_NS
        return 0 if self.latched else stamp - self.stamps[-1], self.stamps[0] - stamp

    def unseen_ns(self, at: int, stamp: int) -> int:
        """Return the length of the gap that a stamp is in, ns; 0 if the transform is known there.

        In a gap, the transform changes in an unknown way.

        Parameters
        ----------
        at : number of the sample after ``stamp``, at least 1.
        """
        begin, end = self.stamps[at - 1], self.stamps[at]
        gap = end - begin
        if gap <= _GAP_NS or min(stamp - begin, end - stamp) <= TOLERANCE_NS:
            return 0
        others = self._intervals - 1, self._span_ns - min(gap, _LONGEST_NS)
        usual = gap * others[0] <= _GAP_RATIO * others[1]
        return 0 if usual or are_close(self[at - 1], self[at]) else gap

    def add(self, stamp: int, sample: TransformSample) -> None:
        """Insert a sample by time; it replaces one with the same stamp.

        Of three equal samples in a row, the middle one is dropped.
        """
        at, count = bisect_right(self.stamps, stamp), len(self.stamps)
        if count and stamp < self.stamps[-1] - _SET_BACK_NS:
            self.contradicted |= self._differs(at, stamp, sample)
        if at == count > 0 and stamp > self.stamps[-1]:
            self._intervals += 1
            self._span_ns += min(stamp - self.stamps[-1], _LONGEST_NS)
        if at and self.stamps[at - 1] == stamp:
            self._set(slice(at - 1, at), stamp, sample)
        elif at == count >= 2 and sample == self[count - 1] == self[count - 2]:
            self.stamps[-1] = stamp
        else:
            self._set(slice(at, at), stamp, sample)

    def note_delay(self, log_time_ns: int, stamp_ns: int, sample: TransformSample) -> None:
        """Add the delay of a sample. `delays` keeps only some; with those, update ``moves``."""
        if self.delays.add(log_time_ns, stamp_ns) and not self.moves:
            self._first = self._first or sample
            self.moves = not are_close(self._first, sample)

    def forget(self, stamp: int) -> None:
        """Remove the samples before a time (ns), except the last one at or before it."""
        first = bisect_right(self.stamps, stamp) - 1
        if first > 0:
            del self.stamps[:first], self._parents[:first], self._numbers[: 7 * first]

    def _differs(self, at: int, stamp: int, sample: TransformSample) -> bool:
        """Return whether a sample differs from its neighbours, numbers ``at - 1`` and ``at``.

        The result is False if these are not near in time.
        """
        near = at > 0 and (self.stamps[at - 1] == stamp or self.stamps[at] - stamp <= _GAP_NS)
        return near and not any(are_close(self[k], sample) for k in (at - 1, at))

    def _set(self, at: slice, stamp: int, sample: TransformSample) -> None:
        self.stamps[at] = array("q", [stamp])
        self._parents[at] = [sample.parent]
        numbers = array("d", (*sample.translation, *sample.quaternion))
        self._numbers[7 * at.start : 7 * at.stop] = numbers


def pose_of(sample: TransformSample) -> Pose:
    """Return a sample as the pose ``parent_from_child``."""
    return Pose(rotation_from_quaternion(sample.quaternion), np.array(sample.translation))


def are_close(a: TransformSample, b: TransformSample) -> bool:
    """Return whether two samples of one parent differ by less than `_MOVED_M` and `_TURNED`."""
    cosine = abs(sum(p * q for p, q in zip(a.quaternion, b.quaternion, strict=True)))
    return (
        a.parent == b.parent
        and math.dist(a.translation, b.translation) < _MOVED_M
        and cosine > math.cos(_TURNED / 2)
    )


def interpolated(a: TransformSample, b: TransformSample, share: float) -> Pose:
    """Interpolate between two samples; ``share`` is 0 at ``a`` and 1 at ``b``.

    Translations are interpolated linearly, rotations by slerp.
    """
    translation = (1 - share) * np.array(a.translation) + share * np.array(b.translation)
    rotation = rotation_from_quaternion(
        _slerp(np.array(a.quaternion), np.array(b.quaternion), share)
    )
    return Pose(rotation, translation)


def _slerp(a: F8, b: F8, share: float) -> F8:
    """Interpolate unit quaternions along the shorter arc (Shoemake 1985)."""
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > 0.9999:  # linear interpolation errs by less than 1e-7 rad
        return a + share * (b - a)
    angle = np.arccos(cosine)
    return np.asarray(np.sin((1 - share) * angle) * a + np.sin(share * angle) * b)
