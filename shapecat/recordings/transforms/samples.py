"""The transforms from one frame to its parent over time, and interpolation between them."""

from array import array
from bisect import bisect_right
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import rotation_from_quaternion
from shapecat.types import Pose

__all__ = ["TransformSample", "TransformTrack", "interpolated", "pose_of"]


_NEVER_NS = 2**63


class TransformSample(NamedTuple):
    """A transform to the parent frame: metres, and a unit quaternion x, y, z, w."""

    parent: str
    translation: tuple[float, float, float]
    quaternion: tuple[float, ...]


class TransformTrack:
    """The transforms from one frame to its parent, sorted by time, in packed arrays.

    Attributes
    ----------
    latched : whether the last transform remains valid for ever.
    static : the static transform, valid when no other one is; None if there is none.
    stamps : stamps of the samples, nanoseconds.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self.latched = False
        self.static: TransformSample | None = None
        self.stamps = array("q")
        self._parents: list[str] = []
        self._numbers = array("d")  # seven per sample

    def __getitem__(self, k: int) -> TransformSample:
        """Return sample `k`, counted from 0."""
        x, y, z, *quaternion = self._numbers[7 * k : 7 * k + 7]
        return TransformSample(self._parents[k], (x, y, z), tuple(quaternion))

    def gaps_ns(self, stamp: int) -> tuple[int, int]:
        """Return the time from the last sample to a stamp, and from the stamp to the first, ns.

        A positive time means that the stamp is outside the samples; latched samples never end.
        """
        if not self.stamps:
            return _NEVER_NS, _NEVER_NS
        return 0 if self.latched else stamp - self.stamps[-1], self.stamps[0] - stamp

    def add(self, stamp: int, sample: TransformSample) -> None:
        """Insert a sample by time; it replaces one with the same stamp.

        Of three equal samples in a row, the middle one is dropped.
        """
        at, count = bisect_right(self.stamps, stamp), len(self.stamps)
        if at and self.stamps[at - 1] == stamp:
            self._set(slice(at - 1, at), stamp, sample)
        elif at == count >= 2 and sample == self[count - 1] == self[count - 2]:
            self.stamps[-1] = stamp
        else:
            self._set(slice(at, at), stamp, sample)

    def forget(self, stamp: int) -> None:
        """Remove the samples before a time (ns), except the last one at or before it."""
        first = bisect_right(self.stamps, stamp) - 1
        if first > 0:
            del self.stamps[:first], self._parents[:first], self._numbers[: 7 * first]

    def _set(self, at: slice, stamp: int, sample: TransformSample) -> None:
        self.stamps[at] = array("q", [stamp])
        self._parents[at] = [sample.parent]
        numbers = array("d", (*sample.translation, *sample.quaternion))
        self._numbers[7 * at.start : 7 * at.stop] = numbers


def pose_of(sample: TransformSample) -> Pose:
    """Return a sample as the pose ``parent_from_child``."""
    return Pose(rotation_from_quaternion(sample.quaternion), np.array(sample.translation))


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
