"""Find the up direction and the sensor pose in each frame of a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.errors import ConfigError
from shapecat.geometry import LINK_FROM_OPTICAL, compose, unit_direction
from shapecat.recordings.recording import Recording
from shapecat.recordings.sensors import same_frame
from shapecat.recordings.streams import Stream
from shapecat.recordings.transforms.buffer import GapError, TransformError, fixed_frame
from shapecat.recordings.transforms.imu import Accelerometers
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.types import Frame, Pose

__all__ = ["MISNAMINGS", "Misnaming", "Orientation", "PoseFinder", "has_z_up", "turned"]

_LEVEL_FRAMES = ("map", "odom", "world", "earth", "base_footprint", "base_link")
"""Frames whose z axis is up by convention (REP 105, REP 103). A robot's name may precede them."""
_SOURCES = {"auto": ("tf", "imu"), "tf": ("tf",), "imu": ("imu",)}


class Misnaming(NamedTuple):
    """A way in which the axes of data differ from those of the frame in their ``frame_id``.

    Attributes
    ----------
    text : the difference in words, to be shown to the user after the name of the topic.
    named_from_data : (3, 3) rotation from the frame of the data to the frame in ``frame_id``.
    """

    text: str
    named_from_data: F8


MISNAMINGS = (
    Misnaming(
        "its data are in an optical frame (z forward), but their frame_id names a frame with x "
        "forward",
        LINK_FROM_OPTICAL.rotation,
    ),
    Misnaming(
        "its points have x forward, but their frame_id names an optical frame (z forward)",
        LINK_FROM_OPTICAL.rotation.T,
    ),
    Misnaming(
        "its data have OpenGL axes (z backward), but their frame_id names a frame with ROS axes, "
        "or the reverse",
        np.diag([1.0, -1.0, -1.0]),
    ),
)
"""Misnamings by simulators, the usual one first."""


class Orientation(NamedTuple):
    """Up direction and sensor pose at one frame, as the recording gives them.

    Attributes
    ----------
    source : source of ``up``, such as ``transforms, z of map``; empty if ``up`` is None.
    up : (3,) the up direction in the sensor frame, a unit vector; None if unknown.
    fixed_from_sensor : the pose of the sensor in the fixed frame; None if unknown.
    """

    source: str
    up: F4 | None
    fixed_from_sensor: Pose | None


