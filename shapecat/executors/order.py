"""Items worked on in several processes, or read ahead in a thread, in their order."""

import logging
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from multiprocessing import current_process
from typing import Generic, Self, TypeVar

from shapecat.executors.local import LocalExecutor

__all__ = ["Processes", "map_ahead", "read_ahead"]

_log = logging.getLogger(__name__)

_Kept = TypeVar("_Kept")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_ALONE = 1
"""Items worked on before other processes are started, which a short run can do without."""
_AWAY = 2
"""Items sent to each other process: one to work on, one to go on with."""
_HELD = 8
"""Results held at most, which wait for one that another process works on."""
_SWITCH_S = 5e-4
"""A thread back from a kernel waits no longer than this for the interpreter lock."""


class Processes(Generic[_Item, _Result]):
    """Several processes, of which this is one, that share the items of one piece of work.

    This one works along: while the others come up, and whenever all are busy. What another fails
    at, because it was killed or ran out of memory, is done here.

    Examples
    --------
    >>> with Processes(abs, 1) as processes:
    ...     list(processes.in_order([("a", -2), ("b", 1)]))
    [('a', 2), ('b', 1)]
    """

    def __init__(self, work: Callable[[_Item], _Result], count: int) -> None:
        """Prepare ``count`` processes; the others end with the block.

        Parameters
        ----------
        work : is sent to spawned processes, as the items are: picklable, and a script needs the
            usual ``if __name__ == "__main__"``. A daemonic process may have no others.
        """
        self._work = work
        self._others = 0 if current_process().daemon else max(0, count - 1)
        self._executor: LocalExecutor | None = None
        self._waking: list[Future[None]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """End the others, whatever they do."""
        if self._executor is not None:
            self._executor.terminate()

    def start(self) -> None:
        """Start the others now, not with the first items: they take seconds to come up."""
        if self._others and self._executor is None:
            self._executor = LocalExecutor(self._others)
            for _ in range(self._others):
                self._waking.append(self._executor.submit(_wake, self._work))

    def in_order(self, items: Iterable[tuple[_Kept, _Item]]) -> Iterator[tuple[_Kept, _Result]]:
        """Yield what the work makes of each item, in the order of the items, with what is kept.

        Parameters
        ----------
        items : pairs of what is kept here and what is worked on; held only until it is done.
        """
        source = iter(items)
        for kept, item in islice(source, _ALONE if self._others else None):
            yield kept, self._work(item)
        self.start()
        pending: deque[tuple[_Kept, Future[_Result]]] = deque()
        away: list[Future[_Result]] = []
        with _switching():
            for kept, item in source:
                away = [future for future in away if not future.done()]
                future = self._submit(item, len(away))
                if not future.done():
                    away.append(future)
                pending.append((kept, future))
                while pending and (pending[0][1].done() or len(pending) > _HELD):
                    first, future = pending.popleft()
                    yield first, future.result()
            for first, future in pending:
                yield first, future.result()

    def _submit(self, item: _Item, away: int) -> Future[_Result]:
        """Send an item to another process if one has come up and is free, else work on it."""
        awake = sum(future.done() for future in self._waking)
        if self._executor is None or away >= _AWAY * awake:
            return _done(self._work, item)
        return _sent(self._executor, self._work, item)


def _wake(_work: object) -> None:
    """Do nothing: to have received ``work`` is to have loaded what it needs."""


def _done(work: Callable[[_Item], _Result], item: _Item) -> Future[_Result]:
    result: Future[_Result] = Future()
    try:
        result.set_result(work(item))
    except Exception as error:  # noqa: BLE001  raised when its turn comes
        result.set_exception(error)
    return result


def _sent(executor: Executor, work: Callable[[_Item], _Result], item: _Item) -> Future[_Result]:
    result: Future[_Result] = Future()

    def settle(sent: Future[_Result]) -> None:
        if sent.cancelled():
            return
        own = sent
        if error := sent.exception():
            _log.warning("another process failed (%s): going on without its result", error)
            own = _done(work, item)
        if error := own.exception():
            result.set_exception(error)
        else:
            result.set_result(own.result())

    executor.submit(work, item).add_done_callback(settle)
    return result


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


def map_ahead(
    function: Callable[[_Item], _Result], items: Iterable[_Item], *, threads: int
) -> Iterator[_Result]:
    """Yield what a function makes of items, in their order, worked on in threads ahead.

    Worth it for a function that spends its time in kernels, which do not hold the interpreter lock.

    Parameters
    ----------
    threads : with one, all is done here when it is asked for.

    Examples
    --------
    >>> list(map_ahead(abs, [-1, 2, -3], threads=2))
    [1, 2, 3]
    """
    if threads < 2:
        yield from map(function, items)
        return
    with _switching(), ThreadPoolExecutor(threads) as pool:
        pending: deque[Future[_Result]] = deque()
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > 2 * threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextmanager
def _switching() -> Iterator[None]:
    """Let threads switch more often than every 5 ms: most kernels take less time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
