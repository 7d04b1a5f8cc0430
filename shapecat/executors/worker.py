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

__all__ = ["Task", "Worker", "WorkerLostError"]

# Spawned, not forked: the threads of numeric and Rerun libraries do not survive a fork.
_SPAWN = get_context("spawn")


class WorkerLostError(RuntimeError):
    """The process that worked on a task died: killed, out of memory, or crashed."""


class Task(NamedTuple):
    """A call, and the future of its result."""

    future: Future[Any]
    call: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


class Worker:
    """A process, the socket to it, and a thread that receives its answers.

    Attributes
    ----------
    lost : whether the process has died.
    """

    def __init__(self, room: threading.Semaphore) -> None:
        """Start a process; each answer releases ``room``."""
        self.lost = False
        self._socket, far = socket.socketpair()
        asked, self._ask = _SPAWN.Pipe(duplex=False)
        # Not daemonic, since those may not start processes; `_watch_parent` ends it instead.
        self.process = _SPAWN.Process(target=_serve, args=(far, asked), daemon=False)
        with single_threaded():
            self.process.start()
        far.close()
        asked.close()
        self._sent: SimpleQueue[Task | None] = SimpleQueue()
        self._listener = threading.Thread(target=self._listen, args=(room,), daemon=True)
        self._listener.start()

    def ask_to_stop(self) -> None:
        """Make `stopping.asked` return True in the process."""
        self._ask.close()

    def send(self, task: Task) -> None:
        """Send a call, which waits while another one runs; the receiving thread sets its future."""
        parts = _packed(task.call)
        self._sent.put(task)
        with suppress(OSError):  # the listener gets the same error
            _send(self._socket, parts)

    def end(self) -> None:
        """Wait for the outstanding answers, then for the end of the process."""
        self._sent.put(None)
        self._listener.join()
        self._socket.close()
        self.process.join()

    def _listen(self, room: threading.Semaphore) -> None:
        while task := self._sent.get():
            try:
                done, value = _receive(self._socket)
            except (EOFError, OSError):
                done, value = False, self._loss()
            except Exception as error:  # noqa: BLE001  an answer that cannot be read fails alone
                done, value = False, error
            if done:
                task.future.set_result(value)
            else:
                task.future.set_exception(value)
            room.release()

    def _loss(self) -> WorkerLostError:
        self.lost = True
        self.process.join(timeout=5)
        return WorkerLostError(f"the worker process died ({_words(self.process.exitcode)})")


def _words(code: int | None) -> str:
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def _packed(value: object) -> list[memoryview]:
    """Pickle a value; return the pickle and the arrays in it, which are not copied."""
    written, buffers = io.BytesIO(), list[Any]()
    ForkingPickler(written, 5, True, buffers.append).dump(value)  # noqa: FBT003  by position alone
    return [written.getbuffer(), *(buffer.raw() for buffer in buffers)]


def _send(connection: socket.socket, parts: Sequence[memoryview]) -> None:
    """Send parts of any size, preceded by their number and sizes."""
    connection.sendall(struct.pack(f"<{len(parts) + 1}Q", len(parts), *map(len, parts)))
    for part in parts:
        connection.sendall(part)


def _receive(connection: socket.socket) -> Any:
    """Receive a value that `_packed` and `_send` sent.

    Raises
    ------
    EOFError, OSError : the other process is gone.
    """
    (count,) = struct.unpack("<Q", _read(connection, 8))
    sizes = struct.unpack(f"<{count}Q", _read(connection, 8 * count))
    written, *arrays = [_read(connection, size) for size in sizes]
    return ForkingPickler.loads(written, buffers=arrays)


def _read(connection: socket.socket, size: int) -> bytearray:
    """Read `size` bytes, usually in one call, which waits without the interpreter lock."""
    content = bytearray(size)
    rest = memoryview(content)
    while rest:
        count = connection.recv_into(rest, 0, socket.MSG_WAITALL)
        if not count:
            raise EOFError
        rest = rest[count:]
    return content


def _serve(connection: socket.socket, asked: Connection) -> None:
    """Answer calls until the parent closes the socket or dies.

    Threads receive the next call and send the previous answer during the current call.
    """
    collect_seldom()
    block_unused()
    threading.Thread(target=_watch_parent, args=(asked,), daemon=True).start()
    calls: SimpleQueue[Any] = SimpleQueue()
    answers: SimpleQueue[Any] = SimpleQueue()
    threading.Thread(target=_read_calls, args=(connection, calls), daemon=True).start()
    writer = threading.Thread(target=_write_answers, args=(connection, answers), daemon=True)
    writer.start()
    while call := calls.get():
        answers.put(_packed(_answer(*call)))
    answers.put(None)
    writer.join()


def _read_calls(connection: socket.socket, calls: SimpleQueue[Any]) -> None:
    try:
        with suppress(EOFError, OSError):
            while True:
                calls.put(_receive(connection))
    finally:
        calls.put(None)


def _write_answers(connection: socket.socket, answers: SimpleQueue[Any]) -> None:
    with suppress(OSError):
        while parts := answers.get():
            _send(connection, parts)


def _answer(
    function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]
) -> tuple[bool, Any]:
    try:
        return True, function(*arguments, **options)
    except (Exception, stopping.Stopped) as error:  # noqa: BLE001  it is raised by the future
        return False, error


def _watch_parent(asked: Connection) -> None:
    """Request a stop when the parent asks for it; end the process when the parent is gone."""
    parent = parent_process()
    if parent is None:
        return
    if parent.sentinel not in wait([parent.sentinel, asked]):
        stopping.request()
        wait([parent.sentinel])
    os._exit(1)
