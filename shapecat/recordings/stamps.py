"""Read the stamps of messages, and warn about unreliable clocks."""

from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from statistics import median
from typing import Any

from shapecat.recordings.messages import MALFORMED, MessageError
from shapecat.recordings.recording import Recording

__all__ = ["Clock", "Estimates", "stamp_ns"]

_EPOCH_NS = 946_684_800 * 10**9
"""1 January 2000: earlier stamps probably count from when the sensor was switched on."""
_DIFFERENT_S = 0.3
"""Smallest difference from the delay of another topic that is reported. Drivers differ by less."""
_JUMP_NS = 10 * 10**9
"""Smallest change of the delay between stamp and log time that counts as a jump."""
_COMPARED = 64
"""Number of the latest comparisons with another topic on which a warning is based."""
_ENDED_NS = 100_000_000
"""A topic may have ended if its last message was logged this long before that of another topic."""
_SIMULATED = "rosgraph_msgs/msg/Clock"
"""Type of the messages with the time of a simulation."""
_FIRST = 20
"""Number of messages of a topic that `Estimates` searches for stamps. A simulation begins at 0, and
so do the stamps of its first transforms."""


def stamp_ns(header: Any) -> int:
    """Return the stamp of a decoded std_msgs/Header in nanoseconds.

    Raises
    ------
    MessageError : the stamp is negative, or does not fit in 63 bits.
    """
    stamp = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
    if not 0 <= stamp < 2**63:
        msg = f"invalid header.stamp: {stamp:.3g} ns"
        raise MessageError(msg)
    return stamp


class Estimates:
    """Estimates missing stamps: the log time minus the delay of the first message with a stamp.

    That works for any clock, such as one that counts from the start of a simulation.

    Attributes
    ----------
    unknown : the topics whose first messages have no stamp; the log time replaces theirs.
    """

    def __init__(self, recording: Recording) -> None:
        """Prepare estimates; a topic is searched when a stamp is missing for the first time."""
        self._recording = recording
        self._delays: dict[str, int] = {}
        self.unknown: set[str] = set()

    def stamp_ns(self, topic: str, log_time_ns: int) -> int:
        """Return an estimate of a message's stamp, ns; the log time if no stamp was found."""
        if topic not in self._delays:
            delay = next(self._delays_of(topic), None)
            if delay is None:
                self.unknown.add(topic)
            self._delays[topic] = delay or 0
        return max(log_time_ns - self._delays[topic], 0)

    def _delays_of(self, topic: str) -> Iterator[int]:
        """Yield log time minus stamp (ns) for each stamp in the first messages of a topic."""
        for message in islice(self._recording.messages([topic]), _FIRST):
            with suppress(MessageError, *MALFORMED):
                decoded = self._recording.decode(message)
                for part in getattr(decoded, "transforms", [decoded]):
                    if stamp := stamp_ns(part.header):
                        yield message.log_time_ns - stamp


class Clock:
    """Replaces missing stamps on one topic, and counts suspicious ones."""

    def __init__(self, recording: Recording, topic: str) -> None:
        """Prepare to check the stamps of a topic; `report` adds warnings to ``recording``."""
        self.recording, self.topic = recording, topic
        self.last: int | None = None
        self.delay: int | None = None
        self.counts = dict.fromkeys(_TEXTS, 0)
        self.other = ""
        self._ahead: deque[int] = deque(maxlen=_COMPARED)
        self._estimates = Estimates(recording)

    def check(self, stamp: int, log_time: int) -> int:
        """Return the stamp of the next message, or an estimate if it is 0; count suspicious stamps.

        All times are nanoseconds.
        """
        if stamp == 0:
            self.counts["zero"] += 1
            return self._estimates.stamp_ns(self.topic, log_time)
        self.counts["epoch"] += stamp < _EPOCH_NS <= log_time
        self.counts["same"] += stamp == self.last
        self.counts["back"] += self.last is not None and stamp < self.last
        delay = log_time - stamp
        self.counts["jump"] += self.delay is not None and abs(delay - self.delay) > _JUMP_NS
        self.last, self.delay = stamp, delay
        return stamp

    def compare(self, topic: str, stamp: int, log_time: int) -> None:
        """Compare the latest delay with that of a message on another topic; times are nanoseconds.

        Once this topic may have ended, nothing is compared: in a slow simulation, delays grow.
        """
        if self.last is None or self.delay is None:
            return
        if log_time - self.last - self.delay < _ENDED_NS:
            self.other = topic
            self._ahead.append(log_time - stamp - self.delay)

    def report(self, *, colour: bool = False) -> None:
        """Add warnings about suspicious stamps to the recording.

        Simulated time is not suspicious if the recording has the clock of the simulation. On a
        topic of ``colour`` images, only two things are: missing stamps, and stamps far from those
        of the topic in `compare`.
        """
        names = {"zero"} if colour else set(_TEXTS)
        if any(topic.type == _SIMULATED for topic in self.recording.topics):
            names.discard("epoch")
        for name, count in self.counts.items():
            if count and name in names:
                self.recording.warn(f"{self.topic}: {_TEXTS[name].format(count)}")
        ahead_s = median(self._ahead or [0]) * 1e-9
        if abs(ahead_s) > _DIFFERENT_S:
            side = "ahead of" if ahead_s > 0 else "behind"
            self.recording.warn(
                f"{self.topic}: its stamps are {abs(ahead_s):.2f} s {side} those of {self.other} "
                "at the same log time: synchronize the clocks of the computers, or record it sooner"
            )


_TEXTS = {
    "zero": "header.stamp is 0 ({}×): it is estimated from the log time",
    "epoch": "header.stamp is not Unix time ({}×): transforms may not match",
    "same": "header.stamp repeats the previous one ({}×): poses and tracks may be wrong",
    "back": "header.stamp goes backwards ({}×): where it does by more than tracking.max_missed_s, "
    "as in a looped playback, all objects get new tracks",
    "jump": "header.stamp jumps relative to the log time ({}×)",
}
