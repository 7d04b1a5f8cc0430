"""A hundred thousand recordings on 1 to 1,000 workers, simulated from measured costs.

    python -m benchmarks.cluster            writes docs/images/scaling.png, prints the tables
    python -m benchmarks.cluster --check    compares the model with 1 to 4 workers on this machine
    python -m benchmarks.cluster --limits N measures planning and manifest with N recordings

This program measures the costs of sending a task to a worker with Dask, of a line of the manifest,
and of planning a recording. `benchmarks.whole` measures the CPU time per frame, which is an option
here. `Assumed` lists the assumptions.
"""

import heapq
import json
import math
import resource
import tempfile
import time
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import click
import numpy as np

from benchmarks.batch import process
from benchmarks.measure import markdown
from shapecat.batch.ledger import Ledger
from shapecat.batch.manifest import Entry, FileManifest, RemoteManifest
from shapecat.batch.plans import _Planner, plan_batch
from shapecat.batch.sources import Source
from shapecat.batch.storage import Location
from shapecat.executors import open_executor
from shapecat.runs.jobs import Job

ROOT = Path(__file__).parents[1]
WORKERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
LINES = 3  # lines of the manifest for each recording: planned, running, complete


@dataclass(frozen=True, kw_only=True)
class Assumed:
    """Assumptions of the simulation."""

    recordings: int = 100_000
    median_frames: float = 1800.0  # a minute at 30 Hz
    spread: float = 0.8  # standard deviation of the logarithm of the number of frames
    read_mb: float = 0.086  # per frame: compressed depth and transforms
    written_mb: float = 0.133  # per frame: annotated.mcap, review.rrd, tables
    tables_mb: float = 0.016  # the tables' part of written_mb
    storage_mb_s: float = 1250.0  # shared by all workers: a file server on 10 Gbit/s
    stream_mb_s: float = 250.0  # limit of one worker
    startup_s: float = 3.0  # of a worker, once
    recording_s: float = 0.1  # CPU time of a recording in addition to its frames
    cores: int = 0  # shared by the workers; 0 for one core each


@dataclass(frozen=True)
class Measured:
    """Seconds per frame, task, manifest line and planned recording, measured on this machine."""

    frame_s: float
    task_s: float
    line_s: float
    plan_s: float


class Queue:
    """A resource that serves one request after the other."""

    def __init__(self) -> None:
        """Begin without requests."""
        self.free = self.busy = 0.0

    def serve(self, now: float, seconds: float) -> float:
        """Return the time at which a request that arrives at ``now`` has been served."""
        self.free = max(self.free, now) + seconds
        self.busy += seconds
        return self.free


def simulate(workers: int, costs: Measured, given: Assumed) -> dict[str, float]:
    """Return the hours, the efficiency, and the utilization of each shared resource.

    All but the hours are fractions; the last one is of planning. Recordings are sent out largest
    first. Each one queues for the scheduler, for reading from the storage, for its worker's core,
    for writing to the storage, and for the manifest.
    """
    rng = np.random.default_rng(0)
    frames = rng.lognormal(math.log(given.median_frames), given.spread, given.recordings)
    crowded = max(1.0, workers / given.cores) if given.cores else 1.0
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
            spent = n * costs.frame_s + given.recording_s
            after, state = now + crowded * spent, "write"
            compute += spent
        elif state == "write":
            alone = n * given.written_mb / given.stream_mb_s
            after = max(storage.serve(now, n * given.written_mb / given.storage_mb_s), now + alone)
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


def _task_s(executor: Executor, count: int) -> float:
    list(executor.map(abs, range(20)))
    begun = time.perf_counter()
    for future in [executor.submit(abs, k) for k in range(count)]:
        future.result()
    return (time.perf_counter() - begun) / count


