"""The one place where kernels are compiled.

``@kernel`` is numba's ``njit`` with the settings of the house: the machine code is cached on disk
as long as the files of the stage stay as they are, the interpreter lock is released, and division
by zero follows IEEE 754 as in numpy.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import ll as llvm
from numba.core.compiler import CompileResult
from numba.core.event import Event, Listener, install_listener
from numba.core.runtime import rtsys

__all__ = ["CompileClock", "compile_clock", "kernel", "unset"]

_F = TypeVar("_F", bound=Callable[..., Any])

_FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""Fast-math flags that keep infinities: sums and minima may be vectorised."""
_SHARED = ("geometry.py", "jit.py", "triangles.py")
"""Files beside this one whose kernels stages call."""


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
        compiled = njit(
            nogil=True,
            error_model="numpy",
            fastmath=_FAST if fast else False,
            forceinline=inline,
            _nrt=not leaf,
        )(target)
        compiled._cache = _StageCache(target)  # noqa: SLF001  as `enable_caching` of numba does
        return compiled

    return compile_later if function is None else compile_later(function)


class _MachineCode(CompileResultCacheImpl):  # type: ignore[misc]  # numba has no types
    """What is kept of a kernel: machine code, and bitcode for kernels that call it."""

    def rebuild(self, target_context: Any, payload: Any) -> CompileResult:
        """Load the machine code, the bitcode when it is asked for: to read it takes far longer."""
        (name, kind, (code, bitcode)), described, *rest = payload
        names = {described.llvm_func_name, described.llvm_cpython_wrapper_name}
        target_context.codegen()._engine._defined_symbols |= names  # noqa: SLF001
        unread = (name, kind, (code, _no_bitcode()))
        result = super().rebuild(target_context, (unread, described, *rest))
        result.library._get_module_for_linking = cache(lambda: llvm.parse_bitcode(bitcode))  # noqa: SLF001
        return result


@cache
def _no_bitcode() -> bytes:
    module: bytes = llvm.parse_assembly("").as_bitcode()
    return module


class _StageCache(FunctionCache):  # type: ignore[misc]  # numba has no types
    """Numba's cache, for stages whose kernels are made of several files, and quick to start.

    It is out of date when any file that a kernel of the stage may be made of changed. Numba looks
    at the file of the outermost kernel alone, but that holds the code of all it calls.
    """

    _impl_class = _MachineCode

    def __init__(self, target: Callable[..., Any]) -> None:
        super().__init__(target)
        stage = _stage_of(Path(target.__code__.co_filename))
        self._cache_file._source_stamp = _stamp(stage)  # noqa: SLF001  it has no other place

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load machine code without all that compiling needs, which takes numba 0.3 s."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def _stage_of(file: Path) -> Path:
    """Return the folder of the stage that a file is of: one here, also for files further down."""
    here = Path(__file__).parent
    inside = (folder for folder in file.parents if folder.parent == here)
    return next(inside, file.parent)


@cache
def _stamp(stage: Path) -> tuple[tuple[str, float, int], ...]:
    """Return the names, times and sizes of the files of a stage, and of those all may call."""
    here = Path(__file__).parent
    found = () if stage == here else stage.rglob("*.py")
    files = {*found, *(here / name for name in _SHARED)}
    return tuple((str(f), f.stat().st_mtime, f.stat().st_size) for f in sorted(files))


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
