"""Computing time of the stages for one object."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from benchmarks.measure import cpu_ms, markdown, summary
from benchmarks.scenes import labelled_clutter
from shapecat.arrays import F4, F8
from shapecat.config import Settings
from shapecat.description import describe
from shapecat.detection import detect
from shapecat.learning import Categorizer, load_model
from shapecat.perception import level_points
from shapecat.surface import reconstruct, voxelize


def run(count: int) -> str:
    """Time each stage for up to four objects in each of ``count`` frames; return a table."""
    settings, model = Settings(), load_model(None)
    timed: dict[str, list[float]] = {}
    objects: list[tuple[F4, F8]] = []
    for frame, *_ in labelled_clutter(count):
        scene = detect(frame, settings=settings.detection, rng=np.random.default_rng(0))
        for candidate in scene.candidates[:4]:
            points, level = level_points(frame, scene, candidate)
            upright, eye = points.astype(np.float32), level.translation
            cloud = voxelize(upright, voxel_m=settings.surface.voxel_m)
            gas = reconstruct(cloud, settings=settings.surface, rng=np.random.default_rng(0))
            if gas is None:
                continue
            row = describe(cloud, gas, eye=eye)[None]
            grow = partial(reconstruct, cloud, settings=settings.surface)
            works: dict[str, Callable[[], Any]] = {
                "voxelize": partial(voxelize, upright, voxel_m=settings.surface.voxel_m),
                "neural gas": partial(_seeded, grow),
                "describe": partial(describe, cloud, gas, eye=eye),
                "categorize": partial(model.predict, row),
                "points to posterior": partial(_categorize, upright, eye, settings, model),
            }
            for stage, work in works.items():
                timed.setdefault(stage, []).append(cpu_ms(work))
            objects.append((upright, eye))
    rows = [(stage, *summary(values).values()) for stage, values in timed.items()]
    gain = _speedup(objects, settings, model)
    columns = ("stage", "ms, median", "ms, p95", "ms, max")
    table = markdown("One object, CPU time", columns, rows)
    return f"{table}\nTwo threads do {len(objects)} objects {gain} times as fast as one.\n"


def _seeded(grow: Callable[..., Any]) -> Any:
    """Grow the same graph at each call."""
    return grow(rng=np.random.default_rng(0))


def _categorize(points: F4, eye: F8, settings: Settings, model: Categorizer) -> None:
    """Run all stages for one object, from its points to its posterior."""
    cloud = voxelize(points, voxel_m=settings.surface.voxel_m)
    gas = reconstruct(cloud, settings=settings.surface, rng=np.random.default_rng(0))
    if gas is not None:
        model.predict(describe(cloud, gas, eye=eye)[None])


def _speedup(objects: list[tuple[F4, F8]], settings: Settings, model: Categorizer) -> float:
    """Return the speed-up of two threads over one for all objects, from the best wall times.

    ``objects`` are the points (n, 3) and the eye (3,) of each.
    """
    work = partial(_categorize, settings=settings, model=model)
    points, eyes = zip(*objects * 4, strict=True)
    seconds = {}
    for threads in (1, 2):
        with ThreadPoolExecutor(threads) as pool:
            runs = []
            for _ in range(7):
                begun = time.perf_counter()
                list(pool.map(work, points, eyes))
                runs.append(time.perf_counter() - begun)
        seconds[threads] = min(runs)
    return round(seconds[1] / seconds[2], 2)
