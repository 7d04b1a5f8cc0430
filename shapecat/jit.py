"""The one place where kernels are compiled.

``@kernel`` is numba's ``njit`` with the settings of the house: the machine code is cached on disk,
the interpreter lock is released, and division by zero follows IEEE 754 as in numpy.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

__all__ = ["kernel"]

_F = TypeVar("_F", bound=Callable[..., Any])

_FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""Fast-math flags that keep infinities: sums and minima may be vectorised."""


def kernel(function: _F | None = None, *, fast: bool = False, inline: bool = False) -> Any:
    """Compile a function of numbers and arrays on its first call.

    Parameters
    ----------
    fast : let the compiler reorder sums. Only for kernels that never meet NaN.
    inline : make it part of its callers, where the call would cost more than the work.
    """

    def compile_later(target: _F) -> Any:
        return njit(
            cache=True,
            nogil=True,
            error_model="numpy",
            fastmath=_FAST if fast else False,
            forceinline=inline,
        )(target)

    return compile_later if function is None else compile_later(function)
