"""Tests of tracking metrics against motmetrics, and of box overlaps against exact volumes."""

import tracemalloc
import warnings
from collections.abc import Iterator
from typing import Any

import motmetrics
import numpy as np
import pytest

from shapecat.evaluation.comparison.identities import FrameIdentities, compute_tracking_metrics
from shapecat.evaluation.comparison.overlap import box_iou, match_masks
from shapecat.geometry import quaternion_from_rotation, rotation_from_quaternion
from shapecat.types import Box


def crowd(seed: int, frames: int = 40) -> Iterator[FrameIdentities]:
    """Yield frames in which objects come and go, and tracks are lost, swapped and invented."""
    rng = np.random.default_rng(seed)
    names = {k: 100 + k for k in range(5)}
    for k in range(frames):
        if k % 9 == 8:
            a, b = rng.choice(5, 2, replace=False)
            names[a], names[b] = names[b], names[a]
        if k % 13 == 12:
            names[int(rng.integers(5))] = 200 + k
        true = [i for i in range(5) if rng.random() < 0.8]
        detected = [i for i in true if rng.random() < 0.85]
        found = [names[i] for i in detected] + ([900 + k] if rng.random() < 0.3 else [])
        similarity = rng.uniform(0, 0.65, (len(true), len(found)))
        for j, i in enumerate(detected):
            similarity[true.index(i), j] = rng.uniform(0.4, 1)
        yield FrameIdentities(true, found, np.where(similarity < 0.1, 0, similarity))


def oracle(frames: list[FrameIdentities], threshold: float) -> Any:
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for true, found, similarity in frames:
        gaps = np.where(similarity >= threshold, 1 - similarity, np.nan)
        accumulator.update(true, found, gaps)
    names = ["idf1", "mota", "num_switches", "num_misses", "num_false_positives"]
    with warnings.catch_warnings():  # deprecations in pandas
        warnings.simplefilter("ignore")
        table = motmetrics.metrics.create().compute(accumulator, metrics=names)
    return table.iloc[0]


@pytest.mark.parametrize(("seed", "threshold"), [*enumerate([0.5, 0.3] * 4)])
def test_mota_and_idf1_match_motmetrics(seed: int, threshold: float) -> None:
    """Another choice in a tie, or a dropped pair, would shift published figures."""
    frames = list(crowd(seed))
    expected, figures = (
        oracle(frames, threshold),
        compute_tracking_metrics(frames, threshold=threshold),
    )

    assert figures.switches == expected["num_switches"] > 0
    assert figures.misses == expected["num_misses"] > 0
    assert figures.false_positives == expected["num_false_positives"] > 0
    assert figures.mota == pytest.approx(expected["mota"])
    assert figures.idf1 == pytest.approx(expected["idf1"])


def test_hota_matches_a_worked_example() -> None:
    """One object is found in 3 of 4 frames, at .72: once as track 1, then twice as track 2.

    Up to .7 (14 thresholds) there are 3 hits, 1 miss, 0 false positives: DetA 3/4. The hit of
    track 1 associates 1/(4+1-1), those of track 2 2/(4+2-2): AssA (1/4 + 1/2 + 1/2)/3 = 5/12.
    Above .7, there are no hits. There are 19 thresholds.
    """
    none = np.zeros((1, 0))
    hit = np.array([[0.72]])
    frames = [
        FrameIdentities(["a"], [1], hit),
        FrameIdentities(["a"], [2], hit),
        FrameIdentities(["a"], [], none),
        FrameIdentities(["a"], [2], hit),
    ]
    figures = compute_tracking_metrics(frames)

    assert figures.hota == pytest.approx(14 / 19 * (3 / 4 * 5 / 12) ** 0.5)
    assert figures.detection_accuracy == pytest.approx(14 / 19 * 3 / 4)
    assert figures.association_accuracy == pytest.approx(14 / 19 * 5 / 12)
    assert figures.mota == pytest.approx(1 - (1 + 1) / 4)
    assert figures.idf1 == pytest.approx(2 * 2 / (4 + 3))


