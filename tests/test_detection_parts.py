"""Tests of the boosted trees of detection: their files, their features, and their training."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.ablation import without
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.detection.cleanup import structure
from shapecat.detection.cleanup.context import CONTEXT_FEATURES
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES
from shapecat.detection.depth_grid import downsample
from shapecat.detection.merging import learned
from shapecat.detection.merging.pair_features import (
    PAIR_FEATURES,
    ViewGeometry,
    find_adjacent,
    pair_features,
)
from shapecat.detection.pipeline import Task, model_planes, oversegment
from shapecat.models.growing import Growth, grow
from shapecat.models.parts import FEATURES, Series, collect
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.trees import BoostedTrees, logit_of, read_trees, write_trees
from tests.test_detection import overlaps

SCENES = (Series("clutter", 2000, 1), Series("pile", 85_000, 1))
GROWTH = Growth(40, 16, 0.3)


@pytest.mark.parametrize(
    ("grown", "features"),
    [
        (learned.load_trees(), FEATURES),
        (structure.load_trees().alone, OBJECT_FEATURES.itemsize // 4),
        (structure.load_trees().in_context, CONTEXT_FEATURES.itemsize // 4),
    ],
    ids=["merging", "alone", "in context"],
)
def test_every_path_through_the_trees_ends(grown: BoostedTrees, features: int) -> None:
    """A child stored before its parent could make an endless loop."""
    roots, feature, _, left = grown.trees
    inner = np.flatnonzero(left)
    assert np.all(left[inner] > inner)
    assert left.max() + 1 < left.size == grown.value.size
    assert np.all(left[roots[1:] - 1] == 0)
    assert 0 <= feature.min() <= feature.max() < features
    assert np.isfinite(grown.value).all()


def test_trees_grown_with_other_features_are_refused(tmp_path: Path) -> None:
    """A new field shifts the index of every later feature."""
    inner = np.dtype([("width_m", "f4"), ("height_m", "f4")])
    features = np.dtype([("first", inner), ("second", inner), ("border_m", "f4")])
    grown = learned.load_trees()
    write_trees(tmp_path / "grown.npz", grown, features)
    content = (tmp_path / "grown.npz").read_bytes()

    assert (read_trees(content, features).value == grown.value).all()
    for changed in ([("second", inner), ("first", inner), ("border_m", "f4")], features.descr[:2]):
        with pytest.raises(ValueError, match="grown with other features"):
            read_trees(content, np.dtype(changed))


def test_pair_features_do_not_depend_on_the_order_of_the_pair() -> None:
    rng = np.random.default_rng(3)
    frame, _ = render_frame(make_scene("clutter", rng, frames=1), 0, rng=rng, sensor=KINECT)
    assert frame.depth is not None
    assert frame.camera is not None
    grid = downsample(frame.depth, frame.camera, range_m=2.0)
    assert grid is not None
    model = model_planes(grid, None, Task(DetectionSettings(), rng))
    assert model is not None
    segments = oversegment(grid, model).segments
    view_geometry = ViewGeometry(grid.intrinsics.fx, model.up)
    there, back = np.zeros((2, 1), PAIR_FEATURES)
    seen = 0
    for p in range(1, segments.parent.size):
        for q in range(1, p):
            assert (
                find_adjacent(segments, p, view_geometry)[q]
                == find_adjacent(segments, q, view_geometry)[p]
            )
            if find_adjacent(segments, p, view_geometry)[q]:
                pair_features(segments, p, q, view_geometry, there[0])
                pair_features(segments, q, p, view_geometry, back[0])
                assert np.array_equal(there, back)
                assert np.isfinite(there.view(np.float32)).all()
                seen += 1
    assert seen > 10


@pytest.mark.parametrize("seed", [1600, 1601])
def test_objects_are_oversegmented_without_learned_merging(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = make_scene("clutter", rng, frames=1)
    frame, seen = render_frame(world, 0, rng=rng, sensor=KINECT)
    labels = [item.label for item in world.objects if np.count_nonzero(seen == item.label) > 400]
    found = []
    for left_out in (["learned merging", "across occlusion"], ["across occlusion"]):
        rng = np.random.default_rng(0)
        with without(*left_out):
            scene = detect(frame, settings=DetectionSettings(), rng=rng)
        found.append(np.mean(np.array(overlaps(scene, seen, labels)) > 0.75))
    assert found[1] > found[0]


@pytest.mark.many
def test_training_pairs_do_not_depend_on_the_number_of_processes() -> None:
    one, two = (collect(SCENES, jobs) for jobs in (1, 2))
    assert np.array_equal(one.features, two.features)
    assert np.array_equal(one.same, two.same)
    assert 0.05 < one.same.mean() < 0.95


def test_grown_trees_fit_their_training_data_and_are_reproducible() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(1000, FEATURES)).astype(np.float32)
    same = (features[:, 4] > 0) ^ (features[:, 40] > 0.3)
    first, second = (grow(features, same, GROWTH, seed=1) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first.trees, second.trees, strict=True))
    assert np.array_equal(first.value, second.value)
    predicted = np.array([logit_of(first, row, -np.inf, np.inf) > 0 for row in features])
    assert np.mean(predicted == same) > 0.95
