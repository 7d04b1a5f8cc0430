"""Return memory to the operating system."""

import ctypes
from contextlib import suppress

import pyarrow as pa

__all__ = ["release_memory"]


def release_memory() -> None:
    """Return freed memory to the operating system."""
    pa.default_memory_pool().release_unused()
    with suppress(OSError, AttributeError):  # glibc keeps small freed blocks
        ctypes.CDLL(None).malloc_trim(0)
