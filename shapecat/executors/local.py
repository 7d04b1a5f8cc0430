"""Processes on this machine that outlive neither their parent nor spoil each other's work."""

import atexit
import io
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from shapecat.executors.cores import limited_threads
from shapecat.system import stopping

__all__ = ["LocalExecutor", "WorkerLostError"]

# Spawned, not forked: the threads of numeric and Rerun libraries do not survive a fork.
_SPAWN = get_context("spawn")
_SIGNALS = {signal.SIGINT, signal.SIGTERM}


class WorkerLostError(RuntimeError):
    """The process that worked on a task has died: killed, out of memory, or crashed."""


class _Task(NamedTuple):
    future: Future[Any]
    call: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


class LocalExecutor(Executor):
    """Runs tasks in spawned processes, as `concurrent.futures.ProcessPoolExecutor` does.

    It differs where a disk of recordings needs it to: a worker that dies fails its own task alone
    and is replaced, workers end when their parent does, however it ended, `stop` asks tasks to
    put their work down, and `terminate` does not wait for them. Signals reach the parent alone,
    which decides what they mean.
    """

    def __init__(self, workers: int, *, threads: int = 1) -> None:
        """Prepare ``workers`` processes; each starts with its first task.

        Parameters
        ----------
        threads : that numeric libraries may use in each process.

        Raises
        ------
        ValueError : there is not at least one worker.
        """
        if workers < 1:
            msg = f"workers must be at least 1, got {workers}"
            raise ValueError(msg)
        self._tasks: SimpleQueue[_Task | None] = SimpleQueue()
        self._threads = threads
        self._closed = False
        self._workers: dict[int, _Worker] = {}
        self._lock = threading.Lock()
        self._attendants = [
            threading.Thread(target=self._attend, args=(k,), daemon=True) for k in range(workers)
        ]
        for attendant in self._attendants:
            attendant.start()
        atexit.register(self.terminate)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a call; its future raises `WorkerLostError` if the worker dies.

        Raises
        ------
        RuntimeError : the executor was shut down.
        """
        if self._closed:
            msg = "cannot submit after shutdown"
            raise RuntimeError(msg)
        task = _Task(Future(), (fn, args, kwargs))
        self._tasks.put(task)
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as in the base class
        """Let the workers end when their tasks are done."""
        self._closed = True
        atexit.unregister(self.terminate)
        if cancel_futures:
            self._cancel_waiting()
        for _ in self._attendants:
            self._tasks.put(None)
        if wait:
            for attendant in self._attendants:
                attendant.join()

    def stop(self) -> None:
        """Ask the tasks to stop, as a signal asks a command, and wait until they have."""
        self.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            for worker in self._workers.values():
                worker.ask_to_stop()
        for attendant in self._attendants:
            attendant.join()

    def terminate(self) -> None:
        """Kill the workers in the middle of their tasks."""
        self.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            for worker in self._workers.values():
                worker.process.kill()
        for attendant in self._attendants:
            attendant.join(timeout=1)

    def _cancel_waiting(self) -> None:
        with suppress(Empty):
            while True:
                if task := self._tasks.get_nowait():
                    task.future.cancel()

    def _attend(self, seat: int) -> None:
        """Give tasks to one worker after the other, for as long as there are any."""
        resource_tracker.ensure_running()  # to start it lets signals through again
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # which the workers inherit
        while task := self._tasks.get():
            if not task.future.set_running_or_notify_cancel():
                continue
            try:
                self._answer(task, self._worker(seat).call(task.call))
            except (EOFError, OSError):
                self._discard(seat, task)
            except Exception as error:  # noqa: BLE001  a call that cannot be sent fails alone
                task.future.set_exception(error)
        with self._lock:
            worker = self._workers.pop(seat, None)
        if worker is not None:
            worker.pipe.close()
            worker.process.join()

    def _answer(self, task: _Task, answer: tuple[bool, Any]) -> None:
        done, value = answer
        if done:
            task.future.set_result(value)
        else:
            task.future.set_exception(value)

    def _worker(self, seat: int) -> "_Worker":
        with self._lock:
            if seat not in self._workers:
                if self._closed:
                    raise EOFError
                self._workers[seat] = _Worker(self._threads)
            return self._workers[seat]

    def _discard(self, seat: int, task: _Task) -> None:
        """Fail the task of a worker that is gone; another takes its seat with the next task."""
        with self._lock:
            worker = self._workers.pop(seat, None)
        code = None
        if worker is not None:
            worker.pipe.close()
            worker.process.join(timeout=5)
            code = worker.process.exitcode
        task.future.set_exception(WorkerLostError(f"the worker process died ({_words(code)})"))


def _words(code: int | None) -> str:
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


class _Worker:
    """A process and the pipe to it."""

    def __init__(self, threads: int) -> None:
        self.pipe, far = _SPAWN.Pipe()
        asked, self._ask = _SPAWN.Pipe(duplex=False)
        # Daemonic ones may not start processes of their own; `_watch_parent` ends these.
        self.process = _SPAWN.Process(target=_serve, args=(far, asked), daemon=False)
        with limited_threads(threads):
            self.process.start()
        far.close()
        asked.close()

    def ask_to_stop(self) -> None:
        """Let `stopping.asked` be true in the process."""
        self._ask.close()

    def call(self, call: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]) -> Any:
        """Send a call and wait for its answer.

        Raises
        ------
        EOFError, OSError : the process is gone.
        """
        _send(self.pipe, call)
        return _receive(self.pipe)


def _send(pipe: Connection, value: object) -> None:
    """Send a value; its arrays go from where they lie into the pipe, without a copy."""
    written, buffers = io.BytesIO(), list[Any]()
    ForkingPickler(written, 5, True, buffers.append).dump(value)  # noqa: FBT003  by position alone
    arrays = [buffer.raw() for buffer in buffers]
    pipe.send([len(array) for array in arrays])
    pipe.send_bytes(written.getbuffer())
    for array in arrays:
        rest = array
        while rest:
            rest = rest[os.write(pipe.fileno(), rest) :]


def _receive(pipe: Connection) -> Any:
    """Receive what `_send` has sent.

    Raises
    ------
    EOFError, OSError : the other process is gone.
    """
    sizes, written = pipe.recv(), pipe.recv_bytes()
    arrays = [bytearray(size) for size in sizes]
    for array in arrays:
        rest = memoryview(array)
        while rest:
            count = os.readv(pipe.fileno(), [rest])
            if not count:
                raise EOFError
            rest = rest[count:]
    return ForkingPickler.loads(written, buffers=arrays)


def _serve(pipe: Connection, asked: Connection) -> None:
    """Answer calls until the parent closes the pipe or dies."""
    threading.Thread(target=_watch_parent, args=(asked,), daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            function, arguments, options = _receive(pipe)
            _send(pipe, _answer(function, arguments, options))


def _answer(
    function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]
) -> tuple[bool, Any]:
    try:
        return True, function(*arguments, **options)
    except (Exception, stopping.Stopped) as error:  # noqa: BLE001  it is raised by the future
        return False, error


def _watch_parent(asked: Connection) -> None:
    """Stop the work when the parent asks; end, whatever it does, when the parent is gone."""
    parent = parent_process()
    if parent is None:
        return
    if parent.sentinel not in wait([parent.sentinel, asked]):
        stopping.request()
        wait([parent.sentinel])
    os._exit(1)
