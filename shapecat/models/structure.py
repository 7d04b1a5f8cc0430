"""Grow the trees that reject background structure: ``python -m shapecat.models.structure``.

Simulated scenes of several kinds, seen by all sensors, give merged segments of objects, of
furniture and walls, and of noise. Grow the trees of `shapecat.models.parts` first, as they merge
the segments.
"""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Literal, NamedTuple

import click
import numpy as np

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup import structure
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES, measure_object_features
from shapecat.detection.depth_grid import downsample
from shapecat.detection.pipeline import ALL_STEPS, Task, merge_segments, oversegment
from shapecat.models.growing import Growth, grow, growing_options
from shapecat.models.parts import count_labels
from shapecat.simulation import make_scene, render_frame
from shapecat.simulation.paths import Filming, walk
from shapecat.simulation.scenes import SceneKind
from shapecat.simulation.sensors import PRESETS, Sensor
from shapecat.simulation.worlds import World
from shapecat.trees import write_trees
from shapecat.types import Frame, Pose

__all__ = ["Samples", "Series", "collect", "label_objects", "main"]

FEATURES = OBJECT_FEATURES.itemsize // np.dtype("f4").itemsize
_GROWTH = Growth(300, 32, 0.06)
_OBJECT = 0.5
"""A merged segment is an object if more than this fraction of its labelled cells shows objects."""
_CHUNK = 10


class Series(NamedTuple):
    """Scenes of one kind: the first seed and their number; the sensors take turns.

    ``scale`` multiplies all sizes and distances. The camera is on the ``path`` of the scene, or
    ``anywhere``: near or far, low or straight above. On the ``floor`` the table is taken away.
    """

    kind: SceneKind
    first: int
    scenes: int
    sensors: tuple[str, ...] = tuple(PRESETS)
    scale: float = 1.0
    view: Literal["path", "anywhere", "floor"] = "path"


_TWO = ("kinect", "realsense")
_SERIES = (
    Series("bin", 600_000, 240),
    Series("bin", 610_000, 360),
    Series("clutter", 602_000, 120, _TWO),
    Series("clutter", 606_000, 90),
    Series("empty", 604_000, 90, _TWO),
    Series("empty", 608_000, 90),
    Series("pile", 605_000, 90),
    Series("shelf", 603_000, 120, _TWO),
    Series("shelf", 607_000, 90),
    Series("shelf_bin", 601_000, 240),
    Series("tabletop", 609_000, 60),
    Series("clutter", 602_000, 120, _TWO, scale=1.8),
    Series("clutter", 606_000, 60, scale=1.8),
    Series("pile", 605_000, 60, scale=1.8),
    Series("tabletop", 609_000, 60, scale=1.8),
    Series("room", 612_000, 390),
    Series("room", 640_000, 330, view="anywhere"),
    Series("pile", 641_000, 120, view="anywhere"),
    Series("clutter", 642_000, 120, view="anywhere"),
    Series("tabletop", 643_000, 120, view="anywhere"),
    Series("room", 650_000, 180, view="floor"),
    Series("room", 650_500, 120, scale=1.8, view="floor"),
)
"""The merging trees were not grown on these seeds. The scaled scenes add large objects, which are
too rare otherwise; rooms add arms and furniture, floors objects where furniture usually is."""
_DISTANCE_M, _ELEVATION_DEG, _SWEEP_DEG = (0.35, 1.9), (12.0, 84.0), (20.0, 150.0)
"""Ranges of the position of a camera ``anywhere``, relative to its target."""
_CLOSER_M = 0.08
"""Least distance of the target beyond the sensor's near limit."""


class Samples(NamedTuple):
    """Merged segments: ``features`` (n, `FEATURES`); ``objects`` (n,), which are objects."""

    features: F4
    objects: Bool


@click.command()
@growing_options(Path(structure.__file__).with_name(structure.FILE))
def main(*, seed: int, jobs: int, out: Path) -> None:
    """Simulate scenes, detect merged segments, and grow and write the trees."""
    samples = collect(_SERIES, jobs)
    write_trees(out, grow(*samples, _GROWTH, seed), OBJECT_FEATURES)
    click.echo(f"{len(samples.objects)} segments, {samples.objects.mean():.0%} of objects; {out}")


