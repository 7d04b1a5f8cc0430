"""The command line: ``shapecat`` or ``python -m shapecat``."""

import signal
from importlib import import_module
from typing import Any

from shapecat.system.garbage import collect_seldom
from shapecat.system.libraries import block_unused
from shapecat.system.standard_streams import forgive_stderr, require_stdout
from shapecat.system.stopping import exit_at_once


def run() -> None:
    """Run the command line. Until it handles signals itself, a signal ends the process."""
    _handle(exit_at_once)
    require_stdout()
    forgive_stderr()
    collect_seldom()
    block_unused()
    try:
        # By name: type checkers see this package as the top-level folder cli.
        import_module("shapecat.cli.main").main(prog_name="shapecat")
    finally:
        _handle(signal.SIG_IGN)  # the exit code is decided; Python would restore the default


def _handle(handler: Any) -> None:
    """Set the handler of the signals that ask to stop, unless they are ignored already."""
    for signum in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, handler)


if __name__ == "__main__":
    run()
