"""Find out whether spawned processes would run the main script again."""

import sys
from pathlib import Path

__all__ = ["runs_again"]


def runs_again() -> bool:
    """Return whether a spawned process would repeat the calls of the main script.

    A spawned process runs the main script to define its functions. Python's documentation asks for
    ``if __name__ == "__main__":`` around all calls; a script without ``__main__`` lacks that line.
    """
    path = getattr(sys.modules.get("__main__"), "__file__", None)
    if path is None:  # a console or a notebook, which cannot run again
        return False
    try:
        return "__main__" not in Path(path).read_text("utf-8")
    except (OSError, UnicodeDecodeError):
        return False
