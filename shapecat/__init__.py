"""shapecat: from robot recordings to reviewed, labelled 3D objects."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shapecat.api import Run, open_recording, open_run, perceive, process

__all__ = ["Run", "open_recording", "open_run", "perceive", "process"]

__version__ = "0.1.0"

# Arrow reads this when it is loaded. Its own allocator holds 30 MB more during long recordings.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")


def __getattr__(name: str) -> Any:
    """Load `shapecat.api` when one of its names is first used; `shapecat --help` uses none."""
    if name in __all__:
        return getattr(import_module("shapecat.api"), name)
    msg = f"module 'shapecat' has no attribute {name!r}"
    raise AttributeError(msg)


def __dir__() -> list[str]:
    """List the names of `shapecat.api` for completion and ``help``, even before they are loaded."""
    return sorted({*globals(), *__all__})
