"""Grow the trees that reject background structure: ``python -m shapecat.models.structure``.

Simulated scenes of several kinds, seen by all sensors, give merged segments of objects, of
furniture and walls, and of noise. Grow the trees of `shapecat.models.parts` first, since they
decide how the segments are merged.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Literal, NamedTuple

import click
import numpy as np

from shapecat.arrays import F4, I4, U1, Bool, Records
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup import structure
from shapecat.detection.cleanup.context import CONTEXT_FEATURES, add_context, measure_borders
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES, measure_object_features
from shapecat.detection.cleanup.structure import (
    FILES,
    RejectionTrees,
    as_rows,
    is_uncertain,
    logits_of,
)
from shapecat.detection.depth_grid import downsample
from shapecat.detection.merging.segments import roots_of
from shapecat.detection.pipeline import Task, merge_segments, model_planes, oversegment
from shapecat.models.growing import Growth, collect_chunks, grow, growing_options
from shapecat.models.parts import count_labels
from shapecat.models.viewpoints import move_to_floor, random_viewpoint
from shapecat.simulation import make_scene, render_frame
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.camera.sensors import resized
from shapecat.simulation.scenes.equipment import make_own_arms, make_resting_arms
from shapecat.simulation.scenes.furniture import as_equipment, make_rack, make_tote
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.simulation.scenes.worlds import Support, World
from shapecat.trees import BoostedTrees, write_trees
from shapecat.types import Camera, Frame, Pose

__all__ = ["Samples", "Series", "collect", "grow_rejection_trees", "label_objects", "main"]

_GROWTH = Growth(500, 64, 0.06)
_FOLDS = 3
"""Number of folds; the segments of each get logits from trees that are trained on the others."""
_OBJECT = 0.5
"""A merged segment is an object if more than this fraction of its labelled cells shows objects."""


class Series(NamedTuple):
    """Scenes of one kind.

    Attributes
    ----------
    first, scenes : the first seed and the number of scenes.
    sensors : names of the sensors, used in turn.
    scale : factor of all sizes and distances.
    view : where the camera is: on the ``path`` of the scene, or ``anywhere`` around it (near or
        far, low or straight above); ``floor`` is anywhere, with the table removed.
    changed : function that turns a bin into a tote, or a shelf into a rack.
    arms : arms in view, of the robot that carries the camera or of a person: ``reaching`` for the
        objects, or ``resting`` on the support at the image border.
    coarse : whether images have only a half to a quarter of the sensor's resolution.
    """

    kind: SceneKind
    first: int
    scenes: int
    sensors: tuple[str, ...] = tuple(PRESETS)
    scale: float = 1.0
    view: Literal["path", "anywhere", "floor"] = "path"
    changed: Callable[[np.random.Generator, Sequence[Support]], list[Support]] | None = None
    arms: Literal["none", "reaching", "resting"] = "none"
    coarse: bool = False


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
    Series("room", 651_000, 240),
    Series("room", 652_000, 600, view="anywhere"),
    Series("bin", 653_000, 180, changed=make_tote),
    Series("bin", 653_500, 240, view="anywhere", changed=make_tote),
    Series("clutter", 654_000, 240, view="anywhere", arms="reaching"),
    Series("pile", 655_000, 240, view="anywhere", arms="reaching"),
    Series("tabletop", 656_000, 240, view="anywhere", arms="reaching"),
    Series("room", 657_000, 240, view="floor", arms="reaching"),
    Series("bin", 658_000, 120, view="anywhere", changed=make_tote, arms="reaching"),
    Series("clutter", 659_000, 150, view="anywhere", arms="resting"),
    Series("pile", 659_500, 150, view="anywhere", arms="resting"),
    Series("tabletop", 660_000, 180, view="anywhere", arms="resting"),
    Series("room", 660_500, 120, view="anywhere", arms="resting"),
    Series("clutter", 661_000, 120, coarse=True),
    Series("clutter", 661_500, 120, view="anywhere", coarse=True),
    Series("pile", 662_000, 120, view="anywhere", coarse=True),
    Series("tabletop", 662_500, 120, view="anywhere", coarse=True),
    Series("shelf", 663_000, 180, coarse=True),
    Series("room", 663_500, 120, view="anywhere", coarse=True),
    Series("bin", 664_000, 90, coarse=True),
    Series("shelf", 664_500, 180, changed=make_rack),
    Series("shelf", 665_000, 120, scale=1.8, changed=make_rack),
    Series("clutter", 665_500, 90, scale=1.8, view="anywhere"),
    Series("tabletop", 666_000, 90, scale=1.8, view="anywhere"),
)
"""The merging trees were not trained on these seeds. Scaled scenes add large objects, which are
otherwise too rare; rooms add arms and furniture; floors add objects where furniture usually is."""
_VIEWS = {"path": 2, "anywhere": 6, "floor": 6}
"""Number of views of each scene, by different sensors; on the path, all from its first pose."""


class Samples(NamedTuple):
    """The n merged segments of several frames.

    Attributes
    ----------
    features : (n,) records of `OBJECT_FEATURES`.
    objects : (n,) whether each segment shows an object.
    borders : for each frame, the border lengths (4, r, r) of its r segments, from
        `measure_borders`.
    """

    features: Records
    objects: Bool
    borders: tuple[F4, ...]


@click.command()
@growing_options(Path(structure.__file__).parent)
def main(*, seed: int, jobs: int, out: Path) -> None:
    """Train the trees that reject background, on simulated scenes."""
    samples = collect(_SERIES, jobs)
    for (name, features), grown in zip(
        FILES.items(), grow_rejection_trees(samples, seed), strict=True
    ):
        write_trees(out / name, grown, features)
    objects = np.concatenate([part.objects for part in samples])
    click.echo(f"{len(objects)} segments, {objects.mean():.0%} of objects; {out}")


def collect(scenes: tuple[Series, ...], jobs: int) -> list[Samples]:
    """Return the merged segments of all scenes; the number of jobs does not affect the result.

    Each `Samples` holds whole scenes, so that no scene is in two folds.
    """
    return collect_chunks(_collect, scenes, jobs)


def grow_rejection_trees(samples: Sequence[Samples], seed: int) -> RejectionTrees:
    """Grow the trees that classify segments alone, and those that classify them in context.

    The trees in context learn only from segments about which the first trees are uncertain. The
    logits of these segments come from trees that were trained on other parts of the samples.
    """
    rows = [as_rows(part.features) for part in samples]
    objects = [part.objects for part in samples]
    context: dict[int, tuple[F4, Bool]] = {}
    for fold in range(_FOLDS):
        training = [k for k in range(len(samples)) if k % _FOLDS != fold]
        grown = _grow([rows[k] for k in training], [objects[k] for k in training], seed)
        for k in range(fold, len(samples), _FOLDS):
            logits = logits_of(rows[k], grown)
            unsure = is_uncertain(logits)
            context[k] = _in_context(samples[k], logits)[unsure], objects[k][unsure]
    contexts = [context[k] for k in range(len(samples))]
    in_context = _grow(
        [features for features, _ in contexts], [is_object for _, is_object in contexts], seed
    )
    return RejectionTrees(_grow(rows, objects, seed), in_context)


def _grow(rows: Sequence[F4], objects: Sequence[Bool], seed: int) -> BoostedTrees:
    """Grow trees from parts of the samples: features (n, f), and whether each is an object (n,)."""
    return grow(np.concatenate(rows), np.concatenate(objects), _GROWTH, seed)


def _in_context(samples: Samples, logits: F4) -> F4:
    """Return the context features (n, f) of segments.

    ``logits`` (n,) are those of the trees that classify each segment alone.
    """
    stops = np.cumsum([0, *(borders.shape[1] for borders in samples.borders)])
    frames = [
        add_context(samples.features[a:b], logits[a:b], borders)
        for a, b, borders in zip(stops[:-1], stops[1:], samples.borders, strict=True)
    ]
    return as_rows(np.concatenate([np.zeros(0, CONTEXT_FEATURES), *frames]))


def _collect(series: Series) -> Samples:
    seeds = range(series.first, series.first + series.scenes)
    frames = list(chain.from_iterable(_views(series, seed) for seed in seeds))
    return Samples(
        np.concatenate([np.zeros(0, OBJECT_FEATURES), *(frame.features for frame in frames)]),
        np.concatenate([np.zeros(0, np.bool_), *(frame.objects for frame in frames)]),
        tuple(chain.from_iterable(frame.borders for frame in frames)),
    )


def _views(series: Series, seed: int) -> Iterator[Samples]:
    """Yield the segments of each view of one scene.

    A scene has several views, since making it takes ten times as long as a view.
    """
    rng = np.random.default_rng(seed)
    world = make_scene(series.kind, rng, frames=1)
    world = move_to_floor(world) if series.view == "floor" else world
    if series.changed is not None:
        world = replace(world, supports=tuple(series.changed(rng, world.supports)))
    object_labels = np.array([item.label for item in world.objects], np.int64)
    for k in range(_VIEWS[series.view]):
        sensor = PRESETS[series.sensors[(seed + k) % len(series.sensors)]]
        view = 0 if series.view == "path" else random_viewpoint(world, sensor, rng)
        sensor = resized(sensor, 1 / rng.integers(2, 5)) if series.coarse else sensor
        with_arms = _with_arms(world, view, sensor.camera, series.arms, rng)
        frame, pixel_labels = render_frame(with_arms, view, rng=rng, sensor=sensor)
        depth = None if frame.depth is None else frame.depth * np.float32(series.scale)
        yield from label_objects(replace(frame, depth=depth), pixel_labels, object_labels)


def _with_arms(
    world: World, view: Pose | int, intrinsics: Camera, arms: str, rng: np.random.Generator
) -> World:
    """Add arms to a world: those of the robot that carries the camera, or of a person.

    ``arms`` is as in `Series`; ``none`` changes nothing. ``view`` is as for `render_frame`;
    ``intrinsics`` are those of the camera.
    """
    if arms == "none":
        return world
    pose = view if isinstance(view, Pose) else world.path[view]
    height = max(support.height for support in world.supports if support.holds_objects)
    if arms == "reaching":
        meshes = make_own_arms(rng, pose, height)
    else:
        meshes = make_resting_arms(rng, pose, intrinsics, height)
    return replace(world, supports=(*world.supports, *as_equipment("arm", meshes)))


def label_objects(frame: Frame, pixel_labels: U1, object_labels: I4) -> Iterator[Samples]:
    """Yield the merged segments of a frame; nothing without depth in range or a supporting plane.

    Parameters
    ----------
    pixel_labels : (h, w) pixel labels of the scene, 0 where unknown.
    object_labels : (k,) pixel labels of objects.
    """
    settings = DetectionSettings()
    if frame.depth is None or frame.camera is None:
        return
    grid = downsample(frame.depth, frame.camera, range_m=settings.max_range_m)
    task = Task(settings, np.random.default_rng(0))
    model = None if grid is None else model_planes(grid, None, task)
    if grid is None or model is None:
        return
    oversegmentation = oversegment(grid, model)
    merge_segments(grid, model, oversegmentation)
    features = measure_object_features(grid, model, oversegmentation, settings.max_range_m)
    _, labels, segments = oversegmentation
    counts = count_labels(pixel_labels, labels, grid)
    merged = np.zeros_like(counts)
    np.add.at(merged, segments.parent, counts)
    known_cells = merged[:, 1:].sum(axis=1)
    shares = merged[:, object_labels[object_labels < merged.shape[1]]].sum(axis=1) / np.maximum(
        known_cells, 1
    )
    roots = roots_of(segments)
    borders = measure_borders(segments, roots)
    yield Samples(features[roots], shares[roots] > _OBJECT, (borders,))


if __name__ == "__main__":
    main()
