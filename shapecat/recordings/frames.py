"""Read the frames of a recording in order."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from shapecat.errors import ConfigError
from shapecat.recordings.messages import Message, Needed
from shapecat.recordings.recording import Recording
from shapecat.recordings.sources import SOURCES, DepthSource, FrameSource
from shapecat.recordings.streams import Stream
from shapecat.types import Frame

__all__ = ["ALL_FRAMES", "FrameRange", "frames"]

_FAR_NS = 2**62
"""More than a century. Later times would not fit into the integers of a database."""


@dataclass(frozen=True)
class FrameRange:
    """Time range and step of the frames to read from a recording.

    Attributes
    ----------
    start_s, end_s : log time from the start of the recording, seconds, ``end_s`` exclusive; None
        for no limit.
    every : keep every n-th message of a stream.

    Raises
    ------
    ConfigError : ``every`` is not an integer of at least 1, a time is negative or not finite, or
        the end is not after the start.
    """

    start_s: float | None = None
    end_s: float | None = None
    every: int = 1

    def __post_init__(self) -> None:
        """Check the values; convert NumPy numbers to plain ones, which can be written as JSON."""
        if self.every < 1 or self.every % 1:
            msg = f"every must be an integer of at least 1, got {self.every!r}"
            raise ConfigError(msg)
        object.__setattr__(self, "every", int(self.every))
        for name in ("start_s", "end_s"):
            seconds = getattr(self, name)
            if seconds is None:
                continue
            if not 0 <= seconds < math.inf:
                msg = f"{name} must be at least 0, got {seconds}"
                raise ConfigError(msg)
            object.__setattr__(self, name, float(seconds))
        if self.end_s is not None and self.end_s <= (self.start_s or 0):
            msg = f"end_s {self.end_s:g} is not after start_s {self.start_s or 0:g}"
            raise ConfigError(msg)

    def limits_ns(self, begin_ns: int) -> tuple[int | None, int | None]:
        """Return the log times (ns) of start and end in a recording that begins at ``begin_ns``.

        They are None where there is no limit.
        """
        start, end = (
            None if seconds is None else begin_ns + round(min(seconds * 1e9, _FAR_NS))
            for seconds in (self.start_s, self.end_s)
        )
        return start, end


ALL_FRAMES = FrameRange()


def frames(
    recording: Recording,
    streams: Sequence[Stream],
    frame_range: FrameRange = ALL_FRAMES,
    *,
    skipped: Counter[str] | None = None,
    callbacks: Mapping[str, Callable[[Message], None]] | None = None,
    needed: Needed = None,
) -> Iterator[Frame]:
    """Read the frames of depth streams in constant memory.

    An organized cloud that fits a pinhole camera becomes the depth image it was made from, so that
    both forms of the same data give the same frame.

    Parameters
    ----------
    skipped : receives the number of unreadable frames by reason, which raise no error.
    callbacks : for some topics, a function to call with each message of the topic.
    needed : returns whether a frame, or a message for ``callbacks``, is needed, given its topic and
        log time (ns). Others may be left out if the recording has an index. None if all are needed.

    Yields
    ------
    Frames in the order of their messages, except that a depth image waits for its calibration.
    Their ``index`` counts the messages of their stream, from 0 at ``start_s``.
    """
    if skipped is None:
        skipped = Counter()
    sources: dict[str, FrameSource] = {
        stream.topic: SOURCES[stream.kind](recording, stream, skipped) for stream in streams
    }
    infos: dict[str, list[DepthSource]] = {}
    for source in sources.values():
        if isinstance(source, DepthSource):
            infos.setdefault(source.info_topic, []).append(source)
    callbacks = callbacks or {}

    def is_needed(topic: str, log_time_ns: int) -> bool:
        return needed is None or topic in infos or needed(topic, log_time_ns)

    counts: Counter[str] = Counter()  # messages of each stream so far
    topics = {*sources, *infos, *callbacks}
    start_ns, end_ns = frame_range.limits_ns(recording.start_ns)
    for message in recording.messages(topics, start_ns, end_ns, is_needed):
        # A message has no data if it is not needed, or if it is damaged.
        unread = not message.data and not is_needed(message.topic, message.log_time_ns)
        if message.topic in callbacks and message.data:
            callbacks[message.topic](message)
        for depth in infos.get(message.topic, ()) if message.data else ():
            yield from depth.calibrate(message)
        chosen = sources.get(message.topic)
        if chosen is not None and message.type == chosen.stream.type:
            index = counts[message.topic]
            counts[message.topic] += 1
            if index % frame_range.every == 0 and not unread:
                yield from chosen.read(message, index)
    for source in sources.values():
        yield from source.finish()
        if needed is None:  # otherwise it has not seen every stamp
            source.clock.report()
