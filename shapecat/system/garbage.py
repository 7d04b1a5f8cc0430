"""Make the processes of this program collect garbage less often."""

import atexit
import gc

__all__ = ["collect_seldom"]

_ALLOCATIONS = 100_000
"""Allocations between two collections. The libraries alone hold 230,000 objects, and with Python's
default of 700, walking them takes 3 % of a run."""


def collect_seldom() -> None:
    """Collect garbage rarely, since frames leave hardly any reference cycles.

    At the end of the process, no garbage is collected: that would take 0.6 s.
    """
    gc.set_threshold(_ALLOCATIONS)
    atexit.register(gc.freeze)
