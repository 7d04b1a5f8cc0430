"""Read the stamps of messages, and warn about unreliable clocks."""

from contextlib import suppress
from functools import cached_property
from itertools import islice
from typing import Any

from shapecat.recordings.messages import MALFORMED, MessageError
from shapecat.recordings.recording import Recording

__all__ = ["Clock", "delay_ns", "stamp_ns"]

_EPOCH_NS = 946_684_800 * 10**9
"""1 January 2000: earlier stamps probably count from when the sensor was switched on."""
_JUMP_NS = 10 * 10**9
"""Smallest change of the delay between stamp and log time that counts as a jump."""
_FIRST = 5
"""Number of messages that `delay_ns` searches for a stamp other than 0."""


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


def delay_ns(recording: Recording, topic: str) -> int:
    """Return log time minus stamp (ns) for the first message of a topic with a stamp other than 0.

    A missing stamp can be estimated as the log time minus this delay. That works for any clock,
    such as one that counts from the start of a simulation. The delay is 0 if the stamps of the
    first messages are all 0.
    """
    for message in islice(recording.messages([topic]), _FIRST):
        with suppress(MessageError, *MALFORMED):
            stamp = stamp_ns(recording.decode(message).header)
            if stamp:
                return message.log_time_ns - stamp
    return 0


class Clock:
    """Replaces missing stamps on one topic, and counts suspicious ones."""

    def __init__(self, recording: Recording, topic: str) -> None:
        """Prepare to check the stamps of a topic; `report` adds warnings to ``recording``."""
        self.recording, self.topic = recording, topic
        self.last: int | None = None
        self.delay: int | None = None
        self.counts = dict.fromkeys(_TEXTS, 0)

    def check(self, stamp: int, log_time: int) -> int:
        """Return the stamp of the next message, or an estimate if it is 0; count suspicious stamps.

        The estimate is the log time minus the `delay_ns` of the topic. All times are nanoseconds.
        """
        if stamp == 0:
            self.counts["zero"] += 1
            return max(log_time - self._delay_ns, 0)
        self.counts["epoch"] += stamp < _EPOCH_NS <= log_time
        self.counts["same"] += stamp == self.last
        self.counts["back"] += self.last is not None and stamp < self.last
        delay = log_time - stamp
        self.counts["jump"] += self.delay is not None and abs(delay - self.delay) > _JUMP_NS
        self.last, self.delay = stamp, delay
        return stamp

    @cached_property
    def _delay_ns(self) -> int:
        return delay_ns(self.recording, self.topic)

    def report(self) -> None:
        """Add warnings about suspicious stamps to the recording."""
        for name, count in self.counts.items():
            if count:
                self.recording.warn(f"{self.topic}: {_TEXTS[name].format(count)}")


_TEXTS = {
    "zero": "header.stamp is 0 ({}×): it is estimated from the log time",
    "epoch": "header.stamp is not Unix time ({}×): transforms may not match",
    "same": "header.stamp repeats the previous one ({}×): poses and tracks may be wrong",
    "back": "header.stamp goes backwards ({}×)",
    "jump": "header.stamp jumps relative to the log time ({}×)",
}
