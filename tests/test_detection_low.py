"""Tests of low-profile objects, such as plates lower than the depth error of a table."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.ablation import without
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.simulation import KINECT, REALSENSE, make_scene, render_frame
from shapecat.types import Camera, Frame, Scene
from tests.test_detection import overlaps

Array = NDArray[Any]
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
TILT = np.radians(40)
UP = np.array([0.0, -np.cos(TILT), -np.sin(TILT)])
DISTANCE = 0.9


def rays() -> Array:
    """Return the rays of the pixels (480, 640, 3), optical frame."""
    v, u = np.mgrid[:480, :640]
    return np.stack([(u - 319.5) / 525, (v - 239.5) / 525, np.ones(u.shape)], -1)


def depth_of(height: Array, distance: float = DISTANCE) -> Array:
    """Return the depth of a surface that lies ``height`` (480, 640) metres above a table."""
    offset = -distance * np.sin(TILT)
    return np.asarray((offset + height) / (rays() @ UP))


def measured(depth: Array, seed: int = 0) -> Frame:
    """Return a frame with the noise and the quantization of a Kinect."""
    inverse = 1 / depth + np.random.default_rng(seed).normal(0, 0.0015, depth.shape)
    depth = 1 / (np.round(inverse / 0.0029) * 0.0029)
    return Frame("t", 0, 0, 0, "c", depth=depth.astype(np.float32), camera=CAMERA)


def found(frame: Frame, *, low_profile: bool = True) -> Scene:
    """Detect objects with or without the step for low-profile objects."""
    rng = np.random.default_rng(0)
    with without(*([] if low_profile else ["low profile"])):
        return detect(frame, settings=DetectionSettings(), rng=rng)


@pytest.fixture
def unrejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the segments that structure rejection would remove."""
    lenient = CLEANUP._replace(min_logit=-9.0, min_far_logit=-9.0)
    monkeypatch.setattr("shapecat.detection.cleanup.structure.CLEANUP", lenient)


def bump(radius: float, edge: float) -> Array:
    """Return 1 within ``radius`` pixels of the middle, falling to 0 over ``edge`` pixels."""
    v, u = np.mgrid[:480, :640]
    r = np.hypot(u - 320, (v - 250) / np.sin(TILT))
    return np.asarray(np.clip((radius + edge / 2 - r) / edge, 0, 1))


@pytest.mark.usefixtures("unrejected")
def test_depth_error_of_table_is_not_an_object() -> None:
    """The depth error is larger than the minimum height of an object."""
    frame = measured(depth_of(0.016 * bump(80, 90)))
    assert len(found(frame).candidates) == 0
    assert len(found(frame, low_profile=False).candidates) > 0, (
        "the error is too low to test anything"
    )


def test_thin_plate_is_an_object() -> None:
    """A disc of 5 mm is below the minimum height, but has an edge."""
    disc = bump(60, 4)
    frame = measured(depth_of(0.005 * disc))
    (one,) = found(frame).candidates
    inside = (disc.reshape(-1) > 0.5)[one.indices]
    assert inside.mean() > 0.93
    assert inside.sum() > 0.9 * np.count_nonzero(disc > 0.5)


def test_plate_does_not_grow_over_adjacent_depth_error() -> None:
    v, u = np.mgrid[:480, :640]
    side = np.exp(-(((u - 400) / 45) ** 2) - ((v - 250) / 35) ** 2)
    disc = bump(60, 4)
    frame = measured(depth_of(0.007 * disc + 0.006 * side * (disc < 0.5)))
    best = max(found(frame).candidates, key=lambda c: len(c.indices))
    assert (disc.reshape(-1) > 0.5)[best.indices].mean() > 0.85


@pytest.mark.parametrize("sensor", [KINECT, REALSENSE])
def test_empty_tables_have_few_false_objects(sensor: Any) -> None:
    """A dozen tables have at most one false object, whatever the sensor's depth error."""
    count = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        frame, _ = render_frame(make_scene("empty", rng, frames=1), 0, rng=rng, sensor=sensor)
        count += len(found(frame).candidates)
    assert count <= 1


def test_plate_with_very_thin_floor_is_found_whole() -> None:
    """Only its rim rises clearly; the floor is thinner than a step of the sensor."""
    disc = bump(60, 4)
    frame = measured(depth_of(0.01 * (disc - bump(50, 4)) + 0.002 * disc))
    (one,) = found(frame).candidates
    assert np.isin(np.flatnonzero(disc.reshape(-1) > 0.5), one.indices).mean() > 0.9


def test_plate_on_wave_of_depth_error_is_found_whole() -> None:
    """No height threshold separates its rim from the crest of the wave."""
    disc, wave = bump(60, 4), np.cos(2 * np.pi * (np.mgrid[:480, :640][1] - 250) / 250)
    frame = measured(depth_of(0.0035 * wave + 0.006 * (disc - bump(50, 4)) + 0.001 * disc))
    assert min(overlaps(found(frame), 1 * (disc > 0.5), [1])) > 0.85


def test_plate_touching_a_box_is_kept() -> None:
    """Low cells beside a tall object are its contact boundary, unless they are level."""
    v, u = np.mgrid[:480, :640]
    disc = bump(60, 4)
    box = (u > 379) & (u < 480) & (v > 150) & (v < 330)
    frame = measured(depth_of(np.where(box, 0.1, 0.008 * disc)))
    assert min(overlaps(found(frame), 1 * (disc > 0.5), [1])) > 0.8


def test_half_occluded_plate_is_an_object() -> None:
    """The occluded part of an outline is not evidence against an object."""
    v, u = np.mgrid[:480, :640]
    disc, near = bump(45, 4), (u > 320) & (u < 410) & (v > 200)
    depth = np.where(near, 0.55, depth_of(0.005 * disc))
    plate = (disc > 0.5) & ~near
    assert min(overlaps(found(measured(depth)), 1 * plate, [1])) > 0.9


def test_very_thin_plate_is_found_near_the_camera() -> None:
    """Near the camera, 3 mm are many steps of the sensor."""
    disc = bump(60, 4)
    (one,) = found(measured(depth_of(0.003 * disc, 0.55))).candidates
    assert np.isin(np.flatnonzero(disc.reshape(-1) > 0.5), one.indices).mean() > 0.9


def test_very_thin_plate_is_found_with_low_noise() -> None:
    """The minimum rise depends on the noise in the frame."""
    disc = bump(60, 4)
    inverse = 1 / depth_of(0.0025 * disc)
    inverse += np.random.default_rng(0).normal(0, 0.0005, inverse.shape)
    frame = Frame("t", 0, 0, 0, "c", depth=(1 / inverse).astype(np.float32), camera=CAMERA)
    (one,) = found(frame).candidates
    assert np.isin(np.flatnonzero(disc.reshape(-1) > 0.5), one.indices).mean() > 0.9


def test_large_plate_does_not_tilt_the_table_plane() -> None:
    """Least squares may converge to a plane between the plate and the table."""
    v, u = np.mgrid[:480, :640]
    scene = found(measured(depth_of(0.008 * ((v > 300) & (u < 360)))))
    assert scene.up @ UP > np.cos(np.radians(0.1))
    assert abs(scene.planes[0].offset + DISTANCE * np.sin(TILT)) < 1e-3


def test_small_ball_does_not_grow_over_depth_error() -> None:
    """The error is lower than any object, but not lower than a contact boundary."""
    rng = np.random.default_rng(648)
    frame, labels = render_frame(make_scene("clutter", rng, frames=1), 0, rng=rng, sensor=KINECT)
    assert min(overlaps(found(frame), labels, [22])) > 0.6
