"""The delays from the stamps of messages to their log times, which tell how clocks differ."""

from array import array

import numpy as np

from shapecat.arrays import F8, I4

__all__ = ["Delays"]

_MOST = 1000
"""Largest number of delays to keep."""


class Delays:
    """Log time minus stamp of at most 1000 messages, spread evenly over those added so far."""

    def __init__(self) -> None:
        """Start without delays."""
        self._log_times, self._delays = array("q"), array("q")
        self._count, self._step = 0, 1

    def add(self, log_time_ns: int, stamp_ns: int) -> bool:
        """Add the delay of a message; return whether it is kept, for the time being."""
        kept = self._count % self._step == 0
        self._count += 1
        if kept:
            self._log_times.append(log_time_ns)
            self._delays.append(log_time_ns - stamp_ns)
        if len(self._delays) > _MOST:
            del self._log_times[1::2], self._delays[1::2]
            self._step *= 2
        return kept

    @property
    def all_zero(self) -> bool:
        """Whether all delays are 0, or there are none: log times may be copies of the stamps."""
        return not any(self._delays)

    def at(self, log_times_ns: I4) -> F8:
        """Return delays interpolated at log times, both (n,), ns; at least one must be known."""
        order = np.argsort(self._log_times, kind="stable")
        known = np.array(self._log_times)[order], np.array(self._delays)[order]
        return np.asarray(np.interp(log_times_ns, *known))
