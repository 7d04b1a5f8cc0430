"""Keep a command running when nobody can read its messages or its output."""

import io
import os
import sys

__all__ = ["forgive_stderr", "require_stdout"]


class _Forgiving(io.TextIOWrapper):
    """A stream that drops text if it cannot write it.

    Its methods use no global name: Python flushes stderr after it has cleared the modules.
    """

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        try:
            return super().write(text)
        except OSError:
            return len(text)

    def flush(self) -> None:
        """Write as much of the buffer as possible."""
        try:  # noqa: SIM105  `suppress` would be a global name
            super().flush()
        except OSError:
            pass


def require_stdout() -> None:
    """Make stdout the null device if it was closed before the start, as a daemon's may be.

    Otherwise the next opened file would get file descriptor 1, here and in worker processes.
    Characters that the encoding of the terminal lacks are escaped.
    """
    if sys.stdout is None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.set_inheritable(1, True)  # noqa: FBT003  it has no name
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    if sys.stdout.errors == "strict" and isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def forgive_stderr() -> None:
    """Make stderr drop messages if its disk is full or its terminal or reader is gone.

    If it was closed before the start, it becomes the null device: otherwise the next opened file
    would get file descriptor 2, and libraries would write their messages into it.
    """
    if sys.stderr is None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    encoding = getattr(sys.stderr, "encoding", None)
    stream = os.fdopen(2, "wb", closefd=False)
    sys.stderr = _Forgiving(stream, encoding, "backslashreplace", line_buffering=True)