@dataclass
class PoseFinder:
    """Finds the up direction and the sensor pose of each frame.

    Frames must be looked up in the order of the recording, since only a little of the past is kept.

    Attributes
    ----------
    fixed_frame : name of the fixed frame; None until it is chosen at the first frame.
    vector : (3,) the up direction given by the user, in the sensor frame; None if not given.
    sources : ``tf`` and ``imu``, in the order in which they are tried; empty if there is a vector.
    warnings : for the user.
    dropped : by topic, the source of an up direction that is ignored.
    failed, first_failure : the number of look-ups that failed for other reasons than a gap, and the
        error of the first.
    in_gaps, longest_gap : the number of frames without pose in gaps between transforms, and the
        longest gap.
    given : the number of frames by the source of their up direction.
    misnamed : by topic, the ``named_from_data`` of a `Misnaming` that was found.
    sensors : the frame ids of all sensors, as far as they are known.
    middle_ns : log time of the middle of the recording, nanoseconds.
    """

    transforms: TransformWindow
    fixed_frame: str | None
    vector: F4 | None
    sources: tuple[str, ...]
    accelerometers: Accelerometers | None = None
    warnings: list[str] = field(default_factory=list)
    dropped: dict[str, str] = field(default_factory=dict)
    failed: int = 0
    first_failure: str = ""
    in_gaps: int = 0
    longest_gap: GapError | None = None
    given: dict[str, int] = field(default_factory=dict)
    misnamed: dict[str, F8] = field(default_factory=dict)
    sensors: tuple[str, ...] = ()
    middle_ns: int = 0

    @classmethod
    def of(
        cls,
        recording: Recording,
        *,
        up: str,
        fixed_frame: str | None,
        streams: Sequence[Stream] = (),
    ) -> "PoseFinder":
        """Prepare to look up frames of a recording; read its first transforms and accelerations.

        Parameters
        ----------
        up : ``tf``, ``imu``, ``auto`` for the first of these that is available, or a vector
            ``X,Y,Z`` in the sensor frame.
        fixed_frame : name of the frame in which the scene is at rest, with or without a leading
            slash; None to choose one.
        streams : the streams whose frames will be looked up.

        Raises
        ------
        ConfigError : ``up`` is malformed, or the recording lacks the requested source or frame.
        """
        sources = _SOURCES.get(up, ())
        vector = None if sources else _parse_vector(up)
        transforms = TransformWindow.of(recording, [stream.topic for stream in streams])
        known_frames = transforms.tree.frames
        requested = None if fixed_frame is None else fixed_frame.lstrip("/")
        if requested is not None and requested not in known_frames:
            frame_list = ", ".join(known_frames) or "none, it has no transforms"
            msg = f"--fixed-frame {fixed_frame}: not in {recording.path}; its frames: {frame_list}"
            raise ConfigError(msg)
        if up == "tf" and not _level_frames(known_frames, ""):
            msg = (
                f"--up tf: {recording.path} has no transforms to any of {', '.join(_LEVEL_FRAMES)}"
            )
            raise ConfigError(msg)
        accelerometers = Accelerometers(recording) if "imu" in sources else None
        if up == "imu" and not (accelerometers and accelerometers.measure_anything()):
            msg = f"--up imu: {recording.path} has no sensor_msgs/Imu with accelerations"
            raise ConfigError(msg)
        problems = transforms.tree.find_loop(), transforms.tree.find_replaced()
        return cls(
            transforms=transforms,
            fixed_frame=requested,
            vector=vector,
            sources=sources,
            accelerometers=accelerometers,
            warnings=[f"transforms: {problem}" for problem in problems if problem],
            sensors=tuple(stream.frame_id for stream in streams),
            middle_ns=(recording.start_ns + recording.end_ns) // 2,
        )

    def orient(self, frame: Frame) -> Orientation:
        """Look up the up direction and the pose of the sensor in a frame."""
        return Orientation(*self._find(frame), self.fixed_from_sensor(frame))

    def fixed_from_sensor(self, frame: Frame) -> Pose | None:
        """Return the pose of the sensor in the fixed frame, or None if it is unknown."""
        if self.fixed_frame is None:
            self.fixed_frame = self._choose_fixed_frame(frame)
        if self.fixed_frame is None:
            return None
        return self._lookup(self.fixed_frame, frame, places=True)

    def _choose_fixed_frame(self, first: Frame) -> str | None:
        """Choose one fixed frame for all sensors, preferably one named map, odom or world.

        A coordinate frame in which sensor poses are known halfway through the recording is
        preferred, since objects are tracked in it only if most images have a pose. Without one in
        the transforms, the result is the frame of the first cloud if that has a pose, else None.
        """
        halfway_ns = first.stamp_ns + max(0, self.middle_ns - first.log_time_ns)
        candidates = [
            fixed_frame(self.transforms.tree, name, halfway_ns)
            for name in (first.frame_id, *self.sensors)
        ]
        own_frame = None if first.frame_from_sensor is None else first.frame_id.lstrip("/")
        return min((name for name in candidates if name is not None), key=_rank, default=own_frame)

    def corrected(self, topic: str, orientation: Orientation) -> Orientation:
        """Return the orientation of a topic's data, corrected if `assume_misnamed` was called."""
        source, up, pose = orientation
        turn = self.misnamed.get(topic)
        if turn is None:
            return orientation
        if pose is not None:
            pose = Pose(pose.rotation @ turn, pose.translation)
        return Orientation(source, None if up is None else turned(up, turn), pose)

    def assume_misnamed(self, topic: str, misnaming: Misnaming) -> None:
        """Treat the data on a topic as misnamed from now on; add a warning."""
        self.misnamed[topic] = misnaming.named_from_data
        self.warnings.append(f"{topic}: {misnaming.text}; its transforms are corrected")

    def accept(self, topic: str, orientation: Orientation) -> F4 | None:
        """Return the up direction of a frame, and count it by its source.

        The result is None if the direction is unknown, or dropped for this topic.
        """
        up = None if topic in self.dropped else orientation.up
        source = "planes" if up is None else orientation.source
        self.given[source] = self.given.get(source, 0) + 1
        return up

    def _find(self, frame: Frame) -> tuple[str, F4 | None]:
        if not self.sources:
            return "option", self.vector
        source, vector = "", None
        if "tf" in self.sources:
            source, vector = self._from_transforms(frame)
        if "imu" in self.sources and vector is None:
            source, vector = self._from_accelerometer(frame)
        return source, vector

    def contradict(self, topic: str, source: str, angles_deg: Sequence[float]) -> None:
        """Warn that the planes contradict a topic's up direction; drop it unless the user chose it.

        Parameters
        ----------
        source : source of the up direction, as in `Orientation`.
        angles_deg : angles between the up direction and the normal of the planes, one per frame.
        """
        off = f"differs by {np.median(angles_deg):.0f} degrees from the planes of {topic}"
        if not self.sources:
            self.warnings.append(f"--up {off}: is it right? --up auto estimates up from the planes")
        elif len(self.sources) == 1:
            self.warnings.append(
                f"up ({source}) {off}; --up auto ignores a direction that the planes contradict"
            )
        else:
            self.dropped[topic] = source
            name = "imu" if source.startswith("imu") else "tf"
            self.warnings.append(f"up ({source}) {off} and is ignored; give --up {name} to use it")

    def _from_transforms(self, frame: Frame) -> tuple[str, F4 | None]:
        name = frame.frame_id.lstrip("/")
        own_frames = () if frame.frame_from_sensor is None else (name,)
        for level in _level_frames((*self.transforms.tree.frames, *own_frames), name):
            pose = self._lookup(level, frame)
            if pose is not None:
                return f"transforms, z of {level}", np.asarray(pose.rotation[2], np.float32)
        return "", None

    def _from_accelerometer(self, frame: Frame) -> tuple[str, F4 | None]:
        if self.accelerometers is None:
            return "", None
        for sensor in self.accelerometers.around(frame.log_time_ns, frame.stamp_ns):
            up = sensor.up(frame.stamp_ns)
            pose = None
            own_frame = same_frame(sensor.frame_id, frame.frame_id)
            if not own_frame or frame.frame_from_sensor is not None:
                pose = self._lookup(sensor.frame_id, frame)
                up = None if pose is None or up is None else up @ pose.rotation
            if up is not None:
                return f"imu, {sensor.topic}", np.asarray(up, np.float32)
        return "", None

    def _lookup(self, target: str, frame: Frame, *, places: bool = False) -> Pose | None:
        """Return the pose of the sensor in the frame ``target``; None if it is unknown.

        Gaps are counted only if the look-up ``places`` the sensor in the fixed frame.
        """
        transforms = self.transforms.around(frame.log_time_ns, frame.stamp_ns)
        offset = frame.frame_from_sensor
        if offset is not None and target == frame.frame_id.lstrip("/"):  # it may be in no transform
            return offset
        try:
            pose = transforms.lookup(target, frame.frame_id, frame.stamp_ns)
            return pose if offset is None else compose(pose, offset)
        except GapError as gap:
            self.in_gaps += places
            if places and (self.longest_gap is None or gap.gap_s > self.longest_gap.gap_s):
                self.longest_gap = gap
        except TransformError as error:
            self.failed += 1
            self.first_failure = self.first_failure or str(error)
        return None


