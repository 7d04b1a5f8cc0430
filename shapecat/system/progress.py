"""Progress of long work, reported to the caller."""

from collections.abc import Callable

__all__ = ["Observer", "ignore"]

Observer = Callable[[str, int, int | None], None]
"""Called with the phase, the number of items done, and the total (None if unknown)."""


def ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Ignore the progress."""
