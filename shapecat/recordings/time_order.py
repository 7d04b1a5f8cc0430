"""Messages of overlapping chunks, sorted by time in little memory."""

from collections.abc import Callable, Iterable, Iterator
from heapq import heappop, heappush
from typing import NamedTuple, TypeVar

__all__ = ["Timed", "in_time_order"]

_PENDING = 512 << 20
"""Bytes of messages held back to bring overlapping chunks in order."""

_C = TypeVar("_C")
_M = TypeVar("_M")


class Timed(NamedTuple):
    """When something is, in nanoseconds, and how many bytes it holds."""

    time: int
    size: int


def in_time_order(
    chunks: Iterable[tuple[int, int, _C]],
    read: Callable[[_C], Iterator[tuple[Timed, _M]]],
) -> Iterator[_M]:
    """Merge the messages of chunks by time; ties in the order of the file.

    Parameters
    ----------
    chunks : time of the first message, position in the file, and the chunk.
    read : yields the messages of a chunk; called when the chunk is due.
    """
    waiting = sorted(chunks, key=lambda chunk: chunk[:2], reverse=True)
    heap: list[tuple[int, int, int, int, _M]] = []
    pending = 0
    while waiting or heap:
        due = waiting and (not heap or waiting[-1][0] <= heap[0][0])
        if due and (not heap or pending < _PENDING):
            _, position, chunk = waiting.pop()
            for number, (timed, message) in enumerate(read(chunk)):
                heappush(heap, (timed.time, position, number, timed.size, message))
                pending += timed.size
            continue
        *_, size, message = heappop(heap)
        pending -= size
        yield message