def collect(scenes: tuple[Series, ...], jobs: int) -> Samples:
    """Return the merged segments of all scenes; the number of jobs does not affect the result."""
    chunks = [
        s._replace(first=s.first + k, scenes=min(_CHUNK, s.scenes - k))
        for s in scenes
        for k in range(0, s.scenes, _CHUNK)
    ]
    with (
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool,
        click.progressbar(pool.map(_collect, chunks), length=len(chunks), label="scenes") as bar,
    ):
        return Samples(*(np.concatenate(part) for part in zip(*bar, strict=True)))


def _collect(series: Series) -> Samples:
    frames = (_labelled(series, seed) for seed in range(series.first, series.first + series.scenes))
    found = list(chain.from_iterable(frames))
    rows = np.array([features for features, _ in found], np.float32).reshape(-1, FEATURES)
    return Samples(rows, np.array([is_object for _, is_object in found], bool))


def _labelled(series: Series, seed: int) -> Iterator[tuple[F4, bool]]:
    rng = np.random.default_rng(seed)
    world = make_scene(series.kind, rng, frames=1)
    sensor = PRESETS[series.sensors[seed % len(series.sensors)]]
    world = _on_floor(world) if series.view == "floor" else world
    view = 0 if series.view == "path" else _viewpoint(world, sensor, rng)
    frame, owners = render_frame(world, view, rng=rng, sensor=sensor)
    depth = None if frame.depth is None else frame.depth * np.float32(series.scale)
    things = np.array([thing.label for thing in world.things], np.int64)
    yield from label_objects(replace(frame, depth=depth), owners, things)


def _on_floor(world: World) -> World:
    """Remove the table and everything on it except the objects, and put these on the floor."""
    table = next(support for support in world.supports if support.name == "table")
    down = np.array([0.0, 0.0, -table.height])
    things = (
        replace(thing, pose=Pose(thing.pose.rotation, thing.pose.translation + down))
        for thing in world.things
    )
    rest = (s for s in world.supports if s is not table and not s.name.startswith("robot"))
    return replace(world, supports=tuple(rest), things=tuple(things))


def _viewpoint(world: World, sensor: Sensor, rng: np.random.Generator) -> Pose | int:
    """Return a random ``world_from_camera`` facing the objects; the path's if there are none."""
    places = [thing.pose.translation for thing in world.things]
    if not places:
        return 0
    target = (np.mean(places, axis=0) + places[rng.integers(len(places))]) / 2
    nearest = max(_DISTANCE_M[0], sensor.nearest_m + _CLOSER_M)
    distance = float(np.exp(rng.uniform(np.log(nearest), np.log(_DISTANCE_M[1]))))
    (pose,) = walk(
        rng,
        np.asarray(target),
        Filming(1, 30.0),
        distance=distance,
        elevation=_ELEVATION_DEG,
        sweep=_SWEEP_DEG,
    )
    return pose


def label_objects(frame: Frame, owners: U1, things: I4) -> Iterator[tuple[F4, bool]]:
    """Yield the features (1, `FEATURES`) of each merged segment, and whether it is an object.

    Parameters
    ----------
    owners : (h, w) pixel labels of the scene, 0 where unknown.
    things : (k,) labels of objects, in ascending order.
    """
    settings = DetectionSettings()
    if frame.depth is None or frame.camera is None:
        return
    grid = downsample(frame.depth, frame.camera, range_m=settings.max_range_m)
    task = Task(settings, np.random.default_rng(0))
    found = None if grid is None else oversegment(grid, task)
    if grid is None or found is None:
        return
    model, oversegmentation = found
    known = merge_segments(grid, model, oversegmentation, ALL_STEPS)
    features = measure_object_features(grid, model, oversegmentation, known, settings.max_range_m)
    _, labels, segments = oversegmentation
    counts = count_labels(owners.reshape(frame.depth.shape), labels, grid)
    merged = np.zeros_like(counts)
    np.add.at(merged, segments.parent, counts)
    known_cells = merged[:, 1:].sum(axis=1)
    shares = merged[:, things[things < merged.shape[1]]].sum(axis=1) / np.maximum(known_cells, 1)
    for p in np.unique(segments.parent[1:]):
        yield features[p : p + 1].view(np.float32), bool(shares[p] > _OBJECT)


if __name__ == "__main__":
    main()
