"""Transforms between coordinate frames over time.

Stamps are integer nanoseconds: today's time as a float in seconds has a resolution of 238 ns.
"""

import math
import sys
from bisect import bisect_right
from contextlib import suppress
from typing import Any

from shapecat.errors import ShapecatError, listed
from shapecat.geometry import IDENTITY, compose, inverse
from shapecat.recordings.transforms.delays import Delays
from shapecat.recordings.transforms.samples import (
    TOLERANCE_NS,
    TransformSample,
    TransformTrack,
    are_close,
    interpolated,
    pose_of,
)
from shapecat.types import Pose

__all__ = [
    "ExtrapolationError",
    "GapError",
    "TransformBuffer",
    "TransformError",
    "TransformLoopError",
    "fixed_frame",
]

_FARTHEST_M = 1e9
"""Transforms with a larger translation are rejected as damaged."""
_DEEPEST = 200
"""A frame with more ancestors than this counts as being in a loop."""
_FIXED = ("map", "odom", "world")
"""Usual names of fixed frames, best first."""


class TransformError(ShapecatError):
    """A transform cannot be determined from the recording."""


class ExtrapolationError(TransformError):
    """The time of a look-up is before the first or after the last transform of a frame."""


class GapError(TransformError):
    """The time of a look-up is in a gap between two transforms that differ.

    Attributes
    ----------
    frame_id : the frame whose transforms have the gap.
    gap_s : length of the gap, seconds.
    """

    def __init__(self, frame_id: str, stamp_ns: int, gap_s: float) -> None:
        """Describe a gap."""
        self.frame_id, self.gap_s = frame_id, gap_s
        where = f"that is within a gap of {gap_s:.3f} s"
        super().__init__(f"no transform of {frame_id} at {stamp_ns} ns: {where}")


class TransformLoopError(TransformError):
    """A frame is its own ancestor."""


