"""Time and memory of the track phase over hours, on synthetic tables as perceive writes them.

    python -m benchmarks.hours --hours 1
    python -m benchmarks.hours --hours 10     a million frames, eight million detections

Eight objects stand on a table in front of a moving camera. Each is missed in some frames, and is
removed for a while every few minutes; false detections appear for a few frames.
"""

import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click
import numpy as np
import pyarrow as pa

from benchmarks.measure import markdown
from shapecat.completion import DIRECTIONS
from shapecat.config import TrackingSettings
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES
from shapecat.runs.tables.segments import group_frames
from shapecat.runs.tables.writing import arrow_table, open_writer
from shapecat.runs.tracks import track_run
from shapecat.types import CATEGORIES

PER_HOUR, OBJECTS, PLACES_OF_FALSE = 100_000, 8, 8
"""Frames per hour, number of objects, and number of places where false detections appear."""
PERIOD_NS = 36_000_000
NOISE_M = 0.004
"""Standard deviation of measured positions and outlines."""
OVERLOOKED, FALSE = 0.01, 0.002  # fractions: of missed detections; of frames with a new false one
FALSE_FRAMES, VISIT_FRAMES, AWAY_FRAMES = 5, 10_000, 500
"""Duration of a false detection; period in which an object is removed once, and for how long."""


def make_tables(folder: Path, frames: int) -> None:
    """Write the frames and detections of a run; columns that tracking does not read are null."""
    rng = np.random.default_rng(0)
    count = OBJECTS + PLACES_OF_FALSE
    places = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.full(count, 0.05)])
    beliefs = rng.dirichlet(np.full(len(CATEGORIES), 0.2), count)
    with ExitStack() as stack:
        writers = {
            schema: stack.enter_context(open_writer(folder / f"{name}.parquet", schema))
            for name, schema in (("frames", FRAMES), ("detections", DETECTIONS))
        }
        length = group_frames(frames)
        for first in range(0, frames, length):
            numbers = np.arange(first, min(first + length, frames))
            for schema, columns in (
                (FRAMES, _frames(numbers)),
                (DETECTIONS, _detections(numbers, places, beliefs, rng)),
            ):
                writers[schema].write_table(arrow_table(_filled(columns, schema), schema))


def _frames(numbers: Any) -> dict[str, Any]:
    n = len(numbers)
    return {
        "topic": ["/depth"] * n,
        "frame": numbers,
        "stamp_ns": numbers * PERIOD_NS,
        "fixed_translation": [[0.0, 0.0, 0.0]] * n,
        "fixed_rotation": [np.eye(3).ravel().tolist()] * n,
    }


def _detections(numbers: Any, places: Any, beliefs: Any, rng: Any) -> dict[str, Any]:
    rows, object_ids = _shown(numbers, rng)
    n = len(rows)
    first = np.searchsorted(rows, rows)
    where = places[object_ids] + rng.normal(0, NOISE_M, (n, 3))
    size, turn = list(np.full((n, 3), 0.1)), list(np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
    return {
        "topic": ["/depth"] * n,
        "frame": numbers[rows],
        "stamp_ns": numbers[rows] * PERIOD_NS,
        "detection": np.arange(n) - first,
        "touches_border": np.zeros(n, bool),
        "occluded": np.zeros(n, bool),
        "novelty": np.full(n, 0.5),
        "posterior": list(beliefs[object_ids]),
        **{name: list(where) for name in ("center", "center_fixed", "center_full")},
        **dict.fromkeys(("size", "size_full", "size_full_std"), size),
        **dict.fromkeys(("orientation", "orientation_full"), turn),
        "outline_full": list(rng.normal(0.05, NOISE_M, (n, DIRECTIONS))),
    }


def _shown(numbers: Any, rng: Any) -> tuple[Any, Any]:
    """Return, for each detection, an index into the frame ``numbers``, and its object.

    An object >= `OBJECTS` is a false detection.
    """
    shown = rng.random((len(numbers), OBJECTS + PLACES_OF_FALSE)) > OVERLOOKED
    turn = (numbers[:, None] + np.arange(OBJECTS) * VISIT_FRAMES // OBJECTS) % VISIT_FRAMES
    shown[:, :OBJECTS] &= turn >= AWAY_FRAMES
    begun = rng.random((len(numbers), PLACES_OF_FALSE)) < FALSE / PLACES_OF_FALSE
    before = np.cumsum(np.pad(begun, ((FALSE_FRAMES, 0), (0, 0))), axis=0)
    shown[:, OBJECTS:] = before[FALSE_FRAMES:] > before[:-FALSE_FRAMES]
    rows, object_ids = np.nonzero(shown)
    return rows, object_ids


def _filled(columns: dict[str, Any], schema: pa.Schema) -> dict[str, Any]:
    n = len(columns["frame"])
    return {f.name: columns.get(f.name, pa.nulls(n, f.type)) for f in schema}


def _track(folder: Path) -> tuple[float, float, int]:
    """Track in this process; return the seconds, the peak memory (MB) and the number of tracks."""
    begun = time.perf_counter()
    counts = track_run(folder, TrackingSettings(), CATEGORIES)
    seconds = time.perf_counter() - begun
    status = Path("/proc/self/status").read_text("utf-8")
    peak_kb = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
    return seconds, int(peak_kb) / 1024, sum(counts.values())


def measure(frames: int) -> tuple[float, float, int]:
    """Track a synthetic run in a process of its own; return the values of `_track`."""
    with tempfile.TemporaryDirectory() as name:
        make_tables(Path(name), frames)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(_track, Path(name)).result()


@click.command()
@click.option("--hours", default=1.0, show_default=True, help="Hours of recording, at 28 Hz.")
def main(*, hours: float) -> None:
    """Measure the track phase and print a table."""
    frames = round(hours * PER_HOUR)
    rows = [(f"{hours:g}", frames, *(round(value, 1) for value in measure(frames)))]
    columns = ("hours", "frames", "seconds", "peak MB", "tracks")
    click.echo(markdown("The track phase", columns, rows))


if __name__ == "__main__":
    main()
