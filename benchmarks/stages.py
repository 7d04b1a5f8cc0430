"""The stages of one frame, and of one object."""

from typing import Any

import numpy as np

from benchmarks.measure import cpu_ms, markdown, summary
from benchmarks.scenes import simulated_clutter
from shapecat.config import Settings
from shapecat.description import describe
from shapecat.detection import detect
from shapecat.geometry import level_from_sensor, transform
from shapecat.learning import load_model
from shapecat.surface import reconstruct, voxelize


def run(count: int) -> tuple[str, dict[str, Any]]:
    """Time each stage for each object of ``count`` frames; return a table and the figures."""
    settings, model = Settings(), load_model(None)
    timed: dict[str, list[float]] = {}
    for frame in simulated_clutter(count):
        scene = detect(frame, settings=settings.detection, rng=np.random.default_rng(0))
        for candidate in scene.candidates[:4]:
            points = frame.xyz(candidate.indices)
            plane = scene.planes[candidate.plane or 0]
            level = level_from_sensor(scene.up, plane.offset, points)
            upright = transform(level, points).astype(np.float32)
            cloud = voxelize(upright, voxel_m=settings.surface.voxel_m)
            gas = reconstruct(cloud, settings=settings.surface, rng=np.random.default_rng(0))
            if gas is None:
                continue
            row = describe(cloud, gas, eye=level.translation)[None]
            for stage, work in {
                "voxelize": lambda p=upright: voxelize(p, voxel_m=settings.surface.voxel_m),
                "neural gas": lambda c=cloud: reconstruct(
                    c, settings=settings.surface, rng=np.random.default_rng(0)
                ),
                "describe": lambda c=cloud, g=gas, e=level.translation: describe(c, g, eye=e),
                "categorize": lambda r=row: model.predict(r),
            }.items():
                timed.setdefault(stage, []).append(cpu_ms(work))
    figures = {stage: summary(values) for stage, values in timed.items()}
    rows = [(stage, t["median"], t["p95"], t["max"]) for stage, t in figures.items()]
    columns = ("stage", "ms, median", "ms, p95", "ms, max")
    return markdown("One object, CPU time", columns, rows), figures
