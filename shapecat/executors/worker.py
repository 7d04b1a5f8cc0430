"""A spawned process that executes calls, and its counterpart in the parent."""

import io
import os
import signal
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue
from typing import Any, NamedTuple

from shapecat.executors.cores import single_threaded
from shapecat.system import stopping
from shapecat.system.garbage import collect_seldom
from shapecat.system.libraries import block_unused

__all__ = ["Call", "Worker", "WorkerLostError"]

# Spawned, not forked: the threads of numeric and Rerun libraries do not survive a fork.
_SPAWN = get_context("spawn")


class WorkerLostError(RuntimeError):
    """The process for a task died (killed, out of memory, crashed), or could not be started."""


class Call(NamedTuple):
    """A call (function, arguments, keyword arguments), and the future of its result."""

    future: Future[Any]
    call: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


class Worker:
    """A process, the socket to it, and a thread that receives its results.

    Attributes
    ----------
    lost : whether the process has died.
    """

    def __init__(self, capacity: threading.Semaphore) -> None:
        """Start a process.

        ``capacity`` counts the calls that may still be sent to it; each result releases one.

        Raises
        ------
        OSError, RuntimeError : the process, or the thread, cannot be started.
        """
        self.lost = False
        self._socket, child_socket = socket.socketpair()
        stop_pipe, self._stop_pipe = _SPAWN.Pipe(duplex=False)
        # Daemonic processes may not start others, so `_watch_parent` ends this one.
        self.process = _SPAWN.Process(target=_serve, args=(child_socket, stop_pipe), daemon=False)
        with single_threaded():
            self.process.start()
        child_socket.close()
        stop_pipe.close()
        self._sent: SimpleQueue[Call | None] = SimpleQueue()
        self._listener = threading.Thread(target=self._listen, args=(capacity,), daemon=True)
        try:
            self._listener.start()
        except RuntimeError:  # at exit, this process would wait for the idle one
            self.process.kill()
            self.process.join()
            self._socket.close()
            raise

    def ask_to_stop(self) -> None:
        """Make `stopping.asked` return True in the process."""
        self._stop_pipe.close()

    def send(self, task: Call) -> None:
        """Queue a call in the process.

        The listener thread sets the task's future when the result arrives.
        """
        parts = _pickled(task.call)
        self._sent.put(task)
        with suppress(OSError):  # the listener gets the same error
            _send(self._socket, parts)

    def end(self) -> None:
        """Wait for the outstanding results, then for the end of the process."""
        self._sent.put(None)
        self._listener.join()
        self._socket.close()
        self.process.join()

    def _listen(self, capacity: threading.Semaphore) -> None:
        while task := self._sent.get():
            try:
                succeeded, value = _receive(self._socket)
            except (EOFError, OSError):
                succeeded, value = False, self._lost_error()
            except Exception as error:  # noqa: BLE001  a result that cannot be read fails alone
                succeeded, value = False, error
            if succeeded:
                task.future.set_result(value)
            else:
                task.future.set_exception(value)
            capacity.release()

    def _lost_error(self) -> WorkerLostError:
        self.lost = True
        self.process.join(timeout=5)
        reason = _exit_reason(self.process.exitcode)
        return WorkerLostError(f"the worker process died ({reason})")


def _exit_reason(code: int | None) -> str:
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def _pickled(value: object) -> list[memoryview]:
    """Pickle a value; return the pickle and the arrays in it, which are not copied."""
    pickle, arrays = io.BytesIO(), list[Any]()
    ForkingPickler(pickle, 5, True, arrays.append).dump(value)  # noqa: FBT003  by position alone
    return [pickle.getbuffer(), *(array.raw() for array in arrays)]


def _send(connection: socket.socket, parts: Sequence[memoryview]) -> None:
    """Send parts of any size, preceded by their number and sizes."""
    connection.sendall(struct.pack(f"<{len(parts) + 1}Q", len(parts), *map(len, parts)))
    for part in parts:
        connection.sendall(part)


def _receive(connection: socket.socket) -> Any:
    """Receive a value that `_pickled` and `_send` sent.

    Raises
    ------
    EOFError, OSError : the other process is gone.
    """
    (count,) = struct.unpack("<Q", _read(connection, 8))
    sizes = struct.unpack(f"<{count}Q", _read(connection, 8 * count))
    pickle, *arrays = [_read(connection, size) for size in sizes]
    return ForkingPickler.loads(pickle, buffers=arrays)


def _read(connection: socket.socket, size: int) -> bytearray:
    """Read ``size`` bytes, usually in one call, which waits without the interpreter lock.

    Raises
    ------
    EOFError, OSError : the other process is gone.
    """
    content = bytearray(size)
    rest = memoryview(content)
    while rest:
        count = connection.recv_into(rest, 0, socket.MSG_WAITALL)
        if not count:
            raise EOFError
        rest = rest[count:]
    return content


def _serve(connection: socket.socket, stop_pipe: Connection) -> None:
    """Execute calls until the parent closes the socket or dies.

    Threads receive the next call and send the previous result during the current call.
    """
    collect_seldom()
    block_unused()
    threading.Thread(target=_watch_parent, args=(stop_pipe,), daemon=True).start()
    calls: SimpleQueue[Any] = SimpleQueue()
    results: SimpleQueue[Any] = SimpleQueue()
    threading.Thread(target=_receive_calls, args=(connection, calls), daemon=True).start()
    sender = threading.Thread(target=_send_results, args=(connection, results), daemon=True)
    sender.start()
    while call := calls.get():
        results.put(_pickled(_execute(*call)))
    results.put(None)
    sender.join()


def _receive_calls(connection: socket.socket, calls: SimpleQueue[Any]) -> None:
    try:
        with suppress(EOFError, OSError):
            while True:
                calls.put(_receive(connection))
    finally:
        calls.put(None)


def _send_results(connection: socket.socket, results: SimpleQueue[Any]) -> None:
    with suppress(OSError):
        while parts := results.get():
            _send(connection, parts)


def _execute(
    function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]
) -> tuple[bool, Any]:
    try:
        return True, function(*arguments, **options)
    except (Exception, stopping.Stopped) as error:  # noqa: BLE001  it is raised by the future
        return False, error


def _watch_parent(stop_pipe: Connection) -> None:
    """Request a stop when the parent asks for it; end the process when the parent is gone."""
    parent = parent_process()
    if parent is None:
        return
    if parent.sentinel not in wait([parent.sentinel, stop_pipe]):
        stopping.request()
        wait([parent.sentinel])
    os._exit(1)
