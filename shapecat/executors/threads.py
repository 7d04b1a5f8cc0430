"""Threads that leave the order as it is, and hold a few items at a time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

__all__ = ["in_order", "read_ahead"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_order(
    work: Callable[[_Item], _Result], items: Iterable[_Item], *, threads: int
) -> Iterator[tuple[_Item, _Result]]:
    """Yield each item with what ``work`` makes of it, in the order of the items.

    With several threads some items are worked on at once, and twice as many as threads at most
    are held, however many there are. Threads pay because the kernels release the interpreter
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
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append((item, pool.submit(work, item)))
                if len(pending) >= 2 * threads:
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

    with ThreadPoolExecutor(1) as pool:
        pending = deque(pool.submit(take) for _ in range(count))
        while taken := pending.popleft().result():
            pending.append(pool.submit(take))
            yield taken[0]
