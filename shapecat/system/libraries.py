"""Keep the processes of this program from loading libraries that they do not use."""

import sys
from importlib.abc import MetaPathFinder
from types import FrameType
from typing import Any

__all__ = ["block_unused"]

_BLOCKED_FOR = {"scipy.linalg": "numba.np.linalg", "coverage": "numba.misc.coverage_support"}
"""Blocked modules, each with the module of numba that must not import it; others may."""


class _Blocker(MetaPathFinder):
    """Blocks pandas, and modules that numba imports if they are installed but does not need.

    None in `sys.modules` would block them too, but scikit-learn takes any value there for a module.
    """

    def find_spec(self, fullname: str, *_: Any) -> None:
        """Raise ModuleNotFoundError for blocked modules; leave others to other finders."""
        if fullname == "pandas" or (
            fullname in _BLOCKED_FOR and _is_caller(_BLOCKED_FOR[fullname])
        ):
            msg = f"{fullname} is blocked in this process"
            raise ModuleNotFoundError(msg, name=fullname)


def _is_caller(module: str) -> bool:
    """Return whether code of the module with this name is on the call stack."""
    frame: FrameType | None = sys._getframe()  # noqa: SLF001  inspect takes longer
    while frame is not None and frame.f_globals.get("__name__") != module:
        frame = frame.f_back
    return frame is not None


def block_unused() -> None:
    """Keep this process from importing unused libraries; only for shapecat's own processes.

    With its first array, Arrow loads pandas where it is installed, in order to recognise data
    frames: 0.4 s in each process. With its first kernel, numba loads SciPy's linear algebra, which
    no kernel calls: 0.1 s. It also loads the library that measures the coverage of tests, if a
    developer has it: 0.05 s.
    """
    sys.meta_path.insert(0, _Blocker())
