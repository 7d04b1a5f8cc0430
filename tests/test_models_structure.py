"""Tests of the training data of the trees that reject background."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from shapecat.arrays import F4
from shapecat.detection.cleanup.context import add_context
from shapecat.detection.cleanup.object_features import OBJECT_FEATURES
from shapecat.detection.cleanup.structure import as_rows, is_uncertain, logits_of
from shapecat.geometry import transform
from shapecat.models.structure import (
    Samples,
    Series,
    _with_arms,
    collect,
    grow_rejection_trees,
    label_objects,
)
from shapecat.models.viewpoints import move_to_floor, random_viewpoint
from shapecat.simulation import IDEAL, KINECT, make_scene, render_frame
from shapecat.simulation.scenes import physics
from shapecat.simulation.scenes.furniture import EQUIPMENT, make_rack, make_tote
from shapecat.simulation.scenes.worlds import World
from shapecat.types import Pose

SERIES = (Series("bin", 2000, 2, ("kinect",)), Series("clutter", 2000, 1, ("kinect",), scale=1.5))


def test_segments_of_objects_and_bin_walls_are_labelled() -> None:
    rng = np.random.default_rng(2000)
    world = make_scene("bin", rng, frames=1)
    frame, pixel_labels = render_frame(world, 0, rng=rng, sensor=KINECT)
    object_labels = np.array([item.label for item in world.objects])
    (samples,) = label_objects(frame, pixel_labels, object_labels)
    assert set(samples.objects.tolist()) == {True, False}
    assert np.isfinite(as_rows(samples.features)).all()
    assert samples.borders[0].shape == (4, len(samples.objects), len(samples.objects))
    (none,) = label_objects(frame, pixel_labels, object_labels[:0])
    assert none.objects.tolist() == [False] * len(samples.objects)


def test_objects_move_to_the_floor_with_the_table_removed() -> None:
    world = make_scene("room", np.random.default_rng(2000), frames=1)
    below = move_to_floor(world)
    assert "table" not in {support.name for support in below.supports}
    lowest = [
        transform(item.pose, item.mesh.vertices)[:, 2].min()
        for item in below.objects
        if item.on_support
    ]
    assert len(lowest) > 0
    assert np.abs(lowest).max() < 0.01
    # The truth must not name a plane that is gone.
    assert {item.on_support for item in below.objects} <= {"floor", None}


def test_random_viewpoint_faces_the_objects_within_the_range_of_the_sensor() -> None:
    world = make_scene("pile", np.random.default_rng(2001), frames=1)
    world = replace(world, objects=world.objects[:1])
    place = world.objects[0].pose.translation
    for seed in range(20):
        pose = random_viewpoint(world, KINECT, np.random.default_rng(seed))
        assert isinstance(pose, Pose)
        away = place - pose.translation
        distance = float(np.linalg.norm(away))
        assert KINECT.nearest_m < distance < 2.8
        assert pose.rotation[:, 2] @ away > 0.98 * distance
        assert -away[2] / distance > 0.13


def test_sides_of_a_tote_lean_outwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """All sides lean by the same angle and meet at the corners; the bottom stays."""
    monkeypatch.setattr(physics, "_FALL_STEPS", 1)  # the content does not matter
    monkeypatch.setattr(physics, "_MAX_STEPS", 0)
    world = make_scene("bin", np.random.default_rng(2002), frames=1)
    upright = {support.name: support for support in world.supports}
    bottom = upright["bin"].height
    for seed in range(4):
        leaning = {s.name: s for s in make_tote(np.random.default_rng(seed), world.supports)}
        assert leaning.keys() >= upright.keys()
        slopes = []
        for name, axis in (("left_side", 0), ("right_side", 0), ("front", 1), ("back", 1)):
            before, after = upright[name].mesh.vertices, leaning[name].mesh.vertices
            outer = np.abs(before[:, axis]) > np.abs(before[:, axis]).max() - 1e-6
            rise = before[outer, 2] - bottom
            out = np.abs(after[outer, axis]) - np.abs(before[outer, axis])
            assert out[rise <= 0] == pytest.approx(0, abs=1e-6)
            slopes += (out[rise > 0.01] / rise[rise > 0.01]).tolist()
        assert np.ptp(slopes) < 1e-3
        assert 0.03 < np.mean(slopes) < 0.47
        corners = [leaning[n].mesh.vertices for n in ("left_side", "front")]
        tops = [
            points[points[:, 2] > points[:, 2].max() - 1e-6, :2].min(axis=0) for points in corners
        ]
        assert tops[0][0] == pytest.approx(tops[1][0], abs=0.02)


def test_a_rack_has_posts_instead_of_sides() -> None:
    """Posts at the corners extend above the highest shelf; the floor and the shelves stay."""
    world = make_scene("shelf", np.random.default_rng(2004), frames=1)
    boards = [s for s in world.supports if s.name.startswith("board")]
    corner = np.abs(np.concatenate([board.mesh.vertices for board in boards])).max(axis=0)
    for seed in range(4):
        rack = make_rack(np.random.default_rng(seed), world.supports)
        names = {support.name for support in rack}
        assert names >= {"floor", *(board.name for board in boards)}
        assert not names & {"left_side", "right_side"}
        posts = [s.mesh.vertices for s in rack if s.name.startswith("post")]
        assert len(posts) == 4
        assert all(post[:, 2].min() == 0 and post[:, 2].max() > corner[2] for post in posts)
        places = np.abs([post[:, :2].mean(axis=0) for post in posts])
        assert places == pytest.approx(np.tile(corner[:2], (4, 1)), abs=0.05)


def _armed(world: World, arms: str) -> Iterator[tuple[np.random.Generator, Pose, World, F4]]:
    """Add arms to a world, for eight viewpoints in turn.

    Yield the generator that placed the arms, the viewpoint, the world and the arms' points (n, 3).
    """
    for seed in range(8):
        rng = np.random.default_rng(seed)
        pose = random_viewpoint(world, KINECT, rng)
        assert isinstance(pose, Pose)
        armed = _with_arms(world, pose, KINECT.camera, arms, rng)
        added = armed.supports[len(world.supports) :]
        assert {arm.label for arm in added} == {EQUIPMENT}
        yield rng, pose, armed, np.concatenate([arm.mesh.vertices for arm in added])


def test_arms_of_the_robot_begin_beside_its_camera() -> None:
    """Arms stay above the support, and are visible in most images."""
    world = make_scene("clutter", np.random.default_rng(2003), frames=1)
    table = max(support.height for support in world.supports if support.holds_objects)
    seen = 0
    for rng, pose, armed, points in _armed(world, "reaching"):
        assert points[:, 2].min() > table
        assert np.linalg.norm(points - pose.translation, axis=1).min() < 0.75
        seen += bool((render_frame(armed, pose, rng=rng, sensor=KINECT)[1] == EQUIPMENT).any())
    assert seen >= 6


def test_resting_arms_lie_on_the_support_and_reach_the_image_border() -> None:
    """Otherwise they would look like objects, or like raised arms, which are easier to reject."""
    world = make_scene("clutter", np.random.default_rng(2003), frames=1)
    table = max(support.height for support in world.supports if support.holds_objects)
    cut = 0
    for rng, pose, armed, points in _armed(world, "resting"):
        lowest = float(points[:, 2].min()) - table
        assert lowest > -0.1  # joints are thicker than the links
        pixel_labels = render_frame(armed, pose, rng=rng, sensor=IDEAL)[1].reshape(480, 640)
        rim = np.concatenate(
            [pixel_labels[0], pixel_labels[-1], pixel_labels[:, 0], pixel_labels[:, -1]]
        )
        within = (pixel_labels[40:-40, 40:-40] == EQUIPMENT).any()
        cut += bool(lowest < 0.06 and within and (rim == EQUIPMENT).any())
    assert cut >= 5


def test_world_without_arms_is_unchanged() -> None:
    world = make_scene("clutter", np.random.default_rng(2003), frames=1)
    assert _with_arms(world, 0, KINECT.camera, "none", np.random.default_rng(0)) is world


def test_trees_in_context_learn_from_the_logits_of_neighbours() -> None:
    """Of two equal segments, one is an object and the other is beside obvious background."""
    rng = np.random.default_rng(5)
    samples = []
    for _ in range(60):
        features = np.zeros(3, OBJECT_FEATURES)
        features["segment"]["top_m"] = rng.normal([0.5, 0.1, 0.1], 0.01)
        borders = np.zeros((4, 3, 3), np.float32)
        borders[0, 0, 1] = borders[0, 1, 0] = 5
        samples.append(Samples(features, np.array([False, False, True]), (borders,)))
    alone, in_context = grow_rejection_trees(samples, 0)
    features["segment"]["top_m"] = [0.5, 0.1, 0.1]
    logits = logits_of(as_rows(features), alone)
    assert logits[0] < logits[1] == logits[2]
    told = logits_of(as_rows(add_context(features, logits, borders)), in_context)
    assert is_uncertain(logits).tolist() == [False, True, True]
    assert (told[1:] > 0).tolist() == [False, True]


@pytest.mark.many
def test_samples_do_not_depend_on_the_number_of_processes() -> None:
    for one, two in zip(*(collect(SERIES, jobs) for jobs in (1, 2)), strict=True):
        assert np.array_equal(one.features, two.features)
        assert np.array_equal(one.objects, two.objects)
        assert all(map(np.array_equal, one.borders, two.borders))
