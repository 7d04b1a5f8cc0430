"""How many cores there are to share, and threads kept from taking more than their part."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["THREAD_LIMITS", "limited_threads", "share_cores", "usable_cores"]

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""What numeric libraries read when they are loaded."""


def usable_cores() -> int:
    """Return the cores this process may use: what taskset, Slurm or a container leave it."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return cores or 1


def share_cores(jobs: int | None, recordings: int) -> tuple[int, int]:
    """Return how many recordings to process at once, and how many frames of each.

    Their product is no more than the cores, unless more ``jobs`` than cores are asked for.

    Parameters
    ----------
    jobs : cores to use; None for all.
    """
    jobs = jobs or usable_cores()
    workers = max(1, min(jobs, recordings))
    return workers, max(1, min(jobs, usable_cores()) // workers)


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Let processes started in the block use so many threads in numeric libraries."""
    before = {name: os.environ.get(name) for name in THREAD_LIMITS}
    os.environ.update(dict.fromkeys(THREAD_LIMITS, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
