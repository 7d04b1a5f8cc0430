"""Grow the trees that decide which segments to merge: ``python -m shapecat.models.parts``.

Simulated scenes, seen by all sensors, give pairs of segments. The segments of each object are
merged in random order. The trees learn from all pairs that occur during merging, and thus also from
partially merged segments.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, cycle
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.config import DetectionSettings
from shapecat.detection.depth_grid import DepthGrid, downsample
from shapecat.detection.merging import learned
from shapecat.detection.merging.across_occlusion import merge_across_occluder
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    find_adjacent,
    pair_features,
)
from shapecat.detection.merging.segments import Segments, merge
from shapecat.detection.pipeline import Task, model_planes, oversegment
from shapecat.detection.segmentation.watershed import SeedSplitter
from shapecat.models.growing import Growth, collect_chunks, grow, growing_options
from shapecat.models.necks import split_necks
from shapecat.models.viewpoints import random_viewpoint
from shapecat.simulation import KINECT, REALSENSE, make_scene, render_frame
from shapecat.simulation.camera.presets import IDEAL, PRESETS
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.trees import write_trees
from shapecat.types import CATEGORIES

__all__ = ["FEATURES", "collect", "count_labels", "main"]

FEATURES = PAIR_FEATURES.itemsize // np.dtype("f4").itemsize
"""The number of features of a pair."""
_PURE = 0.6
"""A segment belongs to an object that owns more than this fraction of its cells."""
_NOISY = replace(IDEAL, noise=0.0015, step=0.0029)
_BLENDED = replace(IDEAL, noise=0.0015, blend_px=3)
_GROWTH = Growth(300, 256, 0.1)
_SETTINGS = DetectionSettings()


class Series(NamedTuple):
    """Scenes of one kind.

    Attributes
    ----------
    first, scenes : the first seed and the number of scenes.
    categories : categories of the objects.
    split : whether the seeds of the watershed are split at necks.
    """

    kind: SceneKind
    first: int
    scenes: int
    categories: tuple[str, ...] = CATEGORIES
    split: bool = False


_SERIES = (
    Series("rows", 60_000, 200, split=True),
    Series("room", 98_500, 62, split=True),
    Series("clutter", 2000, 2400),
    Series("clutter", 50_000, 300, ("box",)),
    Series("clutter", 70_000, 100, ("box", "can", "plate")),
    Series("shelf", 2000, 700),
    Series("turntable", 2000, 80),
    Series("tabletop", 99_000, 200),
    Series("pile", 80_000, 1000),
    Series("bin", 90_000, 350),
    Series("shelf_bin", 94_000, 300),
)
"""Random seeds below 2000 are for development, those from 100000 on for evaluation or for the
rejection trees. In piles and bins, objects lean, lie across each other and touch walls; in rows,
similar objects nearly touch. With ``split``, there are more pairs of similar objects; but when all
scenes were split, the trees merged stacked cans."""
_VIEWS = 4
"""Number of views of each scene, alternately from its path and from anywhere; sensors vary."""
_OTHERS = (
    *(sensor for sensor in PRESETS.values() if sensor not in (KINECT, REALSENSE)),
    IDEAL,
    _NOISY,
    _BLENDED,
)
_SENSORS = tuple(chain.from_iterable(zip(cycle((KINECT, REALSENSE)), _OTHERS, strict=False)))


class Pairs(NamedTuple):
    """Pairs of segments.

    ``features`` (n, `FEATURES`); ``same`` (n,), whether both segments show the same object.
    """

    features: F4
    same: Bool


@click.command()
@growing_options(Path(learned.__file__).with_name(learned.FILE))
def main(*, seed: int, jobs: int, out: Path) -> None:
    """Train the trees that decide which segments to merge, on simulated scenes."""
    pairs = collect(_SERIES, jobs)
    write_trees(out, grow(*pairs, _GROWTH, seed), PAIR_FEATURES)
    click.echo(f"{len(pairs.same)} pairs, {pairs.same.mean():.0%} of one object; {out}")


def collect(scenes: Sequence[Series], jobs: int) -> Pairs:
    """Return the pairs of segments of all scenes; the number of jobs does not affect the result."""
    both = collect_chunks(_collect, scenes, jobs)
    return Pairs(np.concatenate([p.features for p in both]), np.concatenate([p.same for p in both]))


def _collect(series: Series) -> Pairs:
    pairs: list[tuple[F4, bool]] = []
    for seed in range(series.first, series.first + series.scenes):
        rng = np.random.default_rng(seed)
        world = make_scene(series.kind, rng, frames=1, categories=series.categories)
        object_labels = np.array([item.label for item in world.objects])
        for k in range(_VIEWS):
            sensor = _SENSORS[(seed + k) % len(_SENSORS)]
            view = random_viewpoint(world, sensor, rng) if k % 2 else 0
            frame, pixel_labels = render_frame(world, view, rng=rng, sensor=sensor)
            if frame.depth is not None and frame.camera is not None:
                grid = downsample(frame.depth, frame.camera, range_m=_SETTINGS.max_range_m)
                if grid is not None:
                    split_seeds = split_necks if series.split else None
                    pairs += _pairs(grid, split_seeds, pixel_labels, object_labels, rng)
    features = np.array([features for features, _ in pairs], np.float32).reshape(-1, FEATURES)
    return Pairs(features, np.array([same for _, same in pairs], bool))


def _pairs(
    grid: DepthGrid,
    split_seeds: SeedSplitter | None,
    pixel_labels: U1,
    object_labels: I4,
    rng: np.random.Generator,
) -> Iterator[tuple[F4, bool]]:
    """Yield features of pairs of segments, single or merged, and whether both show the same object.

    Parameters
    ----------
    split_seeds : as for `oversegment`.
    pixel_labels : (h, w) pixel labels of the scene.
    object_labels : (k,) pixel labels of objects.
    """
    model = model_planes(grid, None, Task(_SETTINGS, rng))
    if model is None:
        return
    graph, labels, segments = oversegment(grid, model, split_seeds=split_seeds)
    # The trees need not decide on the pairs that this rule merges.
    merge_across_occluder(segments, grid, graph.normal, labels)
    counts = count_labels(pixel_labels, labels, grid)
    view_geometry, yielded = ViewGeometry(grid.intrinsics.fx, model.up), set()
    while True:
        rows, object_of = _segment_objects(segments, counts, object_labels)
        todo = []
        for p, q in _adjacent_pairs(segments, object_of, view_geometry):
            same = bool(object_of[p] == object_of[q] and object_of[p] > 0)
            if same:
                todo.append((p, q))
            if (p, q, rows[p], rows[q]) not in yielded:
                yielded.add((p, q, rows[p], rows[q]))
                named = np.zeros(1, PAIR_FEATURES)
                pair_features(segments, p, q, view_geometry, named[0])
                yield named.view(np.float32), same
        if not todo:
            return
        merge(segments, *todo[rng.integers(len(todo))])


def count_labels(pixel_labels: U1, labels: I4, grid: DepthGrid) -> I4:
    """Return how many cells of each segment have each pixel label.

    The result (n, l) is indexed by segment, then by pixel label.

    Parameters
    ----------
    pixel_labels : (h, w) pixel labels at full resolution.
    labels : (rows, columns) segment of each cell of the grid, 0 for none.
    """
    middle, (rows, columns) = grid.factor // 2, labels.shape
    sampled = pixel_labels[middle :: grid.factor, middle :: grid.factor][:rows, :columns]
    counts = np.zeros((labels.max() + 1, pixel_labels.max() + 1), np.int64)
    np.add.at(counts, (labels.ravel(), sampled.ravel()), 1)
    return counts


def _segment_objects(segments: Segments, counts: I4, object_labels: I4) -> tuple[I4, I4]:
    """Return, for each segment (n,), the number of cells merged into it, and the object it shows.

    An object is given by its label; 0 is background, and -1 a segment of which none owns more than
    `_PURE`. Segments that were merged into another have 0 cells and -1. ``counts`` are from
    `count_labels`; ``object_labels`` (k,) are the pixel labels of objects.
    """
    joined = np.zeros_like(counts)
    np.add.at(joined, segments.parent, counts)
    sizes = joined.sum(axis=1)
    best = joined.argmax(axis=1)
    pure = joined[np.arange(len(best)), best] > _PURE * sizes
    return sizes, np.where(pure, np.where(np.isin(best, object_labels), best, 0), -1)


def _adjacent_pairs(
    segments: Segments, object_of: I4, view_geometry: ViewGeometry
) -> Iterator[tuple[int, int]]:
    """Yield adjacent pairs of segments, of which at least one shows an object.

    Segments that mix several are left out. ``object_of`` (n,) is from `_segment_objects`.
    """
    n = segments.parent.size
    for p in range(1, n):
        adjacent = find_adjacent(segments, p, view_geometry)
        for q in range(p + 1, n):
            known = min(object_of[p], object_of[q]) >= 0 and max(object_of[p], object_of[q]) > 0
            if known and adjacent[q]:
                yield p, q


if __name__ == "__main__":
    main()
