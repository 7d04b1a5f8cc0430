"""Processes on this machine that outlive neither their parent nor spoil each other's work."""

import atexit
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from multiprocessing import resource_tracker
from queue import Empty, SimpleQueue
from typing import Any

from shapecat.executors.worker import Task, Worker, WorkerLostError

__all__ = ["LocalExecutor"]

_SIGNALS = {signal.SIGINT, signal.SIGTERM}


class LocalExecutor(Executor):
    """Runs tasks in spawned processes, as `concurrent.futures.ProcessPoolExecutor` does.

    It differs where a disk of recordings needs it to: a worker that dies fails its own tasks alone
    and is replaced, workers end when their parent does, however it ended, `stop` asks tasks to
    put their work down, and `terminate` does not wait for them. Signals reach the parent alone,
    which decides what they mean.
    """

    def __init__(self, workers: int, *, threads: int = 1, ahead: int = 0) -> None:
        """Prepare ``workers`` processes; each starts with its first task.

        Parameters
        ----------
        threads : that numeric libraries may use in each process.
        ahead : tasks that a busy worker is sent in advance, and loses when it dies.

        Raises
        ------
        ValueError : there is not at least one worker.
        """
        if workers < 1:
            msg = f"workers must be at least 1, got {workers}"
            raise ValueError(msg)
        self._tasks: SimpleQueue[Task | None] = SimpleQueue()
        self._threads, self._ahead = threads, ahead
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
        """Send tasks to one worker after the other, for as long as there are any."""
        resource_tracker.ensure_running()  # to start it lets signals through again
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # which the workers inherit
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
        """Return the worker of a seat; where it is gone another takes its place.

        Raises
        ------
        WorkerLostError : no other is started after a shutdown.
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
                    self._workers[seat] = Worker(self._threads, room)
                except OSError as error:
                    msg = f"no worker process can be started: {error}"
                    raise WorkerLostError(msg) from error
            return self._workers[seat]

    def _dismiss(self, seat: int) -> None:
        """Wait for the answers of a worker, and for its end."""
        worker = self._workers.get(seat)
        if worker is not None:
            worker.end()
            with self._lock:
                del self._workers[seat]
