"""``shapecat`` and ``python -m shapecat``: the command line."""

import signal
from importlib import import_module

from shapecat.stopping import leave


def run() -> None:
    """Run the command line; a signal that comes before it listens ends the process."""
    for signum in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, leave)
    # By name: type checkers see this package as the top-level folder cli.
    import_module("shapecat.cli.main").main(prog_name="shapecat")


if __name__ == "__main__":
    run()
