"""Items worked on in several processes, or read ahead in a thread, in their order."""

import logging
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from multiprocessing import current_process
from typing import TypeVar

from shapecat.executors.local import LocalExecutor

__all__ = ["in_order", "read_ahead"]

_log = logging.getLogger(__name__)

_Kept = TypeVar("_Kept")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_ALONE = 8
"""Items worked on before other processes are started, which a short run can do without."""
_AWAY = 2
"""Items sent to each other process: one to work on, one to go on with."""
_HELD = 64
"""Results held at most, which wait for one that another process works on."""
_SWITCH_S = 5e-4
"""A thread back from a kernel waits no longer than this for the interpreter lock."""


def in_order(
    work: Callable[[_Item], _Result], items: Iterable[tuple[_Kept, _Item]], *, processes: int
) -> Iterator[tuple[_Kept, _Result]]:
    """Yield what ``work`` makes of each item, in the order of the items, with what is kept of it.

    This process works along: on the first items, and whenever all others are busy. What another
    fails at, because it was killed or ran out of memory, is done here. ``work`` and the items are
    sent to spawned processes, so they must be picklable, and a script needs the usual
    ``if __name__ == "__main__"``. A daemonic process may have no others and works alone.

    Parameters
    ----------
    items : pairs of what is kept here and what is worked on; held only until it is done.
    processes : this one included.

    Examples
    --------
    >>> list(in_order(abs, [("a", -2), ("b", 1)], processes=1))
    [('a', 2), ('b', 1)]
    """
    source = iter(items)
    alone = processes <= 1 or current_process().daemon
    for kept, item in source if alone else islice(source, _ALONE):
        yield kept, work(item)
    if alone:
        return
    pending: deque[tuple[_Kept, Future[_Result]]] = deque()
    away: list[Future[_Result]] = []
    with _other_processes(processes - 1) as executor:
        waking = [executor.submit(_wake, work) for _ in range(processes - 1)]
        for kept, item in source:
            away = [future for future in away if not future.done()]
            if len(away) < _AWAY * sum(future.done() for future in waking):
                future = _sent(executor, work, item)
                away.append(future)
            else:
                future = _done(work, item)
            pending.append((kept, future))
            while pending and (pending[0][1].done() or len(pending) > _HELD):
                first, future = pending.popleft()
                yield first, future.result()
        for first, future in pending:
            yield first, future.result()


@contextmanager
def _other_processes(count: int) -> Iterator[Executor]:
    """Start as many processes as there is work for, and end them whatever they do."""
    executor = LocalExecutor(count)
    try:
        with _switching():
            yield executor
    finally:
        executor.terminate()


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


@contextmanager
def _switching() -> Iterator[None]:
    """Let threads take turns more often than every 5 ms, longer than most kernels take."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
