"""The script that runs: whether processes that it starts would run it again."""

import sys
from pathlib import Path

__all__ = ["runs_again"]


def runs_again() -> bool:
    """Whether a process that is started runs the script again, since nothing in it asks for that.

    A spawned process runs the main script to know its functions. Python's documentation asks for
    ``if __name__ == "__main__":`` around all calls; a script that never says ``__main__`` has none.
    """
    path = getattr(sys.modules.get("__main__"), "__file__", None)
    if path is None:  # a console or a notebook, which nobody can run again
        return False
    try:
        return "__main__" not in Path(path).read_text("utf-8")
    except (OSError, UnicodeDecodeError):
        return False
