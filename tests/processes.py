"""Processes that tests start, observe and kill: workers, clusters, commands."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = [
    "QUIET",
    "DaskCluster",
    "alive",
    "children",
    "descendants",
    "free_address",
    "obey_interrupts",
    "obey_interrupts_at_low_priority",
    "wait_for",
]

QUIET: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def alive(process: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text("utf-8").rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def children(process: int) -> list[int]:
    """Return the child processes of a process."""
    threads = Path(f"/proc/{process}/task").glob("*/children")
    return [int(pid) for thread in threads for pid in thread.read_text().split()]


def descendants(process: int) -> list[int]:
    """Return the child processes of a process, with their own children."""
    return [pid for child in children(process) for pid in (child, *descendants(child))]


def wait_for(condition: Callable[[], object], seconds: float = 20) -> None:
    """Wait until a condition holds; fail after some time."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "condition not met in time"
        time.sleep(0.02)


def obey_interrupts() -> None:
    """Obey interrupts even if the shell lets its background jobs ignore them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def obey_interrupts_at_low_priority() -> None:
    """Obey interrupts, at a low priority, so that the command does not end before the signal."""
    obey_interrupts()
    os.nice(10)


def free_address() -> str:
    """Return an address that a scheduler can listen at."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp://127.0.0.1:{server.getsockname()[1]}"


class DaskCluster:
    """A scheduler and two workers, each in its own folder, so that they share no disk."""

    def __init__(self, address: str, folder: Path) -> None:
        """Start the scheduler and the workers."""
        host = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")
        port = address.rpartition(":")[2]
        self._processes = [self._start(folder, "scheduler", "--port", port, *host)]
        self._processes += [
            self._start(folder / name, "worker", address, "--nthreads", "1", *host)
            for name in ("worker0", "worker1")
        ]

    @staticmethod
    def _start(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "dask", *arguments]
        environment = {**os.environ, "TMPDIR": str(folder), "PYTHONPATH": str(Path.cwd())}
        return subprocess.Popen(
            command, cwd=folder, env=environment, start_new_session=True, **QUIET
        )

    def kill_a_worker(self) -> None:
        """Kill the process in which the first worker computes; its nanny starts another."""
        for child in children(self._processes[1].pid):
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                os.kill(child, signal.SIGKILL)

    def kill(self) -> None:
        """Kill the scheduler and the workers."""
        for process in self._processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