def measure(frame_s: float) -> Measured:
    """Measure the costs of the shared resources, with one Dask worker; ``frame_s`` is given."""
    with tempfile.TemporaryDirectory() as folder:
        manifest = FileManifest(Path(folder) / "manifest.jsonl")
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
    with open_executor("dask", workers=1) as executor:
        return Measured(frame_s, _task_s(executor, 500), line_s, plan_s)


def draw(path: Path, results: dict[str, list[dict[str, float]]]) -> None:
    """Draw hours and efficiency over workers; ``results`` are those of `simulate`, by case."""
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


def per_hour(costs: Measured, given: Assumed) -> list[tuple[str, ...]]:
    """Return rows of the cost of a recorded hour: hardware, wall s, CPU hours, GB, bottleneck."""
    frames = 30 * 3600.0
    cpu_h = frames * costs.frame_s / 3600
    rows: list[tuple[str, ...]] = []
    for cores, storage_mb_s, written, words in (
        (1, given.storage_mb_s, given.written_mb, "one core"),
        (2, given.storage_mb_s, given.written_mb, "two cores"),
        (200, given.storage_mb_s, given.written_mb, "100 nodes of two cores, 10 Gbit/s"),
        (200, 10 * given.storage_mb_s, given.written_mb, "the same, 100 Gbit/s"),
        (200, given.storage_mb_s, given.tables_mb, "the same, tables alone, 10 Gbit/s"),
    ):
        gigabytes = frames * (given.read_mb + written) / 1000
        storage_s = 1000 * gigabytes / storage_mb_s
        compute_s = 3600 * cpu_h / cores
        wall_s = max(storage_s, compute_s)
        bound = "storage" if storage_s > compute_s else "cores"
        rows.append((words, f"{wall_s:.0f}", f"{cpu_h:.2f}", f"{gigabytes:.0f}", bound))
    return rows


def check(folder: Path, *, recordings: int, frames: int) -> list[tuple[str, ...]]:
    """Compare the model with runs on this machine; return a row for each of 1 to 4 workers.

    A row has the number of workers, the measured and the modelled seconds, and the error of the
    model (%), which assumes two cores. ``folder`` is an empty scratch folder.
    """
    from tests.scenes import record  # noqa: PLC0415  the small scene of the tests

    (folder / "in").mkdir()
    for k in range(recordings):
        record(folder / "in" / f"{k:02}.mcap", frames)
    one = record(folder / "one.mcap", 1)

    def wall_s(name: str, source: Path, jobs: int) -> float:
        code, seconds = process(source, folder / name, "--jobs", str(jobs), "--no-rrd")
        assert code == 0
        return seconds

    startup_s, long_s = wall_s("a", one, 1), wall_s("b", folder / "in" / "00.mcap", 1)
    frame_s = (long_s - startup_s) / (frames - 1)
    base_s = wall_s("w1", folder / "in", 1)
    recording_s = max(0.0, (base_s - startup_s) / recordings - frames * frame_s)
    given = Assumed(
        recordings=recordings,
        median_frames=frames,
        spread=0.0,
        read_mb=0.0,
        written_mb=0.0,
        startup_s=startup_s,
        recording_s=recording_s,
        cores=2,
    )
    costs = Measured(frame_s, 0.001, 0.0001, 0.001)
    rows: list[tuple[str, ...]] = []
    for workers in range(1, 5):
        told = 3600 * simulate(workers, costs, given)["hours"]
        seen = base_s if workers == 1 else wall_s(f"w{workers}", folder / "in", workers)
        rows.append((f"{workers}", f"{seen:.1f}", f"{told:.1f}", f"{100 * (told / seen - 1):+.0f}"))
    return rows


