"""Disturbances of the command: signals, dead workers, failing calls, a full disk, changed input."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from shapecat.system.files import FSYNC
from tests.processes import obey_interrupts

SIGNALS = {
    "interrupt": signal.SIGINT,
    "double": signal.SIGINT,
    "terminate": signal.SIGTERM,
    "kill": signal.SIGKILL,
}
COUNTERS = {"eioread": 0, "short": 0, "enospc": 1, "eio": 1, "erofs": 1, "clock": 2}
"""Kinds of failing calls, each with the index of its counter in shim.c."""
KINDS = (*SIGNALS, "worker", "replace", "tmpfs", *COUNTERS)
LIMIT_S = 120.0
"""A command that takes longer hangs."""
_LINGER_S = 8.0
"""Longest time that processes of a command may outlive it."""


@dataclass
class Ended:
    """The outcome of a command that has ended; times are in seconds after its start.

    ``lines`` are those of stderr with their times, ``fault_s`` is the time of the fault, and
    ``lingering`` the number of processes that outlived the command.
    """

    code: int
    seconds: float
    lines: list[tuple[float, str]] = field(default_factory=list)
    fault_s: float | None = None
    lingering: int = 0
    hung: bool = False

    @property
    def text(self) -> str:
        """All of stderr."""
        return "".join(line for _, line in self.lines)

    def events(self) -> list[tuple[float, dict[str, object]]]:
        """Return the lines that are JSON objects, with their times."""
        found = []
        for moment, line in self.lines:
            with contextlib.suppress(ValueError):
                event = json.loads(line)
                if isinstance(event, dict):
                    found.append((moment, event))
        return found


class Running:
    """A command in its own session, whose stderr is read as it is written."""

    def __init__(self, command: list[str], environment: Mapping[str, str] | None = None) -> None:
        self.begun = time.monotonic()
        self.lines: list[tuple[float, str]] = []
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            preexec_fn=obey_interrupts,  # noqa: PLW1509  there is no other way
            env={**os.environ, FSYNC: "1", **(environment or {})},
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        with self.process.stderr as stream:
            for line in stream:
                self.lines.append((time.monotonic() - self.begun, line))

    def wait_until(self, moment: float) -> bool:
        """Wait until ``moment`` seconds after the start; return whether the command still runs."""
        try:
            self.process.wait(max(0.0, self.begun + moment - time.monotonic()))
        except subprocess.TimeoutExpired:
            return True
        return False

    def send(self, number: int, *, group: bool) -> None:
        """Signal the command, or all of its processes."""
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if group else os.kill)(self.process.pid, number)

    def end(self, fault_s: float | None = None, limit_s: float = LIMIT_S) -> Ended:
        """Wait for the end of the command and of its processes; kill them if they take too long."""
        hung = self.wait_until(limit_s)
        if hung:
            self.send(signal.SIGKILL, group=True)
        code = self.process.wait()
        seconds = time.monotonic() - self.begun
        until = time.monotonic() + _LINGER_S
        while (left := session(self.process.pid)) and time.monotonic() < until:
            time.sleep(0.05)
        if left:
            self.send(signal.SIGKILL, group=True)
        self._reader.join(5.0)
        return Ended(code, seconds, self.lines, fault_s, len(left), hung)


def session(leader: int) -> list[int]:
    """Return the processes in the session of a leader, except the leader and zombies."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != leader:
            with contextlib.suppress(OSError, IndexError):
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                if int(fields[3]) == leader and fields[0] not in {"Z", "X"}:
                    found.append(int(entry.name))
    return sorted(found)


def disturb(kind: str, rng: random.Random, command: list[str], seconds: float) -> Ended:
    """Run a command, and signal it or kill a worker at a random time within ``seconds``."""
    running = Running(command)
    moment = rng.uniform(0.3, max(0.4, seconds))
    group = rng.random() < 0.5
    again = rng.uniform(0.05, 1.0)
    choice = rng.random()
    if not running.wait_until(moment):
        return running.end()
    if kind == "worker":
        workers = [p for p in session(running.process.pid) if not _tracks_resources(p)]
        if not workers:
            return running.end()
        with contextlib.suppress(ProcessLookupError):
            os.kill(workers[int(choice * len(workers))], signal.SIGKILL)
    else:
        running.send(SIGNALS[kind], group=group)
    if kind == "double" and running.wait_until(moment + again):
        running.send(SIGNALS[kind], group=group)
    return running.end(moment)


def _tracks_resources(process: int) -> bool:
    try:
        return b"resource_tracker" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return True


def replace_input(
    rng: random.Random, command: list[str], seconds: float, path: Path, other: Path
) -> Ended:
    """Run a command, and change its recording ``path`` at a random time within ``seconds``.

    It is replaced by ``other``, by a rename or in place, or cut in half.
    """
    moment, way = rng.uniform(0.3, max(0.4, seconds)), rng.choice(["rename", "rewrite", "cut"])
    content = path.read_bytes() if way == "cut" else other.read_bytes()
    copy = path.with_suffix(".copy")
    shutil.copyfile(path, copy)
    copy.replace(path)  # other cases have hard links to the recording
    running = Running(command)
    if not running.wait_until(moment):
        return running.end()
    if way == "rename":
        copy.write_bytes(content)
        copy.replace(path)
    else:
        path.write_bytes(content[: len(content) // 2] if way == "cut" else content)
    return running.end(moment)


def build_shim(folder: Path) -> Path | None:
    """Compile the library that makes calls fail; None without a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    library, source = folder / "shim.so", Path(__file__).with_name("shim.c")
    flags = ("-O2", "-shared", "-fPIC", "-o", str(library))
    subprocess.run([compiler, *flags, str(source), "-ldl"], check=True)
    return library


def shimmed(library: Path, kind: str, nth: int, case: Path) -> dict[str, str]:
    """Return an environment in which the ``nth`` call on files of ``case`` is the first to fail."""
    counts = case.with_name(f"{case.name}.counts")
    counts.write_bytes(bytes(24))
    return {
        "LD_PRELOAD": str(library),
        "FAULT_FOLDER": str(case),
        "FAULT_KIND": kind,
        "FAULT_NTH": str(nth),
        "FAULT_COUNTS": str(counts),
    }


def mount(folder: Path, megabytes: int) -> bool:
    """Mount a small disk at a folder; return False if that is not permitted."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "shapecat-faults", str(folder)]
    try:
        return subprocess.run(words, check=False, capture_output=True).returncode == 0
    except FileNotFoundError:
        return False


def enlarge(folder: Path) -> None:
    """Enlarge the small disk."""
    subprocess.run(["mount", "-o", "remount,size=300m", str(folder)], check=True)


def unmount(folder: Path) -> None:
    """Unmount the small disk."""
    subprocess.run(["umount", str(folder)], check=False, capture_output=True)
