"""Read the messages that frames look up by time, such as transforms, shortly before each frame.

The transforms and accelerations of hours would fill the memory, and reading them all first would
delay the first frame.
"""

from collections.abc import Callable, Collection, Iterator

from shapecat.recordings.messages import Message
from shapecat.recordings.recording import Recording

__all__ = ["AROUND_NS", "LookAhead", "reads_all_first"]

AROUND_NS = 10_000_000_000
"""Messages are read this long before and after a frame. Drivers log a message at most seconds after
its stamp, and publish transforms more often than this."""


def reads_all_first(recording: Recording) -> bool:
    """Return whether to read all messages at the start: the recording is short or has no index."""
    return recording.end_ns - recording.start_ns <= 2 * AROUND_NS or not recording.indexed


class LookAhead:
    """Passes messages of some topics to a callback, from 10 s before each frame to 10 s after it.

    Attributes
    ----------
    whole : whether all messages are passed on, regardless of the frames. This is so if
        `reads_all_first`, or after `read_all`.
    """

    def __init__(
        self,
        recording: Recording,
        topics: Collection[str],
        take: Callable[[Message], None],
        forget: Callable[[int], None],
        *,
        skips: bool = True,
    ) -> None:
        """Pass on the first messages, or all if `reads_all_first`.

        Parameters
        ----------
        take : called with each message, in the order of the recording.
        forget : called with a stamp (ns) when messages with earlier stamps may be forgotten, except
            for the last of them.
        skips : whether messages in a long gap between two frames may be left out.
        """
        self._recording, self._topics = recording, topics
        self._take, self._forget, self._skips = take, forget, skips
        self._stamp_ns: int | None = None
        self._forgotten_ns = self._reached_ns = 0
        self.whole = reads_all_first(recording)
        self._read_from(recording.start_ns)

    def read_all(self) -> None:
        """Pass on all remaining messages; from now on, forget none."""
        self.whole = True
        self._read_until(None)

    def advance(self, log_time_ns: int, stamp_ns: int) -> None:
        """Pass on the messages around a frame, given its log time and stamp in nanoseconds."""
        if self.whole:
            return
        # The frames begin later, or have a gap.
        if self._skips and log_time_ns > self._reached_ns + AROUND_NS:
            self._read_from(log_time_ns - AROUND_NS)
        self._read_until(log_time_ns + AROUND_NS)
        # The earlier of two stamps, since one may be wrong.
        before = stamp_ns if self._stamp_ns is None else min(stamp_ns, self._stamp_ns)
        before, self._stamp_ns = before - 2 * AROUND_NS, stamp_ns
        if abs(before - self._forgotten_ns) > AROUND_NS:
            self._forgotten_ns = before
            self._forget(before)

    def _read_from(self, log_time_ns: int) -> None:
        """Restart reading at a log time (ns), and pass on the next 10 s, or all if ``whole``."""
        start = None if self.whole else log_time_ns
        self._messages: Iterator[Message] = (
            self._recording.messages(self._topics, start_ns=start) if self._topics else iter(())
        )
        self._next = next(self._messages, None)
        self._read_until(None if self.whole else log_time_ns + AROUND_NS)

    def _read_until(self, log_time_ns: int | None) -> None:
        """Pass on the messages up to a log time (ns), or all if it is None."""
        while self._next is not None and (
            log_time_ns is None or self._next.log_time_ns <= log_time_ns
        ):
            self._take(self._next)
            self._next = next(self._messages, None)
        reached_ns = self._recording.end_ns if log_time_ns is None else log_time_ns
        self._reached_ns = max(self._reached_ns, reached_ns)
