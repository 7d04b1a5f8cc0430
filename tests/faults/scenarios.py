"""The commands to disturb, and the small simulated recordings that they process."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

SHAPECAT = (sys.executable, "-m", "shapecat")


@dataclass(frozen=True)
class Scenario:
    """A command on recordings: ``process`` with some cores, or a command on a finished run."""

    name: str
    recordings: tuple[str, ...]
    jobs: int = 1
    verb: str = "process"

    def prepare(self, store: Path, case: Path) -> None:
        """Link the recordings into a new case; copy the finished run that other commands need."""
        (case / "in").mkdir(parents=True)
        for name in self.recordings:
            os.link(store / name, case / "in" / name)
        if self.verb != "process":
            shutil.copytree(store / "reference" / "single" / "out", case / "out")
            if self.verb == "annotate":
                relabel(case / "out" / "table" / "tracks.csv")

    def command(self, case: Path, *options: str) -> list[str]:
        """Return the command line for the case in folder ``case``; ``options`` are of `process`."""
        run = str(case / "out" / "table")
        if self.verb == "annotate":
            return [*SHAPECAT, "annotate", run]
        if self.verb == "export":
            return [*SHAPECAT, "export", run, "--format", "crops", "--out", str(case / "crops")]
        paths = [str(case / "in" / name) for name in self.recordings]
        outputs = ["--out", str(case / "out"), "--jobs", str(self.jobs), "--progress", "jsonl"]
        return [*SHAPECAT, "process", *paths, *outputs, *options]

    @property
    def runs(self) -> tuple[str, ...]:
        """The names of the run folders."""
        return tuple(name.partition(".")[0] for name in self.recordings)


BATCH = ("one.mcap", "two.mcap", "three.bag")
SCENARIOS = (
    Scenario("single", ("table.mcap",)),
    Scenario("cores", ("long.mcap",), jobs=2),
    Scenario("long", ("long.mcap",)),
    Scenario("cloud", ("cloud.bag",)),
    Scenario("batch", BATCH),
    Scenario("batch of 2", BATCH, jobs=2),
    Scenario("annotate", ("table.mcap",), verb="annotate"),
    Scenario("export", ("table.mcap",), verb="export"),
)
_RECORDINGS = {
    "table.mcap": ("60", "1"),
    "long.mcap": ("160", "2"),
    "cloud.bag": ("40", "3", "--clouds"),
    "one.mcap": ("40", "4"),
    "two.mcap": ("30", "5", "--clouds"),
    "three.bag": ("40", "6"),
    "other.mcap": ("40", "7"),
}


def relabel(table: Path) -> None:
    """Fill in the label of the first track, as a user does."""
    head, first, *rest = table.read_text("utf-8").splitlines()
    column = head.split(",").index("label")
    cells = first.split(",")
    cells[column] = "box"
    table.write_text("\n".join([head, ",".join(cells), *rest]) + "\n", "utf-8")


def record_all(store: Path, names: set[str]) -> None:
    """Simulate the recordings that are missing, two at a time."""
    missing = sorted(name for name in names if not (store / name).exists())
    for pair in (missing[i : i + 2] for i in range(0, len(missing), 2)):
        running = [subprocess.Popen(_simulate(store / name)) for name in pair]
        if any(process.wait() for process in running):
            msg = f"{pair}: cannot be simulated"
            raise RuntimeError(msg)


def _simulate(path: Path) -> list[str]:
    frames, seed, *options = _RECORDINGS[path.name]
    return [*SHAPECAT, "simulate", str(path), "--frames", frames, "--seed", seed, *options]
