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
from shapecat.executors.worker import Task, Worker, WorkerLostError

__all__ = ["LocalExecutor"]

_SIGNALS = {signal.SIGINT, signal.SIGTERM}


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
        ahead : number of tasks sent to a busy worker in advance; they fail if it dies.

        Raises
        ------
        ValueError : ``workers`` is less than 1.
        """
        if workers < 1:
            msg = f"workers must be at least 1, got {workers}"
            raise ValueError(msg)
        self._tasks: SimpleQueue[Task | None] = SimpleQueue()
        self._ahead = ahead
        self._closed = False
        self._workers: dict[int, Worker] = {}
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
        task = Task(Future(), (fn, args, kwargs))
        self._tasks.put(task)
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as in the base class
        """Let the workers end when all submitted tasks are done."""
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
        """Ask running tasks to stop, as a signal would, and wait until they have."""
        self._end(Worker.ask_to_stop)

    def terminate(self) -> None:
        """Kill the workers in the middle of their tasks."""
        self._end(lambda worker: worker.process.kill(), timeout_s=1)

    def _end(self, each: Callable[[Worker], object], *, timeout_s: float | None = None) -> None:
        """Drop waiting tasks, call ``each`` for all workers, and wait for their threads."""
        self.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            for worker in self._workers.values():
                each(worker)
        for attendant in self._attendants:
            attendant.join(timeout_s)

    def _cancel_waiting(self) -> None:
        with suppress(Empty):
            while True:
                if task := self._tasks.get_nowait():
                    task.future.cancel()

    def _attend(self, seat: int) -> None:
        """Send tasks to the worker in a seat of the pool, or its successors, until shutdown."""
        resource_tracker.ensure_running()  # starting it later would unblock the signals
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # the workers inherit it
        room = threading.Semaphore(1 + self._ahead)
        while room.acquire() and (task := self._tasks.get()):
            try:
                if task.future.set_running_or_notify_cancel():
                    self._worker(seat, room).send(task)
                else:
                    room.release()
            except Exception as error:  # noqa: BLE001  a call that cannot be sent fails alone
                task.future.set_exception(error)
                room.release()
        self._dismiss(seat)

    def _worker(self, seat: int, room: threading.Semaphore) -> Worker:
        """Return the worker of a seat; start one if there is none or it has died.

        Raises
        ------
        WorkerLostError : the executor is shut down, or no process can be started.
        """
        worker = self._workers.get(seat)
        if worker is not None and worker.lost:
            self._dismiss(seat)
        with self._lock:
            if seat not in self._workers:
                if self._closed:
                    msg = "the worker process died before its task was sent"
                    raise WorkerLostError(msg)
                try:
                    self._workers[seat] = Worker(room)
                except OSError as error:
                    msg = f"no worker process can be started: {error}"
                    raise WorkerLostError(msg) from error
            return self._workers[seat]

    def _dismiss(self, seat: int) -> None:
        """Wait for the outstanding answers of a worker, and for its end."""
        worker = self._workers.get(seat)
        if worker is not None:
            worker.end()
            with self._lock:
                del self._workers[seat]