def test_metrics_of_empty_frames_are_nan() -> None:
    empty = compute_tracking_metrics([FrameIdentities([], [], np.zeros((0, 0)))])

    assert np.isnan([empty.mota, empty.idf1, empty.hota]).all()


def box(center: list[float], size: list[float], orientation: list[float]) -> Box:
    """Return a box from plain numbers."""
    return Box(*(np.array(values, np.float64) for values in (center, size, orientation)))


def rotated(x: float, y: float, z: float, w: float, original: Box) -> Box:
    """Rotate a box about the origin."""
    rotation = rotation_from_quaternion([x, y, z, w])
    own = rotation_from_quaternion(original.orientation)
    return Box(rotation @ original.center, original.size, quaternion_from_rotation(rotation @ own))


def test_iou_of_rotated_boxes_matches_hand_calculation_and_sampling() -> None:
    """A tilted camera sees rotated boxes, for which a formula for upright ones is wrong."""
    a = box([0.1, -0.2, 0.9], [0.3, 0.2, 0.5], [0, 0, 0, 1])
    b = box([0.2, -0.15, 1.0], [0.3, 0.2, 0.5], [0, 0, 0, 1])
    shared = 0.2 * 0.15 * 0.4
    by_hand = shared / (2 * 0.3 * 0.2 * 0.5 - shared)
    assert box_iou(a, b) == pytest.approx(by_hand, rel=1e-5)
    tilt = (0.3, -0.5, 0.2, 0.7)
    assert box_iou(rotated(*tilt, a), rotated(*tilt, b)) == pytest.approx(by_hand, rel=1e-4)

    c = box([0.15, -0.1, 0.95], [0.25, 0.35, 0.3], [0.1, 0.25, -0.4, 0.8])
    points = np.random.default_rng(0).uniform(-0.5, 1.5, (400_000, 3))
    inside = [
        (np.abs((points - b.center) @ rotation_from_quaternion(b.orientation))
         <= b.size / 2).all(axis=1)
        for b in (a, c)
    ]  # fmt: skip
    sampled = np.sum(inside[0] & inside[1]) / np.sum(inside[0] | inside[1])
    assert box_iou(a, c) == pytest.approx(float(sampled), abs=0.02)
    assert box_iou(a, c) == pytest.approx(box_iou(c, a))
    assert box_iou(a, a) == pytest.approx(1)


def test_touching_and_flat_boxes_have_no_overlap() -> None:
    a = box([0, 0, 0], [1, 2, 3], [0, 0, 0, 1])
    assert box_iou(a, box([1, 0, 0], [1, 2, 3], [0, 0, 0, 1])) == 0
    assert box_iou(a, box([9, 0, 0], [1, 2, 3], [0, 0, 0, 1])) == 0
    assert box_iou(a, box([0, 0, 0], [1, 2, 0], [0, 0, 0, 1])) == 0


def test_mask_matching_maximizes_total_overlap() -> None:
    """The first mask overlaps the first object most, but the best total needs other pairs."""
    true = [np.arange(0, 10), np.arange(10, 16)]
    found = [np.arange(4, 14), np.arange(0, 4), np.array([30, 31])]
    matches = match_masks(found, true)

    assert sorted(matches.pairs.items()) == [(0, 1), (1, 0)]
    assert matches.f[0, 1] == pytest.approx(2 * 4 / (10 + 6))
    assert matches.similarity[1, 0] == pytest.approx(4 / 10)
    assert matches.overlap.precision == pytest.approx(8 / 16)
    assert matches.overlap.recall == pytest.approx(8 / 16)
    assert (matches.overlap.hits, matches.overlap.objects, matches.overlap.detections) == (0, 2, 3)


def test_memory_of_hota_grows_with_pairs_that_match() -> None:
    """Counting the matches of all pairs of 2,300 tracks took 3.5 GB."""
    count = 400
    frames = [FrameIdentities([k], [k], np.ones((1, 1))) for k in range(count)]
    tracemalloc.start()
    try:
        hota = compute_tracking_metrics(frames).hota
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert hota == pytest.approx(1)
    assert peak < 8 * 8 * count**2  # a table of all pairs has 8 bytes for each of 19 thresholds
