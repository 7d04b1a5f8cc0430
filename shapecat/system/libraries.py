"""Keep the processes of this program from loading libraries that they do not use."""

import sys
from importlib.abc import MetaPathFinder
from types import FrameType
from typing import Any

__all__ = ["block_unused"]

_LINEAR_ALGEBRA = "scipy.linalg"
_ASKS = "numba.np.linalg"
"""The module with which numba looks for linear algebra."""


class _Blocker(MetaPathFinder):
    """Raises for pandas, and for SciPy's linear algebra if numba asks, even if they are installed.

    None in `sys.modules` would do the same, but scikit-learn looks for a module there.
    """

    def find_spec(self, fullname: str, *_: Any) -> None:
        """Raise ModuleNotFoundError for blocked modules; leave others to other finders."""
        if fullname == "pandas" or (fullname == _LINEAR_ALGEBRA and _numba_asks()):
            msg = f"this process does without {fullname}"
            raise ModuleNotFoundError(msg, name=fullname)


def _numba_asks() -> bool:
    """Return whether numba's search for linear algebra is among the callers."""
    frame: FrameType | None = sys._getframe()  # noqa: SLF001  inspect takes longer
    while frame is not None and frame.f_globals.get("__name__") != _ASKS:
        frame = frame.f_back
    return frame is not None


def block_unused() -> None:
    """Keep this process from importing what no command uses; for processes of shapecat alone.

    With its first array, Arrow loads pandas where it is installed, in order to recognise data
    frames: 0.4 s in each process. With its first kernel, numba loads SciPy's linear algebra, which
    no kernel calls: 0.1 s.
    """
    sys.meta_path.insert(0, _Blocker())
