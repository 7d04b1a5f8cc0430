"""Progress reports from workers on this machine: datagrams, dropped rather than waited for."""

import json
import socket
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, Self

__all__ = ["Mailbox", "post"]

_MOST_BYTES = 4096


class Mailbox:
    """Passes the reports that workers `post` to a function, in a thread of its own.

    A worker that dies while it posts blocks nobody, since there is no lock and no stream. The
    socket is in a folder that only this user may enter.

    Attributes
    ----------
    address : path of the socket, the address for `post`.
    """

    def __init__(self, receive: Callable[[Any], None]) -> None:
        """Call ``receive`` with each report."""
        self._receive = receive
        self._folder = tempfile.TemporaryDirectory(prefix="shapecat-", ignore_cleanup_errors=True)
        self.address = str(Path(self._folder.name) / "mailbox")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address)
        self._thread = Thread(target=self._listen, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop listening."""
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
            end.sendto(b"", self.address)
        self._thread.join(timeout=1)
        self._socket.close()
        self._folder.cleanup()

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
