"""Whole recordings: frames per second on one and two cores, and cost over the number of frames.

    python -m benchmarks.whole                     ten minutes
    python -m benchmarks.whole --full              also 10,000 frames: ten minutes more, a gigabyte
    python -m benchmarks.whole --against ../other  alternates with another checkout and its .venv

The camera moves back and forth, or stands still. The command runs as for a user, restricted to one
or two cores. The start-up time, which a run over the first frames measures, is subtracted and
reported. With two cores, the start of the second process is not subtracted.
"""

import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from itertools import count, cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from benchmarks.measure import markdown
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.simulation.containers import CONTAINERS
from shapecat.simulation.recorder import write_frame
from shapecat.types import Frame, Pose

EPOCH_NS, PERIOD_NS = 1_700_000_000_000_000_000, 33_333_333
SEED, OBJECTS = 11, 8
FEW_S = 0.1  # seconds of recording in the run that measures start-up
REPEATS, MANY = 3, 1000  # repetitions for recordings with fewer than MANY frames
THESIS = "thesis (2012): 0.2 s to find planes and objects, up to 2 s for each of 8 objects"


class View(NamedTuple):
    """A frame and the pose ``world_from_camera`` from which it was taken."""

    frame: Frame
    pose: Pose


def tabletop(frames: int, *, still: bool = False) -> list[View]:
    """Render a table with eight objects from a moving or still camera."""
    worlds = (
        make_scene("tabletop", np.random.default_rng(seed), frames=frames) for seed in count(SEED)
    )
    world = next(world for world in worlds if len(world.objects) == OBJECTS)
    views = []
    for k in range(frames):
        at = 0 if still else k
        frame, _ = render_frame(world, at, rng=np.random.default_rng(k), sensor=KINECT)
        views.append(View(frame, world.path[at]))
    return views


def write(path: Path, views: list[View], frames: int, *, container: str = "mcap") -> Path:
    """Write ``frames`` frames, back and forth through the views; ``path`` gets the right suffix."""
    suffix, kind = CONTAINERS[container]
    path = path.with_name(path.name.removesuffix(suffix) + suffix)
    to_and_fro = cycle([*views, *views[-2:0:-1]])
    with kind(path) as writer:
        for k, (frame, pose) in enumerate(islice(to_and_fro, frames)):
            write_frame(writer, replace(frame, index=k, stamp_ns=EPOCH_NS + k * PERIOD_NS), pose)
    return path


