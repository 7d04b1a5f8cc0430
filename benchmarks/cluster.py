"""A hundred thousand recordings on 1 to 1,000 workers, simulated from measured costs.

    python -m benchmarks.cluster          writes docs/images/scaling.png, prints the table

What is measured here: what handing a task to a worker costs (locally and with Dask), what a line
of the manifest costs, what planning a recording costs. What is measured elsewhere and given as an
option: CPU time per frame (`benchmarks.whole`). What is assumed is written in `Assumed`.
"""

import heapq
import json
import math
import tempfile
import time
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import click
import numpy as np

from benchmarks.measure import markdown, save
from shapecat.batch.manifest import Entry, Manifest
from shapecat.batch.plans import plan_batch
from shapecat.executors import open_executor
from shapecat.runs.jobs import Job

ROOT = Path(__file__).parents[1]
WORKERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
LINES = 3  # of the manifest for each recording: planned, running, complete


@dataclass(frozen=True)
class Assumed:
    """What the simulation takes as given."""

    recordings: int = 100_000
    median_frames: float = 1800.0  # a minute at 30 Hz
    spread: float = 0.8  # of the logarithm of the frames: some last ten minutes
    read_mb: float = 0.105  # per frame, compressed depth and transforms
    written_mb: float = 0.41  # per frame: annotated.mcap, review.rrd, tables
    storage_mb_s: float = 1250.0  # shared by all: a file server on 10 Gbit/s
    stream_mb_s: float = 250.0  # one worker alone
    startup_s: float = 3.0  # of a worker, once


@dataclass(frozen=True)
class Measured:
    """Seconds, measured on the machine that runs this."""

    frame_s: float
    task_s: float
    line_s: float
    plan_s: float


class Queue:
    """A resource that serves one request after the other."""

    def __init__(self) -> None:
        """Begin free."""
        self.free = self.busy = 0.0

    def serve(self, now: float, seconds: float) -> float:
        """Return when a request that comes now has been served."""
        self.free = max(self.free, now) + seconds
        self.busy += seconds
        return self.free


def simulate(
    workers: int, costs: Measured, given: Assumed, *, written_mb: float | None = None
) -> dict[str, float]:
    """Return hours, efficiency, and how busy each shared resource was.

    Recordings are handed out largest first. Each waits its turn for the scheduler, for the
    storage to read from, for its worker's core, for the storage to write to, and for the manifest.
    """
    rng = np.random.default_rng(0)
    frames = rng.lognormal(math.log(given.median_frames), given.spread, given.recordings)
    written = given.written_mb if written_mb is None else written_mb
    scheduler, storage, manifest = Queue(), Queue(), Queue()
    planned = costs.plan_s * given.recordings
    todo = iter(np.sort(frames)[::-1].tolist())
    events = [(planned + given.startup_s, k, "idle", 0.0) for k in range(workers)]
    end = compute = 0.0
    while events:
        now, k, state, n = heapq.heappop(events)
        if state == "idle":
            n = next(todo, 0.0)
            if not n:
                continue
            after, state = scheduler.serve(now, costs.task_s), "read"
        elif state == "read":
            alone = n * given.read_mb / given.stream_mb_s
            after = max(storage.serve(now, n * given.read_mb / given.storage_mb_s), now + alone)
            state = "work"
        elif state == "work":
            after, state = now + n * costs.frame_s, "write"
            compute += n * costs.frame_s
        elif state == "write":
            alone = n * written / given.stream_mb_s
            after = max(storage.serve(now, n * written / given.storage_mb_s), now + alone)
            state = "note"
        else:
            after, state = manifest.serve(now, LINES * costs.line_s), "idle"
            end = max(end, after)
        heapq.heappush(events, (after, k, state, n))
    return {
        "hours": end / 3600,
        "efficiency": compute / (workers * end),
        "storage": storage.busy / end,
        "scheduler": scheduler.busy / end,
        "manifest": manifest.busy / end,
        "plan": planned / end,
    }


