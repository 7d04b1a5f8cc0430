"""Keep the processes of this program from loading a library for nothing."""

import sys
from importlib.abc import MetaPathFinder
from typing import Any

__all__ = ["leave_out_pandas"]


class _Absent(MetaPathFinder):
    """Finds no pandas, even if it is installed."""

    def find_spec(self, fullname: str, *_: Any) -> None:
        """Say of pandas that it is missing; leave other modules to other finders."""
        if fullname == "pandas":
            msg = "this process does without pandas"
            raise ModuleNotFoundError(msg, name=fullname)


def leave_out_pandas() -> None:
    """Let this process import no pandas; call it in processes that run nothing but shapecat.

    With its first array, Arrow loads pandas where it is installed, in order to recognise data
    frames. That takes 0.4 s in each process, and no command has any.
    """
    sys.meta_path.insert(0, _Absent())
