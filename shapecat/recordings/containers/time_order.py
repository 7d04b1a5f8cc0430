"""Sort the messages of overlapping chunks by time, in little memory."""

from collections.abc import Callable, Iterable, Iterator
from heapq import heappop, heappush
from typing import NamedTuple, TypeVar

__all__ = ["Timed", "in_time_order"]

_PENDING = 512 << 20
"""Once this many bytes of messages are held back, no further chunk is read ahead."""

_C = TypeVar("_C")
_M = TypeVar("_M")


class Timed(NamedTuple):
    """The log time of a message in nanoseconds, and its size in bytes."""

    time: int
    size: int


def in_time_order(
    chunks: Iterable[tuple[int, int, _C]],
    read: Callable[[_C], Iterator[tuple[Timed, _M]]],
) -> Iterator[_M]:
    """Yield the messages of all chunks by time, in file order if times are equal.

    While more than `_PENDING` bytes are held back no further chunk is read: then the messages of
    overlapping chunks may come out of order.

    Parameters
    ----------
    chunks : time of the first message (ns), offset in the file, and chunk.
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
