"""Claims on run folders at URLs: one live process at a time works on each.

Beside the folder ``NAME`` lies the object ``.NAME.claim`` while a process works on it. The storage
must create an object only once; no two clocks are compared. Its owner writes the claim anew every
few seconds, and whoever finds it unchanged for longer takes it over. An owner looks at its claim
before its results become a run: one that was held to be dead does not overwrite those of another.
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

_BEAT_S = 10.0
"""A claim is written anew so often."""
_STALE_S = 45.0
"""A claim that has not changed for so long is a dead process's."""
_LOOK_S = 1.0


def claim_name(folder: str) -> str:
    """Return the name of the claim of a run folder, beside it."""
    return f".{folder}.claim"


class Claim:
    """The claim of this process.

    Attributes
    ----------
    inherited : whether a process that died had worked on the folder.
    """

    def __init__(self, url: str, batch: str) -> None:
        """Claim a run folder for a batch. A batch knows which of its own workers have died.

        Raises
        ------
        OutputError : another process works on it, or the storage cannot be written to.
        """
        parent, _, name = url.rstrip("/").rpartition("/")
        self._url = url
        self._object = Location(parent, OutputError) / claim_name(name)
        self._known: dict[str, Any] = {
            "owner": uuid4().hex,
            "batch": batch,
            "host": socket.gethostname(),
            "process": os.getpid(),
            "beat": 0,
        }
        self.inherited = not self._create()

    def _create(self) -> bool:
        """Create the object, or take it over; return whether there was none."""
        while not self._object.create(self._content()):
            content = self._object.read()
            if content is None:
                continue
            held = _parse(content)
            if held.get("owner") == self._known["owner"]:
                return True  # it was created, but the answer was lost
            if held.get("batch") == self._known["batch"] or self._is_stale(content, held):
                self._object.write(self._content())
                return False
        return True

    def _is_stale(self, content: bytes, held: dict[str, Any]) -> bool:
        """Return whether a claim stays unchanged; False if it disappears.

        Raises
        ------
        OutputError : its owner is at work.
        """
        waited = 0.0
        while waited < _STALE_S:
            stopping.check()
            Event().wait(_LOOK_S)
            waited += _LOOK_S
            now = self._object.read()
            if now is None:
                return False
            if now != content:
                owner = f"process {held.get('process')} on {held.get('host')}"
                msg = f"{self._url}: another run is writing there: {owner}"
                raise OutputError(msg)
        return True

    def _content(self) -> bytes:
        return json.dumps(self._known).encode()

    def _is_held(self) -> bool:
        return bool(_parse(self._object.read() or b"").get("owner") == self._known["owner"])

    def require(self) -> None:
        """Require that no other process has taken the folder over.

        Raises
        ------
        OutputError : somebody has: this process was silent for too long.
        """
        if not self._is_held():
            msg = f"{self._url}: another run has taken over: this one was not heard of for too long"
            raise OutputError(msg)

    def beat(self) -> bool:
        """Renew the claim; return whether it is still this process's."""
        with suppress(ShapecatError):  # the next beat may reach the storage
            if not self._is_held():
                return False
            self._known["beat"] += 1
            self._object.write(self._content())
        return True

    def release(self) -> None:
        """Release the folder."""
        with suppress(ShapecatError):  # it goes stale
            if self._is_held():
                self._object.remove()


@contextmanager
def claimed(url: str, batch: str) -> Iterator[Claim]:
    """Claim a run folder at a URL for as long as the block takes.

    Raises
    ------
    OutputError : another process works on it, or the storage cannot be written to.
    """
    claim, ended = Claim(url, batch), Event()

    def beat() -> None:
        while not ended.wait(_BEAT_S) and claim.beat():
            pass

    thread = Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield claim
    finally:
        ended.set()
        thread.join()
        claim.release()


def _parse(content: bytes) -> dict[str, Any]:
    with suppress(ValueError):
        known = json.loads(content)
        return known if isinstance(known, dict) else {}
    return {}
