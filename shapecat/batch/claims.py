"""Claims on run folders at URLs: only one process at a time works on a folder.

While a process works on the folder ``NAME``, the object ``.NAME.claim`` exists beside it. The
storage must support exclusive creation of an object. The owner rewrites its claim every 10 seconds;
a process that sees the claim unchanged for 45 seconds takes it over. The clocks of different
machines are never compared. An owner checks its claim before it completes a run, so that a process
that was presumed dead does not overwrite the results of another.
"""

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread
from typing import Any
from uuid import uuid4

from shapecat.batch.storage import Location
from shapecat.errors import OutputError, ShapecatError
from shapecat.system import stopping

__all__ = ["Claim", "claim_name", "claimed"]

_HEARTBEAT_S = 10.0
"""Time between two rewrites of a claim."""
_STALE_S = 45.0
"""The owner of a claim that stays unchanged for this time is presumed dead."""
_POLL_S = 1.0
"""Time between two looks at the claim of another process."""


def claim_name(folder: str) -> str:
    """Return the name of the object that claims a run folder; the object is beside the folder."""
    return f".{folder}.claim"


class Claim:
    """The claim of this process on a run folder.

    Attributes
    ----------
    inherited : whether the claim was taken over from a dead process.
    """

    def __init__(self, url: str, batch: str) -> None:
        """Claim a run folder; if it is claimed, wait up to 45 s to see whether the owner is dead.

        Parameters
        ----------
        url : the run folder.
        batch : identifies the command. A claim of the same command is taken over without waiting,
            since a command sends a job again only after its worker has died.

        Raises
        ------
        OutputError : another process works on the folder, or the storage is not writable.
        """
        parent, _, name = url.rstrip("/").rpartition("/")
        self._url = url
        self._object = Location(parent, OutputError) / claim_name(name)
        self._fields: dict[str, Any] = {
            "owner": uuid4().hex,
            "batch": batch,
            "host": socket.gethostname(),
            "process": os.getpid(),
            "beat": 0,
        }
        self.inherited = not self._create()

    def _create(self) -> bool:
        """Create the claim and return True, or take it over and return False.

        Raises
        ------
        OutputError : the owner of the claim is alive.
        """
        while not self._object.create(self._content()):
            content = self._object.read()
            if content is None:
                continue
            other = _parse(content)
            if other.get("owner") == self._fields["owner"]:
                return True  # it was created, but the answer was lost
            if other.get("batch") == self._fields["batch"] or self._is_stale(content, other):
                self._object.write(self._content())
                return False
        return True

    def _is_stale(self, content: bytes, other: dict[str, Any]) -> bool:
        """Watch a claim; return True if it stays unchanged for 45 s, False if it disappears.

        ``content`` is the claim as it was read, ``other`` its fields.

        Raises
        ------
        OutputError : the claim changes, so its owner is alive.
        """
        waited = 0.0
        while waited < _STALE_S:
            stopping.check()
            Event().wait(_POLL_S)
            waited += _POLL_S
            now = self._object.read()
            if now is None:
                return False
            if now != content:
                owner = f"process {other.get('process')} on {other.get('host')}"
                msg = (
                    f"{self._url}: another process is writing to this folder ({owner}); wait for "
                    "it, or stop it"
                )
                raise OutputError(msg)
        return True

    def _content(self) -> bytes:
        return json.dumps(self._fields).encode()

    def _is_held(self) -> bool:
        return bool(_parse(self._object.read() or b"").get("owner") == self._fields["owner"])

    def require(self) -> None:
        """Check that no other process has taken over the folder.

        Raises
        ------
        OutputError : another process has taken it over, because this one was silent too long.
        """
        if not self._is_held():
            msg = (
                f"{self._url}: another process has taken over this folder, since this one did not "
                "renew its claim"
            )
            raise OutputError(msg)

    def renew(self) -> bool:
        """Rewrite the claim; return False if another process has taken it over."""
        with suppress(ShapecatError):  # the next heartbeat may reach the storage
            if not self._is_held():
                return False
            self._fields["beat"] += 1
            self._object.write(self._content())
        return True

    def release(self) -> None:
        """Remove the claim, unless another process has taken it over."""
        with suppress(ShapecatError):  # it goes stale
            if self._is_held():
                self._object.remove()


@contextmanager
def claimed(url: str, batch: str) -> Iterator[Claim]:
    """Claim the run folder at a URL, and renew the claim until the block ends.

    Parameters
    ----------
    batch : identifies the command; a claim of the same command is taken over without waiting.

    Raises
    ------
    OutputError : another process works on the folder, or the storage is not writable.
    """
    claim, ended = Claim(url, batch), Event()

    def renew() -> None:
        while not ended.wait(_HEARTBEAT_S) and claim.renew():
            pass

    thread = Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield claim
    finally:
        ended.set()
        thread.join()
        claim.release()


def _parse(content: bytes) -> dict[str, Any]:
    with suppress(ValueError, RecursionError):
        fields = json.loads(content)
        return fields if isinstance(fields, dict) else {}
    return {}
