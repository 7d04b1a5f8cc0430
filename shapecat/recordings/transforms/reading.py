"""Read the transforms in the messages of a recording."""

from collections.abc import Sequence
from typing import Any

from shapecat.errors import RecordingError
from shapecat.recordings.decoding.foxglove import ros_counterpart
from shapecat.recordings.messages import MALFORMED, Message, reason_of
from shapecat.recordings.recording import Recording
from shapecat.recordings.stamps import Estimates, stamp_ns
from shapecat.recordings.transforms.buffer import TransformBuffer
from shapecat.recordings.transforms.topics import TF_TYPES, is_latched, transform_topics

__all__ = ["TransformReader", "read_transforms"]


def read_transforms(
    recording: Recording, *, static_only: bool = False, sensor_topics: Sequence[str] = ()
) -> TransformBuffer:
    """Read all transforms of a recording in one pass.

    Parameters
    ----------
    sensor_topics : topics of the sensors; they select the robot if there are several, see
        `transform_topics`.
    static_only : read only static transforms, which are few: their topics end in ``tf_static``.
    """
    reader = TransformReader(recording, TransformBuffer())
    static, moving = transform_topics(recording, sensor_topics)
    topics = static if static_only else static | moving
    for message in recording.messages(topics) if topics else ():
        reader.take(message)
    return reader.buffer


class TransformReader:
    """Adds the transforms in messages to a buffer.

    Attributes
    ----------
    lag_ns : the largest difference between stamp and log time of a transform that is not static.
    """

    def __init__(self, recording: Recording, buffer: TransformBuffer) -> None:
        """Read messages of ``recording`` into ``buffer``."""
        self.buffer = buffer
        self.lag_ns = 0
        self._recording = recording
        self._estimates = Estimates(recording)

    def take(self, message: Message) -> None:
        """Add the transforms in a message; invalid ones cause a warning."""
        if ros_counterpart(message.type) not in TF_TYPES:
            return
        static = message.topic.endswith("tf_static")
        latched = is_latched(message.type)
        try:
            for transform in self._recording.decode(message).transforms:
                stamp = stamp_ns(transform.header)
                if stamp == 0 and not static:
                    stamp = self._estimates.stamp_ns(message.topic, message.log_time_ns)
                times = stamp, message.log_time_ns
                if not self._add(transform, times, static=static, latched=latched):
                    self._recording.warn("skipped invalid transforms (NaN, no name)")
                if message.topic in self._estimates.unknown:
                    self._recording.warn(
                        f"{message.topic}: transforms have no stamps: their log times, which are "
                        "later, replace them"
                    )
                if not static:
                    self.lag_ns = max(self.lag_ns, abs(stamp - message.log_time_ns))
        except (RecordingError, *MALFORMED) as error:
            reason = reason_of(error, message.topic)
            self._recording.warn(f"skipped transforms: {message.topic}: {reason}")

    def _add(self, transform: Any, times: tuple[int, int], *, static: bool, latched: bool) -> bool:
        """Add a decoded geometry_msgs/TransformStamped; return False if it is invalid.

        ``times`` are its stamp and its log time, nanoseconds.
        """
        move, turn = transform.transform.translation, transform.transform.rotation
        return self.buffer.add(
            transform.header.frame_id,
            transform.child_frame_id,
            times[0],
            ((move.x, move.y, move.z), (turn.x, turn.y, turn.z, turn.w)),
            static=static,
            latched=latched,
            log_time_ns=times[1],
        )
