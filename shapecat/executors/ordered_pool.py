"""A pool of processes that yields the results in order."""

import logging
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing import current_process
from typing import Generic, Self, TypeVar

from shapecat.executors.local import LocalExecutor

__all__ = ["OrderedPool"]

_log = logging.getLogger(__name__)

_Context = TypeVar("_Context")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_ITEMS_BEFORE_START = 1
"""Items processed here before other processes are started: a short run needs none."""
_SENT_AHEAD = 1
"""Items sent to a busy process in advance."""
_MOST_PER_PROCESS = 3
"""Maximum number of items per other process: the one it works on, one sent in advance, and one
waiting here. A thread sends it as soon as there is room, even while this process works."""
_MOST_PENDING = 8
"""At most this many items are in progress, or wait for the result of an earlier one."""
_SWITCH_S = 5e-4
"""A thread that returns from a kernel waits no longer than this for the interpreter lock."""


class OrderedPool(Generic[_Item, _Result]):
    """Several processes, including this one, that share the items of one job.

    This process works on items while the others start, and whenever all of them are busy. It also
    repeats items at which another process fails, for example out of memory.

    Examples
    --------
    >>> with OrderedPool(abs, 1) as pool:
    ...     list(pool.in_order([("a", -2), ("b", 1)]))
    [('a', 2), ('b', 1)]
    """

    def __init__(
        self, work: Callable[[_Item], _Result], count: int, warm_up: Callable[[], object] = object
    ) -> None:
        """Prepare ``count`` processes, including this one; the others end with the block.

        Parameters
        ----------
        work : called with each item. Since other processes are spawned, it and the items must be
            picklable, and a script needs ``if __name__ == "__main__":``.
        count : number of processes; a daemonic process, which may start no others, works alone.
        warm_up : called in each other process before its first item.
        """
        self._work, self._warm_up = work, warm_up
        self._others = 0 if current_process().daemon else max(0, count - 1)
        self._executor: LocalExecutor | None = None
        self._warming_up: list[Future[None]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Kill the worker processes."""
        if self._executor is not None:
            self._executor.terminate()

    def start(self) -> None:
        """Start the other processes now, not after the first item: starting takes seconds."""
        if self._others and self._executor is None:
            self._executor = LocalExecutor(self._others, ahead=_SENT_AHEAD)
            for _ in range(self._others):
                self._warming_up.append(self._executor.submit(_warm_up, self._work, self._warm_up))

    def in_order(
        self, items: Iterable[tuple[_Context, _Item]]
    ) -> Iterator[tuple[_Context, _Result]]:
        """Yield ``(context, work(item))`` for each pair ``(context, item)``, in order.

        Parameters
        ----------
        items : pairs of a value that stays in this process and an item to work on.
        """
        source = iter(items)
        if self._executor is None:
            for context, item in islice(source, _ITEMS_BEFORE_START if self._others else None):
                yield context, self._work(item)
            self.start()
        pending: deque[tuple[_Context, _Pending[_Item, _Result]]] = deque()
        with _frequent_thread_switches():
            for context, item in source:
                pending.append((context, self._begin(item, [each for _, each in pending])))
                while pending and (pending[0][1].done() or len(pending) > _MOST_PENDING):
                    first_context, first = pending.popleft()
                    yield first_context, first.result()
            for _, each in reversed(pending):
                each.recall()
            for context, each in pending:
                yield context, each.result()

    def _begin(
        self, item: _Item, pending: Sequence["_Pending[_Item, _Result]"]
    ) -> "_Pending[_Item, _Result]":
        """Send an item to another process if one has started and has room, else work on it here.

        ``pending`` are the earlier items whose results have not been yielded.
        """
        started = sum(future.done() for future in self._warming_up)
        unfinished = sum(not each.done() for each in pending)
        has_room = unfinished < _MOST_PER_PROCESS * started
        return _Pending(self._work, item, self._executor if has_room else None)


class _Pending(Generic[_Item, _Result]):
    """The work on one item, in another process or in this one."""

    def __init__(
        self, work: Callable[[_Item], _Result], item: _Item, executor: Executor | None
    ) -> None:
        """Send the item, or work on it here if there is no executor."""
        self._work = work
        self._item: list[_Item] = []  # kept only while another process has it
        self._future: Future[_Result]
        if executor is None:
            self._future = _done(work, item)
        else:
            self._item.append(item)
            self._future = executor.submit(work, item)
            # Futures keep their callbacks: a bound method would keep the result forever.
            self._future.add_done_callback(partial(_drop_finished, self._item))

    def done(self) -> bool:
        """Return whether the work is finished."""
        return self._future.done()

    def recall(self) -> None:
        """Work on the item here if it has not been sent yet."""
        if self._item and self._future.cancel():
            self._future = _done(self._work, self._item.pop())

    def result(self) -> _Result:
        """Return the result; work on the item here if it was not sent or another process failed."""
        self.recall()
        error = self._future.exception()
        if error is None or not self._item:
            return self._future.result()
        _log.warning("another process failed (%s): repeating its work here", error)
        return self._work(self._item[0])


def _drop_finished(item: list[_Item], future: Future[_Result]) -> None:
    """Empty ``item``, the list that holds the item of ``future``, if there is a result."""
    if not future.cancelled() and future.exception() is None:
        item.clear()


def _warm_up(_work: object, warm_up: Callable[[], object]) -> None:
    """Call ``warm_up``. The work is an argument only because unpickling it imports its modules."""
    warm_up()


def _done(work: Callable[[_Item], _Result], item: _Item) -> Future[_Result]:
    result: Future[_Result] = Future()
    try:
        result.set_result(work(item))
    except Exception as error:  # noqa: BLE001  raised by `result`
        result.set_exception(error)
    return result


@contextmanager
def _frequent_thread_switches() -> Iterator[None]:
    """Let threads switch more often than every 5 ms, since most kernels take less time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