def _level_frames(frames: Sequence[str], sensor: str) -> list[str]:
    """Return the frames with z up, best first; the robot of frame ``sensor`` precedes others."""

    def order(name: str) -> tuple[int, bool, bool]:
        robot = name.rpartition("/")[0]
        return _rank(name), robot != "", not sensor.startswith(f"{robot}/")

    return sorted(filter(has_z_up, frames), key=order)


def turned(up: F4, named_from_data: F8) -> F4:
    """Convert a direction (3,) from the frame named in ``frame_id`` to that of the data."""
    return np.asarray(up @ named_from_data, np.float32)


def has_z_up(frame_id: str) -> bool:
    """Return whether a frame has z up by convention, and so does not belong to a camera."""
    return _rank(frame_id) < len(_LEVEL_FRAMES)


def _rank(name: str) -> int:
    """Return the index of a frame in `_LEVEL_FRAMES`, ignoring a robot's name before it.

    For other frames, this is the number of frames listed there.
    """
    plain = name.rpartition("/")[2]
    return _LEVEL_FRAMES.index(plain) if plain in _LEVEL_FRAMES else len(_LEVEL_FRAMES)


def _parse_vector(text: str) -> F4:
    try:
        return unit_direction([float(part) for part in text.split(",")]).astype(np.float32)
    except ValueError:
        msg = f"--up {text}: expected auto, tf, imu, or a vector such as 0,-1,0"
        raise ConfigError(msg) from None
