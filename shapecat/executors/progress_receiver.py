"""Progress of workers on this machine, sent as datagrams, which are dropped rather than queued."""

import json
import socket
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Thread
from typing import Any, Self

__all__ = ["ProgressReceiver", "send_progress"]

_MOST_BYTES = 4096
"""Largest message; larger ones are dropped."""
_SHORT_FOLDER = "/tmp"  # noqa: S108  the folder in it is private
"""The path of a socket has at most 107 bytes; that of the temporary folder may be longer."""


class ProgressReceiver:
    """Passes the messages of `send_progress` to a function, in a thread, during a ``with`` block.

    A worker that dies while it sends blocks nobody, since there is no lock and no stream. The
    socket is in a folder that only this user may enter.

    Attributes
    ----------
    address : path of the socket; empty if no socket can be made, and then nothing arrives.
    """

    def __init__(self, receive: Callable[[Any], None]) -> None:
        """Call ``receive`` with each message, in the thread that listens."""
        self._receive = receive
        self._folder = ExitStack()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.address = self._bind()
        self._thread = Thread(target=self._listen, daemon=True)

    def __enter__(self) -> Self:
        if self.address:
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop listening."""
        if self.address:
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.sendto(b"", self.address)  # ends the thread
            self._thread.join(timeout=1)
        self._socket.close()
        self._folder.close()

    def _bind(self) -> str:
        """Bind the socket in a folder of its own; return its path, empty if that fails."""
        with suppress(OSError), ExitStack() as stack:
            folder = tempfile.TemporaryDirectory(
                prefix="shapecat-", dir=_SHORT_FOLDER, ignore_cleanup_errors=True
            )
            address = str(Path(stack.enter_context(folder)) / "progress")
            self._socket.bind(address)
            self._folder = stack.pop_all()
            return address
        return ""

    def _listen(self) -> None:
        with suppress(OSError):  # the socket was closed
            while content := self._socket.recv(_MOST_BYTES):
                with suppress(ValueError):
                    self._receive(json.loads(content))


def send_progress(address: str, message: Any) -> None:
    """Send a JSON value without waiting; drop it if that fails, for example on another machine.

    ``address`` is that of the `ProgressReceiver`.
    """
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)  # noqa: FBT003  positional by definition
        sender.sendto(json.dumps(message).encode(), address)
