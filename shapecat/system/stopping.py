"""Signals that ask a command to stop: stored when they arrive, obeyed between two frames.

An exception that a signal handler raises may surface inside compiled code, which then returns a
result and an error at once, or crashes the interpreter. So the handler only stores the signal, and
the work checks for it where it can be interrupted: `asked` ends a loop, `check` raises `Stopped`.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

__all__ = [
    "Stopped",
    "asked",
    "check",
    "exit_at_once",
    "handling_signals",
    "request",
    "stop_message",
]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_messages = [b"stopping soon; interrupt again to stop immediately\n"]
"""Messages for the first signal; the last of them is printed. `stop_message` adds one."""
_SHOW_CURSOR = b"\x1b[?25h"

_received: list[int] = []


class Stopped(KeyboardInterrupt):
    """A signal stopped the work; finished parts are kept."""

    def __init__(self, signum: int = signal.SIGINT) -> None:
        """Set ``exit_code``, as a shell would for this signal."""
        super().__init__(signum)
        self.exit_code = 128 + signum


def request(signum: int = signal.SIGINT) -> None:
    """Ask this process to stop."""
    _received.append(signum)


def asked() -> bool:
    """Return whether this process was asked to stop."""
    return bool(_received)


def check() -> None:
    """Raise `Stopped` if this process was asked to stop."""
    if _received:
        raise Stopped(_received[0])


def exit_at_once(signum: int, _frame: FrameType | None = None) -> None:
    """End this process immediately (a signal handler); its workers notice and end too."""
    if os.isatty(2):
        _write_stderr(_SHOW_CURSOR)
    os._exit(128 + signum)


def _write_stderr(text: bytes) -> None:
    """Write to stderr past its buffer, since the signal may have interrupted a buffered write."""
    with suppress(OSError):
        os.write(2, text)


def _handle(signum: int, frame: FrameType | None) -> None:
    """Store the first signal; end the process at the second (a signal handler)."""
    if asked():
        exit_at_once(signum, frame)
    request(signum)
    _write_stderr(_messages[-1])


@contextmanager
def stop_message(text: str) -> Iterator[None]:
    """Print another message at the first signal that arrives during the block."""
    _messages.append(f"{text}\n".encode())
    try:
        yield
    finally:
        _messages.pop()


@contextmanager
def handling_signals() -> Iterator[None]:
    """Store SIGINT and SIGTERM during the block instead of raising; forget them at its end.

    Ignored signals, such as SIGINT in a background job, stay ignored. Outside the main thread,
    which alone may handle signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {signum: signal.getsignal(signum) for signum in _SIGNALS}
    before = {n: h for n, h in handlers.items() if h not in {None, signal.SIG_IGN}}
    for signum in before:
        signal.signal(signum, _handle)
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
        _received.clear()
