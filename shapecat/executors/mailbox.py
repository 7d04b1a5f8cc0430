"""Progress reports from workers on this machine: datagrams, dropped rather than waited for."""

import json
import socket
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Thread
from typing import Any, Self

__all__ = ["Mailbox", "post"]

_MOST_BYTES = 4096
_SHORT = "/tmp"  # noqa: S108  the folder in it is private


class Mailbox:
    """Passes the reports that workers `post` to a function, in a thread of its own.

    A worker that dies while it posts blocks nobody, since there is no lock and no stream. The
    socket is in a folder that only this user may enter.

    Attributes
    ----------
    address : path of the socket, the address for `post`; empty if no socket can be made, and then
        no report arrives.
    """

    def __init__(self, receive: Callable[[Any], None]) -> None:
        """Call ``receive`` with each report."""
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
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
                end.sendto(b"", self.address)
            self._thread.join(timeout=1)
        self._socket.close()
        self._folder.close()

    def _bind(self) -> str:
        """Bind the socket in the temporary folder, or in /tmp if its path is too long."""
        for place in (None, _SHORT):
            with suppress(OSError), ExitStack() as folder:
                made = tempfile.TemporaryDirectory(
                    prefix="shapecat-", dir=place, ignore_cleanup_errors=True
                )
                address = str(Path(folder.enter_context(made)) / "mailbox")
                self._socket.bind(address)
                self._folder = folder.pop_all()
                return address
        return ""

    def _listen(self) -> None:
        with suppress(OSError):  # the socket was closed
            while content := self._socket.recv(_MOST_BYTES):
                with suppress(ValueError):
                    self._receive(json.loads(content))


def post(address: str, report: Any) -> None:
    """Send a report without waiting; drop it if that fails, for example on another machine."""
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)  # noqa: FBT003  positional by definition
        sender.sendto(json.dumps(report).encode(), address)
