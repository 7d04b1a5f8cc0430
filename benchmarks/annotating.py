"""Time to rewrite annotated.mcap after a correction, compared with copying the recording.

    python -m benchmarks.annotating

Recording and copy are in the page cache; the result is the median of several repetitions.
"""

import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import click

from benchmarks.measure import markdown
from benchmarks.whole import tabletop, write
from shapecat.pipeline import annotate, process
from shapecat.recordings import open_recording
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job


def timed(work: Callable[[], object]) -> float:
    """Return the wall time of a call in seconds."""
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def again(folder: Path, recording: Path) -> None:
    """Write only annotated.mcap again, from the tables."""
    run = read_run(folder)
    run["options"]["rrd"] = False
    run["seconds"].pop("annotated.mcap")
    with open_recording(recording) as opened:
        annotate(folder, opened, run)


def measure(folder: Path, frames: int, turns: int) -> tuple[Any, ...]:
    """Return frames, size (MB), median times to annotate and to copy (s), and their ratio."""
    recording = write(folder / f"frames{frames}.mcap", tabletop(min(frames, 60)), frames)
    run = folder / f"run{frames}"
    process(Job(recording, run, rrd=False))
    copy = ["cp", str(recording), str(folder / "copy")]
    seconds: dict[str, list[float]] = {"annotate": [], "cp": []}
    for _ in range(turns):
        seconds["annotate"].append(timed(lambda: again(run, recording)))
        seconds["cp"].append(timed(lambda: subprocess.run(copy, check=True)))
    annotating, copying = map(median, seconds.values())
    megabytes = round(recording.stat().st_size / 1e6)
    ratio = f"{annotating / copying:.2f}"
    return frames, megabytes, round(annotating, 4), round(copying, 4), ratio


@click.command()
@click.option(
    "--frames",
    type=int,
    multiple=True,
    default=(300, 1000),
    help="Frames of a recording. Repeatable.",
)
@click.option("--turns", default=9, help="Number of repetitions.")
def main(*, frames: tuple[int, ...], turns: int) -> None:
    """Time `annotate` and a copy of recordings of ``frames`` frames; print the medians."""
    with tempfile.TemporaryDirectory() as folder:
        rows = [measure(Path(folder), count, turns) for count in frames]
    print(markdown("Annotating again", ("frames", "MB", "annotate s", "cp s", "ratio"), rows))


if __name__ == "__main__":
    main()