def nothing(_: int) -> None:
    """Stand in for a task."""


def _task_s(executor: Executor, count: int) -> float:
    list(executor.map(nothing, range(20)))
    begun = time.perf_counter()
    for future in [executor.submit(nothing, k) for k in range(count)]:
        future.result()
    return (time.perf_counter() - begun) / count


def measure(frame_s: float) -> dict[str, Measured]:
    """Measure what the shared parts cost, with each executor that is installed."""
    with tempfile.TemporaryDirectory() as folder:
        manifest = Manifest(Path(folder) / "manifest.jsonl")
        entry = Entry("kitchen_0123", "/data/2024/kitchen_0123.mcap", "running", "0" * 16, "1" * 16)
        begun = time.perf_counter()
        for _ in range(1000):
            manifest.record([entry])
        line_s = (time.perf_counter() - begun) / 1000
        files = [Path(folder) / f"{k}.mcap" for k in range(2000)]
        for file in files:
            file.touch()
        begun = time.perf_counter()
        with plan_batch(Job(Path(), Path()), list(map(str, files)), f"{folder}/out"):
            plan_s = (time.perf_counter() - begun) / len(files)
    found = {}
    for name in ("local", "dask"):
        with open_executor(name, workers=1) as executor:
            found[name] = Measured(frame_s, _task_s(executor, 500), line_s, plan_s)
    return found


def draw(path: Path, results: dict[str, list[dict[str, float]]]) -> None:
    """Draw hours and efficiency over workers."""
    import matplotlib as mpl  # noqa: PLC0415  only here

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name, rows in results.items():
        left.loglog(WORKERS, [row["hours"] for row in rows], marker="o", ms=3, label=name)
        share = [100 * row["efficiency"] for row in rows]
        right.semilogx(WORKERS, share, marker="o", ms=3, label=name)
    ideal = next(iter(results.values()))[0]["hours"]
    left.loglog(WORKERS, [ideal / n for n in WORKERS], "k:", lw=1, label="ideal")
    left.set(xlabel="workers, one core each", ylabel="hours")
    right.set(
        xlabel="workers, one core each", ylabel="% of the time spent computing", ylim=(0, 105)
    )
    for axes in (left, right):
        axes.grid(visible=True, alpha=0.3)
    left.legend(fontsize=8)
    figure.savefig(path, dpi=110)


@click.command()
@click.option("--frame-ms", default=25.8, help="CPU time per frame, all outputs on.")
@click.option("--recordings", default=100_000)
@click.option("--plot", type=click.Path(path_type=Path), default=ROOT / "docs/images/scaling.png")
def main(*, frame_ms: float, recordings: int, plot: Path) -> None:
    """Simulate, print a table, draw a plot, write ``build/benchmarks_cluster.json``."""
    given = Assumed(recordings=recordings)
    wide = replace(given, storage_mb_s=10 * given.storage_mb_s)
    costs = measure(frame_ms / 1000)["dask"]
    lean = 0.003 + given.read_mb / 1000  # MB per frame: tables alone
    results = {
        "all outputs, 10 Gbit/s": [simulate(n, costs, given) for n in WORKERS],
        "all outputs, 100 Gbit/s": [simulate(n, costs, wide) for n in WORKERS],
        "tables alone, 10 Gbit/s": [simulate(n, costs, given, written_mb=lean) for n in WORKERS],
    }
    for title, rows in results.items():
        shown = [
            (n, f"{r['hours']:.1f}", *(f"{100 * r[key]:.1f}" for key in tuple(r)[1:]))
            for n, r in zip(WORKERS, rows, strict=True)
        ]
        columns = ("workers", "hours", "computing %", "storage %", "scheduler %", "manifest %")
        print(markdown(title, (*columns, "plan %"), shown))
    print(json.dumps(asdict(costs)))
    draw(plot, results)
    figures = {"assumed": asdict(given), "measured": asdict(costs), "results": results}
    save(ROOT / "build" / "benchmarks_cluster.json", figures)


if __name__ == "__main__":
    main()
