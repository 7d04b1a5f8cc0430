"""Threads that leave the order as it is, and hold a few items at a time."""

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

__all__ = ["in_order", "read_ahead"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_HELD = 4
"""Items held for each thread: they go on while the results of a batch are written."""
_SWITCH_S = 5e-4
"""A thread back from a kernel waits no longer than this for the interpreter lock."""


def in_order(
    work: Callable[[_Item], _Result], items: Iterable[_Item], *, threads: int
) -> Iterator[tuple[_Item, _Result]]:
    """Yield each item with what ``work`` makes of it, in the order of the items.

    With several threads some items are worked on at once, and four times as many as threads at
    most are held, however many there are. Threads pay because the kernels release the interpreter
    lock.

    Examples
    --------
    >>> list(in_order(abs, [-2, 1], threads=2))
    [(-2, 2), (1, 1)]
    """
    if threads <= 1:
        for item in items:
            yield item, work(item)
        return
    pending: deque[tuple[_Item, Future[_Result]]] = deque()
    with _switching(), ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append((item, pool.submit(work, item)))
                if len(pending) >= _HELD * threads:
                    first, future = pending.popleft()
                    yield first, future.result()
            while pending:
                first, future = pending.popleft()
                yield first, future.result()
        finally:
            for _, future in pending:
                future.cancel()


def read_ahead(items: Iterable[_Item], *, count: int) -> Iterator[_Item]:
    """Yield the items, of which the next ``count`` are made in a thread meanwhile.

    Examples
    --------
    >>> list(read_ahead(range(3), count=2))
    [0, 1, 2]
    """
    source = iter(items)

    def take() -> tuple[_Item, ...]:
        return tuple(islice(source, 1))

    with _switching(), ThreadPoolExecutor(1) as pool:
        pending = deque(pool.submit(take) for _ in range(count))
        while taken := pending.popleft().result():
            pending.append(pool.submit(take))
            yield taken[0]


@contextmanager
def _switching() -> Iterator[None]:
    """Let threads take turns more often than every 5 ms, longer than most kernels take."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
