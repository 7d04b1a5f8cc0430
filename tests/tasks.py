"""Functions that tests run in other processes; quick to import."""

import os
import signal
import sys
import time
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from shapecat.system import stopping


def kill_self(_: object = None) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def raise_error() -> None:
    msg = "as told"
    raise ValueError(msg)


def write_and_sleep(path: str) -> None:
    Path(path).write_text(str(os.getpid()), "utf-8")
    time.sleep(60)


class Unreadable:
    """Can be pickled but not unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return raise_error, ()

    def method(self) -> None:
        """Do nothing."""


def loads_pandas() -> bool:
    import pyarrow as pa  # noqa: PLC0415  in a worker

    pa.array([1])
    return "pandas" in sys.modules


def work_until_asked(path: str) -> None:
    Path(path).write_text("begun")
    while True:
        stopping.check()


def slow_at_times(k: int) -> tuple[int, int]:
    time.sleep(0.02 * (k % 7 == 0))
    return -k, os.getpid()


def frail(k: int) -> int:
    if parent_process() is not None and k % 50 == 20:
        os.kill(os.getpid(), signal.SIGKILL)
    return slow_at_times(k)[0]


def slow_elsewhere(seconds: float) -> int:
    if parent_process() is not None:
        time.sleep(seconds)
    return os.getpid()


def process_and_ones(k: int) -> Any:
    import numpy as np  # noqa: PLC0415  the only one that needs it

    return os.getpid(), np.ones(k)


def inverse_of_rest(k: int) -> int:
    return 1 // (12 - k)


class UnreadableError(Exception):
    """Cannot be unpickled, since its constructor needs more than a message."""

    def __init__(self, place: str, number: int) -> None:
        super().__init__(f"{place}, {number}")


def raise_unreadable() -> None:
    place = "here"
    raise UnreadableError(place, 1)
