"""How often the processes of this program look for unreachable objects."""

import gc

__all__ = ["collect_seldom"]

_MADE = 100_000
"""Objects made between two searches. The libraries alone hold 230,000, which Python, with its 700,
walks so often that it is 3 % of a run."""


def collect_seldom() -> None:
    """Search for garbage seldom: frames leave next to none that has to be searched for."""
    gc.set_threshold(_MADE)
