"""Errors shown to the user. Each message names the problem, the place, and what to try."""

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

__all__ = [
    "ConfigError",
    "ModelError",
    "NoStreamError",
    "OutputError",
    "RecordingError",
    "ShapecatError",
    "common_exit_code",
    "explained",
    "listed",
    "printable",
    "shortage",
]

_CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]")

_SHORTAGES = (
    "can't start new thread",
    "failed to map segment",  # when a library is loaded
    "Cannot allocate memory",
)
"""What errors other than `MemoryError` say if the system refuses memory or threads."""
_MOST_NAMES = 12
"""Largest number of names that `listed` shows."""


class ShapecatError(Exception):
    """A known problem: shown as one line, without a traceback."""

    exit_code = 1

    def __str__(self) -> str:
        return printable(super().__str__())


class RecordingError(ShapecatError):
    """A recording cannot be read: it is missing, damaged, or not a recording."""

    exit_code = 3


class NoStreamError(ShapecatError):
    """A readable recording has no usable frame or topic, or several sensors to choose from."""

    exit_code = 4


class ConfigError(ShapecatError):
    """A setting or option does not exist or has an invalid value."""

    exit_code = 2


class ModelError(ShapecatError):
    """A model file is missing, damaged or incompatible."""

    exit_code = 2


class OutputError(ShapecatError):
    """A result cannot be written, or the folder of a run cannot be used."""


@contextmanager
def explained(what: str, kind: type[ShapecatError]) -> Iterator[None]:
    """Raise an `OSError` of the block as ``kind``, with the message ``what`` and the reason."""
    try:
        yield
    except FileExistsError as error:  # of a folder that is made unless it exists
        msg = f"{what}: {error.filename} is not a folder"
        raise kind(msg) from error
    except OSError as error:
        msg = f"{what}: {error.strerror or error}"
        raise kind(msg) from error


def shortage(error: Exception) -> str:
    """Return the message for an error that is a lack of memory or threads; empty for others."""
    reason = str(error)
    if isinstance(error, MemoryError) or any(text in reason for text in _SHORTAGES):
        hint = "stop other programs, or raise the limits (ulimit)"
        return f"out of memory or threads ({reason or 'no reason given'}); {hint}"
    return ""


def common_exit_code(codes: Collection[int]) -> int:
    """Return the exit code that all recordings share; 1 if they differ, 0 without recordings."""
    different = set(codes) or {0}
    return different.pop() if len(different) == 1 else 1


def listed(names: Sequence[str]) -> str:
    """Return names as a message shows them: the first ones, and how many more there are."""
    left = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {left} more" if left > 0 else "")


def printable(text: str) -> str:
    r"""Escape the control characters of a text, except newlines.

    Names in a recording may hold sequences that change or clear the terminal.

    Examples
    --------
    >>> printable("/depth\x1b[2J")
    '/depth\\x1b[2J'
    """
    return _CONTROL.sub(lambda match: repr(match[0])[1:-1], text)