class Spent(NamedTuple):
    """Cost of a run, without compiling, and its run.json."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    run: dict[str, Any]


def spend(
    recording: Path, out: Path, cores: set[int], *options: str, checkout: Path | None = None
) -> Spent:
    """Run ``shapecat process``, of this or another checkout, on the given cores only."""
    out = out / (checkout.name if checkout else "here")  # another version does not overwrite runs
    out.mkdir(exist_ok=True)
    python = sys.executable if checkout is None else str(checkout / ".venv" / "bin" / "python")
    command = [python, "-m", "shapecat", "process", str(recording), "--out", str(out)]
    errors = out / "errors"
    begun = time.perf_counter()
    child = os.fork()
    if child == 0:
        os.chdir(checkout or Path.cwd())
        os.sched_setaffinity(0, cores)
        told = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(told, 1)
        os.dup2(told, 2)
        os.execv(python, [*command, "--overwrite", *options])  # noqa: S606  no shell
    _, status, usage = os.wait4(child, 0)
    if status != 0:
        raise RuntimeError(command, errors.read_text("utf-8", "replace")[-2000:])
    run = json.loads((out / recording.stem / "run.json").read_text("utf-8"))
    wall_s, cpu_s = time.perf_counter() - begun, usage.ru_utime + usage.ru_stime
    compiling = run["seconds"]["compile"]  # once per installation
    return Spent(wall_s - compiling, cpu_s - compiling, usage.ru_maxrss / 1024, run)


def speed(folder: Path, frames: int, repeats: int, against: Path | None) -> str:
    """Return a table of the frames per second with all outputs, on one core and on two."""
    rows: list[tuple[Any, ...]] = []
    for camera in ("walking", "still"):
        views = tabletop(60, still=camera == "still")
        recording = write(folder / f"{camera}.mcap", views, frames)
        for number in (1, 2):
            cores = set(sorted(os.sched_getaffinity(0))[:number])
            if len(cores) == number:
                rates = _measure(recording, folder, cores, repeats, against)
                rows.append((camera, number, *rates))
        recording.unlink()
    ratios = ("ratio", "CPU ratio") if against else ()
    columns = ("camera", "cores", "frames/s", "CPU ms/frame", "start-up s", "peak MB", *ratios)
    title = f"End to end, {OBJECTS} objects, 640×480, all outputs, {frames} frames"
    return markdown(title, columns, rows) + f"\n{THESIS}.\n"


def _measure(
    recording: Path, folder: Path, cores: set[int], repeats: int, against: Path | None
) -> list[float]:
    """Measure a recording, alternating with another checkout, as the machine may be shared.

    Return the frames per second, CPU time per frame (ms), start-up time (s) and peak memory (MB);
    with another checkout, also the ratios of speed and of CPU time.
    """
    rates: dict[Path | None, list[tuple[float, ...]]] = {}
    for _ in range(repeats):
        for checkout in (None, against) if against else (None,):
            few = spend(recording, folder, cores, "--end", str(FEW_S), checkout=checkout)
            whole = spend(recording, folder, cores, checkout=checkout)
            done = whole.run["counts"]["frames"] - few.run["counts"]["frames"]
            fps = done / (whole.wall_s - few.wall_s)
            cpu_ms = 1e3 * (whole.cpu_s - few.cpu_s) / done
            measured = (fps, cpu_ms, few.wall_s, whole.peak_mb)
            rates.setdefault(checkout, []).append(measured)
    fps, cpu_ms, startup_s, peak_mb = max(rates[None])
    found = [round(fps, 1), round(cpu_ms, 2), round(startup_s, 2), round(peak_mb)]
    if against:
        other, other_cpu_ms, *_ = max(rates[against])
        found += [round(fps / other, 2), round(other_cpu_ms / cpu_ms, 2)]
    return found


def growth(folder: Path, counts: list[int]) -> str:
    """Return a table of CPU time per additional frame and peak memory, by number of frames."""
    views = tabletop(60)
    cores = set(sorted(os.sched_getaffinity(0))[:1])
    rows = []
    done, cpu_s = 0, 0.0
    for frames in counts:
        recording = write(folder / "long.mcap", views, frames)
        if not done:
            few = [spend(recording, folder, cores, "--end", str(FEW_S)) for _ in range(REPEATS)]
            done, cpu_s = few[0].run["counts"]["frames"], min(spent.cpu_s for spent in few)
        # Start-up dominates short recordings and varies from run to run.
        runs = [spend(recording, folder, cores) for _ in range(REPEATS if frames < MANY else 1)]
        least = min(spent.cpu_s for spent in runs)
        each, peak = 1e3 * (least - cpu_s) / (frames - done), round(runs[0].peak_mb)
        done, cpu_s = frames, least
        rows.append((frames, f"{each:.1f}", peak))
        recording.unlink()
    columns = ("frames", "CPU ms per frame since the row before", "peak MB")
    return markdown("Growth", columns, rows)


@click.command()
@click.option("--full", is_flag=True, help="Include recordings of up to 10,000 frames.")
@click.option("--frames", default=1000, help="Frames of the recordings that measure the speed.")
@click.option("--repeats", default=2, help="Number of runs; the best one counts.")
@click.option(
    "--against",
    type=click.Path(exists=True, path_type=Path),
    help="Another checkout to compare with, with its .venv installed.",
)
def main(*, full: bool, frames: int, repeats: int, against: Path | None) -> None:
    """Measure whole recordings and print tables."""
    with tempfile.TemporaryDirectory() as folder:
        print(speed(Path(folder), frames, repeats, against and against.resolve()))
        print(growth(Path(folder), [100, 1000, 10_000] if full else [50, 200]))


if __name__ == "__main__":
    main()
