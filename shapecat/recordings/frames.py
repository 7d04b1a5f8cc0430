"""Read the frames of a recording in order."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

from shapecat.recordings.messages import Message, Needed
from shapecat.recordings.recording import Recording
from shapecat.recordings.sources import SOURCES, DepthSource, Source
from shapecat.recordings.streams import Stream
from shapecat.types import Frame

__all__ = ["frames"]

_FAR_NS = 2**62
"""A century: later times would not fit into the integers of a database."""


def frames(
    recording: Recording,
    streams: Sequence[Stream],
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    every: int = 1,
    skipped: Counter[str],
    callbacks: Mapping[str, Callable[[Message], None]] | None = None,
    needed: Needed = None,
) -> Iterator[Frame]:
    """Read the frames of depth streams in constant memory.

    An organized cloud that fits a pinhole camera becomes the depth image it was made from, so that
    both forms of the same data give the same frame.

    Parameters
    ----------
    start_s, end_s : log time from the start of the recording, seconds; None for no limit.
    every : keep every n-th message of a stream.
    skipped : receives the number of unreadable frames by reason; they raise no error.
    callbacks : callbacks for the messages of other topics, so that the file is read only once.
    needed : function of topic and log time (ns) that returns whether that frame, or message for
        ``callbacks``, is needed; from an indexed file, the rest may be left out.

    Yields
    ------
    Frames by log time. ``index`` counts the stream's messages from 0 at ``start_s``.

    Raises
    ------
    ValueError : ``every`` is not positive.
    """
    if every < 1:
        msg = f"every must be at least 1, got {every}"
        raise ValueError(msg)
    sources: dict[str, Source] = {
        stream.topic: SOURCES[stream.kind](recording, stream, skipped) for stream in streams
    }
    infos: dict[str, list[DepthSource]] = {}
    for source in sources.values():
        if isinstance(source, DepthSource):
            infos.setdefault(source.info_topic, []).append(source)
    offsets = [None if s is None else round(min(s * 1e9, _FAR_NS)) for s in (start_s, end_s)]
    limits = [None if offset is None else recording.start_ns + offset for offset in offsets]
    callbacks = callbacks or {}

    def is_needed(topic: str, log_time_ns: int) -> bool:
        return needed is None or topic in infos or needed(topic, log_time_ns)

    counts: Counter[str] = Counter()  # messages of each stream so far
    topics = {*sources, *infos, *callbacks}
    for message in recording.messages(topics, limits[0], limits[1], is_needed):
        # Messages that are not needed have no data, and neither have those that damage destroyed.
        unread = not message.data and not is_needed(message.topic, message.log_time_ns)
        if message.topic in callbacks and message.data:
            callbacks[message.topic](message)
        for depth in infos.get(message.topic, ()) if message.data else ():
            yield from depth.calibrate(message)
        chosen = sources.get(message.topic)
        if chosen is not None and message.type == chosen.stream.type:
            index = counts[message.topic]
            counts[message.topic] += 1
            if index % every == 0 and not unread:
                yield from chosen.read(message, index)
    for source in sources.values():
        yield from source.finish()
        if needed is None:  # otherwise it has not seen every stamp
            source.clock.report()
