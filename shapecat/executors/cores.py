"""Count and share the cores, and limit the threads of numeric libraries."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["THREAD_LIMITS", "share_cores", "single_threaded", "usable_cores"]

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Environment variables for the number of threads, which numeric libraries read when loaded."""


_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""File with the CPU time that a container may use per period, and the period, microseconds."""


def usable_cores() -> int:
    """Return the number of cores this process may use.

    It is limited by taskset, Slurm or a cpuset, and by the CPU quota of a container.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    cores = cores or 1
    with suppress(OSError, ValueError):  # no such file; "max": no quota
        quota, period = map(int, _QUOTA.read_text().split())
        cores = min(cores, math.ceil(quota / period))
    return max(cores, 1)


def share_cores(jobs: int | None, recordings: int) -> tuple[int, int]:
    """Return the number of recordings, and of frames in each, to process at the same time.

    The product does not exceed the usable cores, unless ``jobs`` does.

    Parameters
    ----------
    jobs : number of cores to use; None for all.
    recordings : number of recordings to process.
    """
    jobs = jobs or usable_cores()
    workers = max(1, min(jobs, recordings))
    return workers, max(1, min(jobs, usable_cores()) // workers)


@contextmanager
def single_threaded() -> Iterator[None]:
    """Give numeric libraries one thread in processes that are started during the block."""
    before = {name: os.environ.get(name) for name in THREAD_LIMITS}
    os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
