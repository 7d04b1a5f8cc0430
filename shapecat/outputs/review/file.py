"""The file of a review. Rerun writes to a pipe, so that this module can handle disk errors.

Rerun's own writer ends at the first error, and logging after that blocks forever.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import IO

import rerun as rr

from shapecat.system.files import replacing

__all__ = ["ReviewFile", "forget_reviews", "open_review"]

_BLOCK = 1 << 20  # bytes
_PATIENCE_S = 60.0  # for Rerun to write what is logged


class ReviewFile:
    """Copies Rerun's output from a pipe to a file, in a thread.

    After an error, further output is discarded.
    """

    def __init__(self, stream: rr.RecordingStream, file: IO[bytes]) -> None:
        """Connect ``stream`` to ``file``."""
        self._stream, self._file = stream, file
        self._error: OSError | None = None
        with tempfile.TemporaryDirectory(prefix="shapecat-") as folder:
            pipe = Path(folder) / "review.rrd"
            os.mkfifo(pipe)
            self._pipe = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)  # does not wait for a writer
            stream.save(pipe)
        os.set_blocking(self._pipe, True)
        self._thread = Thread(target=self._take, daemon=True)
        self._thread.start()

    def _take(self) -> None:
        with os.fdopen(self._pipe, "rb", buffering=0) as pipe:
            while block := pipe.read(_BLOCK):
                if self._error is None:
                    try:
                        self._file.write(block)
                    except OSError as error:
                        self._error = error

    def flush(self) -> None:
        """Write everything logged so far.

        Raises
        ------
        OSError : the disk is full or failing.
        """
        self._stream.flush(timeout_sec=_PATIENCE_S)
        self.check()

    def check(self) -> None:
        """Raise the OSError of an earlier write, if there was one."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Write the remaining output and disconnect the stream."""
        self._stream.disconnect()
        self._thread.join()


@contextmanager
def open_review(path: Path, stream: rr.RecordingStream) -> Iterator[ReviewFile]:
    """Let a stream write to a file, which appears when the block succeeds.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    with replacing(path) as hidden, hidden.open("wb") as file:
        review = ReviewFile(stream, file)
        try:
            yield review
        finally:
            review.close()
        review.check()


def forget_reviews() -> None:
    """End the threads of earlier reviews and free their memory, which Rerun keeps until then.

    Active recordings of the program that calls shapecat stay active.
    """
    shared, own = rr.get_global_data_recording(), rr.get_thread_local_data_recording()
    rr.init("shapecat", init_logging=False)  # makes no recording, but ends unreferenced ones
    rr.set_global_data_recording(shared)
    rr.set_thread_local_data_recording(own)
