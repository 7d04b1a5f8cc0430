"""Progress of long work, reported to the caller."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from shapecat.system import stopping

__all__ = ["COMPILE", "WAIT_FOR_KERNELS", "Observer", "ignore", "kernel_words", "observed"]

_Item = TypeVar("_Item")

Observer = Callable[[str, int, int | None], None]
"""A function called with the phase, the number of items done, and the total (None if unknown)."""

COMPILE, WAIT_FOR_KERNELS = "compile", "wait for kernels"
"""The phases in which this process or another one compiles kernels; the items are kernels."""


def ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Ignore the progress: the `Observer` of callers that do not want it."""


def observed(
    items: Iterable[_Item], phase: str, total: int | None, observe: Observer
) -> Iterator[_Item]:
    """Yield items, and report the progress after each; raise `Stopped` if a signal asked to stop.

    Examples
    --------
    >>> list(observed("ab", "spell", 2, print))
    spell 1 2
    spell 2 2
    ['a', 'b']
    """
    for done, item in enumerate(items, start=1):
        stopping.check()
        yield item
        observe(phase, done, total)


def kernel_words(phase: str, done: int) -> str:
    """Return the progress of `COMPILE` or `WAIT_FOR_KERNELS` as text; ``done`` counts kernels.

    Examples
    --------
    >>> kernel_words(COMPILE, 120)
    '120 kernels compiled'
    """
    if phase == WAIT_FOR_KERNELS:
        return f"waiting for another process that compiles kernels: {done} compiled"
    if not done:
        return "compiling kernels, once per installation: about a minute"
    return f"{done} kernels compiled"
