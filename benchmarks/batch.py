"""Many recordings: equal tables from every executor, and the speed-up of two cores.

    python -m benchmarks.batch            some minutes; prints a table

Recordings of three formats, some of them broken, are processed one at a time, two at a time, on
Dask, on Ray if it is installed, and in shards. It is an error if any tables differ.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import click

from benchmarks.measure import markdown
from benchmarks.whole import tabletop, write
from shapecat.batch.manifest import FileManifest
from tests.faults.invariants import same_results

FORMATS = ("mcap", "ros1", "ros2")
SHARDS = 4


def make(folder: Path, *, recordings: int, broken: int, frames: int) -> Path:
    """Write recordings of all formats, ``broken`` of which cannot be read; return the folder."""
    folder.mkdir()
    views = tabletop(60)
    for k in range(recordings - broken):
        start = (7 * k) % 60
        turned = [*views[start:], *views[:start]]
        write(folder / f"r{k:02}", turned, frames, container=FORMATS[k % len(FORMATS)])
    for k in range(broken):
        (folder / f"broken{k}{('.mcap', '.bag')[k % 2]}").write_bytes(b"no recording" * k)
    return folder


def process(recordings: Path, out: Path, *options: str) -> tuple[int, float]:
    """Run ``shapecat process``; return the exit code and the wall time."""
    command = [sys.executable, "-m", "shapecat", "process", str(recordings), "--out", str(out)]
    begun = time.perf_counter()
    done = subprocess.run([*command, *options], check=False, capture_output=True)
    return done.returncode, time.perf_counter() - begun


def ways() -> dict[str, Sequence[Sequence[str]]]:
    """Return the options of each way to process a batch, one list for each command to run."""
    every: dict[str, Sequence[Sequence[str]]] = {
        "--jobs 1": [["--jobs", "1"]],
        "--jobs 2": [["--jobs", "2"]],
        "--executor dask": [["--jobs", "2", "--executor", "dask"]],
        "--executor ray": [["--jobs", "2", "--executor", "ray"]],
        f"{SHARDS} shards": [["--jobs", "1", "--shard", f"{k}/{SHARDS}"] for k in range(SHARDS)],
    }
    if find_spec("ray") is None:
        del every["--executor ray"]
    return every


@click.command()
@click.option("--recordings", default=40, help="Number of recordings.")
@click.option("--broken", default=4, help="How many of them are broken.")
@click.option("--frames", default=60, help="Frames of each recording.")
def main(*, recordings: int, broken: int, frames: int) -> None:
    """Process a batch with each of the executors and print a table."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        made = make(root / "in", recordings=recordings, broken=broken, frames=frames)
        first, reference = 0.0, None
        for way, runs in ways().items():
            out = root / way.strip("-").replace(" ", "_")
            spent = [process(made, out, *options) for options in runs]
            wall_s = sum(seconds for _, seconds in spent)
            first = first or wall_s
            entries = FileManifest(out / "manifest.jsonl").entries.values()
            states = [entry.state for entry in entries]
            reference = reference or out
            names = [path.name for path in reference.glob("*/")]
            agree = not [*same_results(names, out, reference)]
            counts = {state: states.count(state) for state in ("complete", "failed")}
            codes = sorted({code for code, _ in spent})
            rows.append((way, *counts.values(), codes, f"{wall_s:.0f}", f"{wall_s / first:.2f}",
                         "yes" if agree else "NO"))  # fmt: skip
            if not agree or counts != {"complete": recordings - broken, "failed": broken}:
                for entry in entries:
                    print(entry.state, entry.folder, entry.message)
                raise SystemExit(1)
    columns = ("", "complete", "failed", "exit code", "s", "of --jobs 1", "same tables")
    print(markdown(f"{recordings} recordings of {frames} frames", columns, rows))


if __name__ == "__main__":
    main()
