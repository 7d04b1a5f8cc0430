"""Fraction of the objects found at each distance of the camera, with every simulated sensor.

    python -m benchmarks.distances --first 1168000 --count 60

Each scene (a table, clutter, a pile) is seen once at a random distance in each range, from a random
direction. The sensors alternate; those that cannot measure at this distance are left out.
"""

from collections.abc import Sequence
from itertools import cycle, islice
from typing import Any

import click
import numpy as np

from benchmarks.measure import markdown
from benchmarks.rooms import Counts, count
from benchmarks.scenes import detected
from shapecat.models.viewpoints import random_viewpoint
from shapecat.simulation import Sensor, World, make_scene, render_frame
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.scenes.kinds import SceneKind

KINDS: tuple[SceneKind, ...] = ("tabletop", "clutter", "pile")
RANGES_M = ((0.3, 0.45), (0.45, 0.7), (0.7, 1.1), (1.1, 1.7), (1.7, 2.6))
MARGIN_M = 0.05
"""Sensors that measure less than this at the far end of a range are left out of it."""
HEAD = ("distance, m", "frames", "objects", "found", "mean F", "surplus a frame")


def evaluate(world: World, sensor: Sensor, range_m: tuple[float, float], seed: int) -> Counts:
    """Detect objects from a random direction and distance, and count them."""
    rng = np.random.default_rng(seed)
    view = random_viewpoint(world, sensor, rng, distance_m=range_m)
    frame, labels = render_frame(world, view, rng=rng, sensor=sensor)
    return count([c.indices for c in detected(frame).candidates], labels.reshape(-1))


def row(worlds: Sequence[World], first: int, range_m: tuple[float, float]) -> tuple[Any, ...]:
    """Return the row of the table for a range of distances, metres; ``first`` is the first seed."""
    sensors = [s for s in PRESETS.values() if s.nearest_m < range_m[1] - MARGIN_M]
    total = Counts()
    for k, world in enumerate(worlds):
        sensor = sensors[k // len(KINDS) % len(sensors)]
        total += evaluate(world, sensor, range_m, first + k)
    share, mean = (value / max(total.objects, 1) for value in (total.found, total.f))
    low, high = range_m
    figures = (f"{share:.3f}", f"{mean:.3f}", f"{total.elsewhere / max(total.frames, 1):.2f}")
    return (f"{low} to {high}", total.frames, total.objects, *figures)


@click.command()
@click.option("--first", default=3000, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=60, show_default=True, help="Number of scenes.")
def main(first: int, count: int) -> None:
    """Count the objects found in each range of distances, and print a table."""
    kinds = islice(cycle(KINDS), count)
    worlds = [
        make_scene(kind, np.random.default_rng(first + k), frames=1) for k, kind in enumerate(kinds)
    ]
    rows = [row(worlds, first, range_m) for range_m in RANGES_M]
    click.echo(markdown("Objects found by distance", HEAD, rows))


if __name__ == "__main__":
    main()
