"""Worker processes on this machine that end with their parent and fail independently."""

import atexit
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing import resource_tracker
from queue import Empty, SimpleQueue
from typing import Any

from shapecat.executors.interface import WorkerExecutor
from shapecat.executors.worker import Call, Worker, WorkerLostError

__all__ = ["LocalExecutor"]

_SIGNALS = {signal.SIGINT, signal.SIGTERM}
_NOT_STARTED = "no worker process can be started"


class LocalExecutor(WorkerExecutor):
    """Runs tasks in spawned processes, as `concurrent.futures.ProcessPoolExecutor` does.

    It differs as follows: a worker that dies fails only its own tasks and is replaced; workers end
    when their parent ends for whatever reason; `stop` asks tasks to finish early; `terminate` does
    not wait for tasks; signals reach only the parent, which decides what they mean.
    """

    def __init__(self, workers: int, *, ahead: int = 0) -> None:
        """Prepare ``workers`` processes; each starts with its first task.

        Parameters
        ----------
        ahead : number of tasks sent to a busy worker in advance; they fail if the worker dies.

        Raises
        ------
        ValueError : ``workers`` is less than 1.
        """
        if workers < 1:
            msg = f"workers must be at least 1, got {workers}"
            raise ValueError(msg)
        self._tasks: SimpleQueue[Call | None] = SimpleQueue()
        self._ahead = ahead
        self._closed = False
        self._workers: dict[int, Worker] = {}
        self._lock = threading.Lock()
        self._dispatchers: list[threading.Thread] = []
        for k in range(workers):
            dispatcher = threading.Thread(target=self._dispatch, args=(k,), daemon=True)
            try:
                dispatcher.start()
            except RuntimeError:  # the limit of processes is reached; make do with fewer
                break
            self._dispatchers.append(dispatcher)
        atexit.register(self.terminate)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a call; its future raises `WorkerLostError` if its worker dies or does not start.

        Raises
        ------
        RuntimeError : the executor was shut down.
        """
        if self._closed:
            msg = "cannot submit after shutdown"
            raise RuntimeError(msg)
        task = Call(Future(), (fn, args, kwargs))
        if self._dispatchers:
            self._tasks.put(task)
        else:
            task.future.set_exception(WorkerLostError(f"{_NOT_STARTED}: too many threads"))
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as in the base class
        """Let the workers end when all submitted tasks are done; wait for them by default."""
        self._closed = True
        atexit.unregister(self.terminate)
        if cancel_futures:
            self._cancel_waiting()
        for _ in self._dispatchers:
            self._tasks.put(None)
        if wait:
            for dispatcher in self._dispatchers:
                dispatcher.join()

    def stop(self) -> None:
        """Ask running tasks to stop, as a signal would, and wait for them."""
        self._end(Worker.ask_to_stop)

    def terminate(self) -> None:
        """Kill the workers in the middle of their tasks."""
        self._end(lambda worker: worker.process.kill(), timeout_s=1)

    def _end(self, end: Callable[[Worker], object], *, timeout_s: float | None = None) -> None:
        """Cancel waiting tasks, call ``end`` for all workers, and wait for their dispatchers.

        ``timeout_s`` is the longest wait for each dispatcher, seconds; None for no limit.
        """
        self.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            for worker in self._workers.values():
                end(worker)
        for dispatcher in self._dispatchers:
            dispatcher.join(timeout_s)

    def _cancel_waiting(self) -> None:
        with suppress(Empty):
            while True:
                if task := self._tasks.get_nowait():
                    task.future.cancel()

    def _dispatch(self, slot: int) -> None:
        """Send tasks to the worker in a slot, and to workers that replace it, until shutdown."""
        resource_tracker.ensure_running()  # starting it later would unblock the signals
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # the workers inherit it
        capacity = threading.Semaphore(1 + self._ahead)
        while capacity.acquire() and (task := self._tasks.get()):
            try:
                if task.future.set_running_or_notify_cancel():
                    self._worker(slot, capacity).send(task)
                else:
                    capacity.release()
            except Exception as error:  # noqa: BLE001  a call that cannot be sent fails alone
                task.future.set_exception(error)
                capacity.release()
        self._retire(slot)

    def _worker(self, slot: int, capacity: threading.Semaphore) -> Worker:
        """Return the worker in a slot; start one if there is none or it has died.

        ``capacity`` is as in `Worker`.

        Raises
        ------
        WorkerLostError : the executor is shut down, or no process can be started.
        """
        worker = self._workers.get(slot)
        if worker is not None and worker.lost:
            self._retire(slot)
        with self._lock:
            if slot not in self._workers:
                if self._closed:
                    msg = "the worker process died before its task was sent"
                    raise WorkerLostError(msg)
                try:
                    self._workers[slot] = Worker(capacity)
                except (OSError, RuntimeError) as error:  # no more processes, or no more threads
                    msg = f"{_NOT_STARTED}: {error}"
                    raise WorkerLostError(msg) from error
            return self._workers[slot]

    def _retire(self, slot: int) -> None:
        """Wait for the results and the end of the worker in a slot, if any; then remove it."""
        worker = self._workers.get(slot)
        if worker is not None:
            worker.end()
            with self._lock:
                del self._workers[slot]