class TransformBuffer:
    """Transforms between frames.

    A static transform is used at times when its child frame has no other transform.
    """

    def __init__(self) -> None:
        """Make an empty buffer."""
        self._tracks: dict[str, TransformTrack] = {}
        self._frames: set[str] = set()
        self._replaced: set[str] = set()

    def forget(self, stamp_ns: int) -> None:
        """Remove each frame's transforms before a stamp (ns), as `TransformTrack.forget` does."""
        for track in self._tracks.values():
            track.forget(stamp_ns)

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of all frames, sorted."""
        return tuple(sorted(self._frames))

    def add(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        parent_from_child: tuple[Any, Any],
        *,
        static: bool,
        latched: bool = False,
        log_time_ns: int | None = None,
    ) -> bool:
        """Add a transform, unless it is invalid.

        Parameters
        ----------
        parent_from_child : translation (x, y, z) in metres and quaternion (x, y, z, w).
        static : whether it is valid whenever ``child`` has no other transform; ``stamp_ns`` is then
            ignored.
        latched : whether the last transform of ``child`` remains valid for ever.
        log_time_ns : its log time; None if it is unknown.

        Returns
        -------
        Whether it was added; False if the transform is invalid: a frame has no name or is its own
        parent, a number is not finite, the translation is longer than 1e9 m, or the
        quaternion is zero.
        """
        parent, child = parent.strip().lstrip("/"), child.strip().lstrip("/")
        # With NumPy, this would take most of the reading time: joints publish at 1 kHz.
        x, y, z = map(float, parent_from_child[0])
        quaternion = tuple(map(float, parent_from_child[1]))
        norm = math.hypot(*quaternion)
        fine = math.hypot(x, y, z) < _FARTHEST_M and 1e-6 < norm < math.inf
        if not (fine and parent and child and parent != child):
            return False
        parent = sys.intern(parent)  # one string for all samples
        sample = TransformSample(parent, (x, y, z), tuple(part / norm for part in quaternion))
        if child not in self._tracks:
            self._tracks[child] = TransformTrack()
        self._frames |= {parent, child}
        track = self._tracks[child]
        if static:
            if not are_close(track.static or sample, sample):
                self._replaced.add(child)
            track.static = sample
        else:
            track.latched |= latched
            track.add(stamp_ns, sample)
            if log_time_ns is not None:
                track.note_delay(log_time_ns, stamp_ns, sample)
        return True

    @property
    def moves(self) -> bool:
        """Whether any frame moves."""
        return any(track.moves for track in self._tracks.values())

    @property
    def contradicted(self) -> list[str]:
        """The frames whose transforms differ at the same stamps, because a clock was set back."""
        return sorted(name for name, track in self._tracks.items() if track.contradicted)

    def delays_between(self, target: str, source: str) -> list[Delays]:
        """Return the delays of each moving transform on the way between two frames.

        The list is empty if nothing moves, or the frames are not connected.
        """
        with suppress(TransformLoopError):
            ways = [set(self._ancestors(name.lstrip("/"))) for name in (target, source)]
            tracks = [self._tracks[name] for name in ways[0] ^ ways[1] if name in self._tracks]
            return [t.delays for t in tracks if t.moves] if ways[0] & ways[1] else []
        return []

    def root_of(self, frame_id: str) -> str:
        """Return the root of a frame's tree, according to the latest transforms.

        Raises
        ------
        TransformError : no transform names the frame, or it is in a loop.
        """
        return self._ancestors(self._require_frame(frame_id))[-1]

    def find_loop(self) -> str:
        """Return the error message for a loop in the latest transforms; empty if there is none."""
        for name in self.frames:
            try:
                self._ancestors(name)
            except TransformLoopError as error:
                return str(error)
        return ""

    def find_replaced(self) -> str:
        """Return a warning about static transforms that were replaced by others; empty if none."""
        names = listed(sorted(self._replaced))
        found = f"static ones of {names} differ: the last is used for the whole recording"
        return found if names else ""

    def lookup(self, target: str, source: str, stamp_ns: int) -> Pose:
        """Return ``target_from_source`` at a time.

        Between two samples, translations are interpolated linearly and rotations by slerp.

        Raises
        ------
        ExtrapolationError, GapError : a transform on the way is not known at that time.
        TransformLoopError : the frames form a loop.
        TransformError : no transform names one of the frames, or no chain of transforms connects
            them.
        """
        target, source = self._require_frame(target), self._require_frame(source)
        up, down = self._ancestors(source, stamp_ns), self._ancestors(target, stamp_ns)
        shared = next((frame for frame in up if frame in set(down)), None)
        if shared is None:
            roots = f"{down[-1]} and {up[-1]}"
            msg = f"no transform between {target} and {source}: their roots are {roots}"
            raise TransformError(msg)
        shared_from_source = self._chain(up[: up.index(shared)], stamp_ns)
        shared_from_target = self._chain(down[: down.index(shared)], stamp_ns)
        return compose(inverse(shared_from_target), shared_from_source)

    def _require_frame(self, frame_id: str) -> str:
        name = frame_id.lstrip("/")
        if name not in self._frames:
            examples = listed(self.frames) or "none"
            msg = f"no transform names the frame {name!r}; known frames: {examples}"
            raise TransformError(msg)
        return name

    def _ancestors(self, frame_id: str, stamp_ns: int | None = None) -> list[str]:
        """Return a frame and its ancestors at a stamp (ns).

        If the stamp is None, the latest transforms determine them.
        """
        chain = [frame_id]
        while (parent := self._parent(chain[-1], stamp_ns)) is not None:
            if parent in chain or len(chain) > _DEEPEST:
                msg = f"the frames {' < '.join([*chain[-5:], parent])} form a loop"
                raise TransformLoopError(msg)
            chain.append(parent)
        return chain

    def _parent(self, frame_id: str, stamp_ns: int | None) -> str | None:
        track = self._tracks.get(frame_id)
        if track is None:
            return None
        stamps = track.stamps
        known = stamps if stamp_ns is None else max(track.gaps_ns(stamp_ns)) <= TOLERANCE_NS
        if track.static is not None and not known:
            return track.static.parent
        at = len(stamps) if stamp_ns is None else bisect_right(stamps, stamp_ns)
        return track[max(0, at - 1)].parent

    def _chain(self, frames: list[str], stamp_ns: int) -> Pose:
        """Return the transform from the first frame to the parent of the last, at a stamp (ns).

        Each of the ``frames`` is followed by its parent.
        """
        pose = IDENTITY
        for frame_id in frames:
            pose = compose(self._to_parent(frame_id, stamp_ns), pose)
        return pose

    def _to_parent(self, frame_id: str, stamp_ns: int) -> Pose:
        track = self._tracks[frame_id]
        stamps = track.stamps
        late, early = track.gaps_ns(stamp_ns)
        if max(late, early) > TOLERANCE_NS:
            if track.static is not None:
                return pose_of(track.static)
            side = (
                f"{late * 1e-9:.3f} s after the last"
                if late > 0
                else f"{early * 1e-9:.3f} s before the first"
            )
            msg = f"no transform of {frame_id} at {stamp_ns} ns: that is {side} one"
            raise ExtrapolationError(msg)
        at = bisect_right(stamps, stamp_ns)
        if at in {0, len(stamps)}:
            return pose_of(track[max(0, at - 1)])
        if gap_ns := track.unseen_ns(at, stamp_ns):
            raise GapError(frame_id, stamp_ns, gap_ns * 1e-9)
        before, after = track[at - 1], track[at]
        if before.parent != after.parent or before == after:
            return pose_of(before)
        share = (stamp_ns - stamps[at - 1]) / (stamps[at] - stamps[at - 1])
        return interpolated(before, after, share)


def fixed_frame(buffer: TransformBuffer, frame_id: str, at_ns: int | None = None) -> str | None:
    """Choose the fixed frame for a sensor frame: map, odom, world, or the root of its tree.

    If the sensor frame has a namespace, frames in other namespaces come last.

    Parameters
    ----------
    at_ns : prefer frames in which the pose of the sensor is known at this stamp: localization may
        begin late. None to choose by name alone.

    Returns
    -------
    The name of the frame. None if ``frame_id`` is in no transform or in a loop, or if it is itself
    the root and no frame of its tree has such a name.
    """
    sensor = frame_id.lstrip("/")
    try:
        root = buffer.root_of(sensor)
    except TransformError:
        return None
    connected = [name for name in buffer.frames if _is_below(buffer, name, root)]
    names = [n for usual in _FIXED for n in connected if n.rsplit("/", 1)[-1] == usual]
    names += [root] if root != sensor else []
    if "/" in sensor:  # for r2/camera, another robot's frames, such as r1/odom, come last
        names.sort(key=lambda name: not sensor.startswith(name[: name.rfind("/") + 1]))
    placed = [n for n in names if at_ns is None or _can_transform(buffer, n, sensor, at_ns)]
    return next(iter(placed or names), None)


def _can_transform(buffer: TransformBuffer, target: str, source: str, stamp_ns: int) -> bool:
    try:
        buffer.lookup(target, source, stamp_ns)
    except TransformError:
        return False
    return True


def _is_below(buffer: TransformBuffer, name: str, root: str) -> bool:
    with suppress(TransformLoopError):
        return buffer.root_of(name) == root
    return False
