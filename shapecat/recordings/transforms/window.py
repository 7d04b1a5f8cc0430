"""Keep the transforms around the current frame of a recording, in constant memory."""

from collections.abc import Sequence
from copy import deepcopy

from shapecat.recordings.look_ahead import AROUND_NS, LookAhead, reads_all_first
from shapecat.recordings.recording import Recording
from shapecat.recordings.transforms.buffer import TransformBuffer
from shapecat.recordings.transforms.reading import TransformReader, read_transforms
from shapecat.recordings.transforms.topics import is_latched, transform_topics

__all__ = ["TransformWindow"]

_LAG_NS = AROUND_NS // 2
"""If stamp and log time of a transform differ by more than this, all are read at the start."""
_NEAR_NS = 1_000_000_000
"""Before the first frame, transforms at most this far from the middle of the recording are read."""


class TransformWindow:
    """The transforms around the current frame, or all of a short recording.

    Attributes
    ----------
    known : the transforms read so far.
    tree : the static transforms, and the others from the start, the middle and the end of the
        recording: enough to know the names and parents of all frames.
    """

    def __init__(
        self,
        buffer: TransformBuffer,
        tree: TransformBuffer | None = None,
        ahead: LookAhead | None = None,
    ) -> None:
        """Use ``buffer``, which holds all transforms, or is filled by ``ahead`` as needed."""
        self.tree = buffer if tree is None else tree
        self.known, self._ahead = buffer, ahead

    @classmethod
    def of(cls, recording: Recording, sensor_topics: Sequence[str] = ()) -> "TransformWindow":
        """Read the static transforms of a recording, and the first, middle and last of the others.

        ``sensor_topics`` selects the robot if there are several, see `transform_topics`.
        """
        topics = transform_topics(recording, sensor_topics).moving
        reads_all = reads_all_first(recording)
        buffer = read_transforms(recording, static_only=not reads_all, sensor_topics=sensor_topics)
        if reads_all or not topics:
            return cls(buffer)
        reader = TransformReader(recording, buffer)
        kinds = {topic.type for topic in recording.topics if topic.name in topics}
        skips = not any(map(is_latched, kinds))
        ahead = LookAhead(recording, topics, reader.take, buffer.forget, skips=skips)
        end = TransformReader(recording, deepcopy(buffer))
        middle_ns, end_ns = (recording.start_ns + recording.end_ns) // 2, recording.end_ns
        spans = (middle_ns - _NEAR_NS, middle_ns + _NEAR_NS), (end_ns - AROUND_NS, None)
        for start_ns, stop_ns in spans:
            for message in recording.messages(topics, start_ns, stop_ns):
                end.take(message)
        if max(reader.lag_ns, end.lag_ns) <= _LAG_NS:
            return cls(buffer, end.buffer, ahead)
        ahead.read_all()
        return cls(buffer)

    def around(self, log_time_ns: int, stamp_ns: int) -> TransformBuffer:
        """Return the transforms for a frame, given its log time and stamp in nanoseconds."""
        if self._ahead is not None:
            self._ahead.advance(log_time_ns, stamp_ns)
        return self.known
