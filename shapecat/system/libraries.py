"""Keep the processes of this program from loading a library that they do not use."""

import sys
from importlib.abc import MetaPathFinder
from typing import Any

__all__ = ["block_pandas"]


class _PandasBlocker(MetaPathFinder):
    """Raises for pandas, even if it is installed.

    None in `sys.modules` would do the same, but scikit-learn looks for a module there.
    """

    def find_spec(self, fullname: str, *_: Any) -> None:
        """Raise ModuleNotFoundError for pandas; leave other modules to other finders."""
        if fullname == "pandas":
            msg = "this process does without pandas"
            raise ModuleNotFoundError(msg, name=fullname)


def block_pandas() -> None:
    """Keep this process from importing pandas; for processes that run nothing but shapecat.

    With its first array, Arrow loads pandas where it is installed, in order to recognise data
    frames. That takes 0.4 s in each process, and no command uses data frames.
    """
    sys.meta_path.insert(0, _PandasBlocker())