def limits(count: int) -> tuple[str, ...]:
    """Plan synthetic recordings, record them as complete, read the manifest, and plan again.

    Return a row of the table. There are no results, so run.json is replaced by its expected keys.
    """
    first = f"kitchen_{0:07}"
    named = [
        (name := f"kitchen_{k:07}", Source("", f"s3://lab/{name}.mcap", name, "", f"{k:016x}", 4))
        for k in range(count)
    ]
    job, out = Job(Path(), Path()), "memory://out"
    spent, before = [time.process_time()], peak_mb()
    manifest = RemoteManifest(out)
    tasks = _Planner(job, out, set(), manifest.entries).tasks(named)
    spent.append(time.process_time())
    ledger = Ledger(manifest)
    ledger.record_planned(tasks)
    for some in range(0, count, 1000):
        entries = [task.entry() for task in tasks[some : some + 1000]]
        manifest.record(
            replace(e, state="complete", frames=1800, seconds=46.4, tracks={"cup": 3}, tries=1)
            for e in entries
        )
    manifest.send()
    spent.append(time.process_time())
    origins = {task.job.target: {"input": task.source.key, "work": task.work} for task in tasks}
    del manifest, tasks, ledger
    again = RemoteManifest(out)
    spent.append(time.process_time())
    with patch("shapecat.batch.plans.run_of", lambda job: {"origin": origins[job.target]}):
        tasks = _Planner(job, out, {name for name, _ in named}, again.entries).tasks(named)
    assert tasks[0].name == first
    assert all(task.status == "complete" for task in tasks)
    spent.append(time.process_time())
    seconds = [f"{after - before:.1f}" for before, after in pairwise(spent)]
    stored = sum(info["size"] for _, info in Location(f"{out}/.manifest").walk()) / 1e6
    return (f"{count:,}", *seconds, f"{stored:.0f}", f"{peak_mb() - before - stored:.0f}")


def peak_mb() -> float:
    """Return the peak memory of this process in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@click.command()
@click.option("--frame-ms", default=9.8, help="CPU time per frame with all outputs.")
@click.option("--recordings", default=100_000, help="Number of simulated recordings.")
@click.option("--plot", type=click.Path(path_type=Path), default=ROOT / "docs/images/scaling.png")
@click.option("--check", "only_check", is_flag=True, help="Compare the model with 1 to 4 workers.")
@click.option("--limits", "count", type=int, metavar="N", help="Plan N synthetic recordings.")
def main(
    *, frame_ms: float, recordings: int, plot: Path, only_check: bool, count: int | None
) -> None:
    """Simulate, print tables and draw a plot."""
    if only_check:
        with tempfile.TemporaryDirectory() as folder:
            rows = check(Path(folder), recordings=16, frames=60)
        print(markdown("model", ("workers", "measured s", "model s", "error %"), rows))
    elif count:
        columns = ("recordings", "plan s", "write s", "read s", "plan again s", "MB stored", "MB")
        print(markdown("limits", columns, [limits(count)]))
    else:
        study(Assumed(recordings=recordings), frame_ms / 1000, plot)


def study(given: Assumed, frame_s: float, plot: Path) -> None:
    """Simulate the cluster, print tables, draw a plot."""
    costs = measure(frame_s)
    cases = {
        "all outputs, 10 Gbit/s": given,
        "all outputs, 100 Gbit/s": replace(given, storage_mb_s=10 * given.storage_mb_s),
        "tables alone, 10 Gbit/s": replace(given, written_mb=given.tables_mb),
    }
    results = {name: [simulate(n, costs, case) for n in WORKERS] for name, case in cases.items()}
    for title, rows in results.items():
        shown = [
            (f"{n}", f"{r['hours']:.1f}", *(f"{100 * r[key]:.1f}" for key in tuple(r)[1:]))
            for n, r in zip(WORKERS, rows, strict=True)
        ]
        columns = ("workers", "hours", "computing %", "storage %", "scheduler %", "manifest %")
        print(markdown(title, (*columns, "plan %"), shown))
    costs_of_it = ("", "wall s", "CPU-hours", "GB", "bound by")
    print(markdown("a recorded hour at 30 Hz", costs_of_it, per_hour(costs, given)))
    print(json.dumps(asdict(costs)))
    draw(plot, results)


if __name__ == "__main__":
    main()
