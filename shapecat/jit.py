"""The one place where kernels are compiled.

``@kernel`` is numba's ``njit`` with the settings of the house: the machine code is cached on disk,
the interpreter lock is released, and division by zero follows IEEE 754 as in numpy.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numba.core.event import Event, Listener, install_listener

__all__ = ["CompileClock", "compile_clock", "kernel", "unset"]

_F = TypeVar("_F", bound=Callable[..., Any])

_FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""Fast-math flags that keep infinities: sums and minima may be vectorised."""


def kernel(
    function: _F | None = None, *, fast: bool = False, inline: bool = False, leaf: bool = False
) -> Any:
    """Compile a function of numbers and arrays on its first call.

    Parameters
    ----------
    fast : let the compiler reorder sums. Only for kernels that never meet NaN.
    inline : make it part of its callers, where the call would cost more than the work.
    leaf : do not count references to the arrays it is given, which costs 20 ns a call. Only for
        kernels called by kernels that make no arrays and return numbers.
    """

    def compile_later(target: _F) -> Any:
        return njit(
            cache=True,
            nogil=True,
            error_model="numpy",
            fastmath=_FAST if fast else False,
            forceinline=inline,
            _nrt=not leaf,
        )(target)

    return compile_later if function is None else compile_later(function)


@kernel
def unset(shape: Any, dtype: Any) -> Any:
    """Return an array for kernels that write what they read: to clear an image takes 0.03 ms."""
    return np.empty(shape, dtype)  # noqa: TID251  the only one


class CompileClock(Listener):  # type: ignore[misc]  # numba has no types
    """Counts the seconds spent compiling while it listens; none when all kernels are cached."""

    def __init__(self, on_first: Callable[[], None]) -> None:
        """Call ``on_first`` when the first kernel is compiled."""
        self.seconds = 0.0
        self._on_first = on_first
        self._depth = 0
        self._begun = 0.0

    def on_start(self, event: Event) -> None:  # noqa: ARG002  numba's signature
        """Start the clock at the outermost kernel; the kernels it calls are compiled within."""
        if self._depth == 0:
            self._begun = time.perf_counter()
            if self.seconds == 0:
                self._on_first()
        self._depth += 1

    def on_end(self, event: Event) -> None:  # noqa: ARG002  numba's signature
        """Stop the clock."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._begun


@contextmanager
def compile_clock(on_first: Callable[[], None]) -> Iterator[CompileClock]:
    """Measure the compilation that happens in the block."""
    clock = CompileClock(on_first)
    with install_listener("numba:compile", clock):
        yield clock
