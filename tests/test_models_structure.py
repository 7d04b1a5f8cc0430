"""What the trees that reject background learn from."""

from dataclasses import replace

import numpy as np
import pytest

from shapecat.geometry import transform
from shapecat.models.structure import (
    FEATURES,
    Series,
    _on_floor,
    _viewpoint,
    collect,
    label_objects,
)
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.types import Pose

SERIES = (Series("bin", 2000, 2, ("kinect",)), Series("clutter", 2000, 1, ("kinect",), scale=1.5))


def test_objects_are_told_from_the_walls_of_their_bin() -> None:
    rng = np.random.default_rng(2000)
    world = make_scene("bin", rng, frames=1)
    frame, owners = render_frame(world, 0, rng=rng, sensor=KINECT)
    things = np.array([thing.label for thing in world.things])
    told = list(label_objects(frame, owners, things))
    assert {is_object for _, is_object in told} == {True, False}
    assert all(row.shape == (FEATURES,) and np.isfinite(row).all() for row, _ in told)
    none = list(label_objects(frame, owners, things[:0]))
    assert [is_object for _, is_object in none] == [False] * len(told)


def test_objects_lie_on_the_floor_where_the_table_was() -> None:
    world = make_scene("room", np.random.default_rng(2000), frames=1)
    below = _on_floor(world)
    assert "table" not in {support.name for support in below.supports}
    lowest = [
        transform(thing.pose, thing.mesh.vertices)[:, 2].min()
        for thing in below.things
        if thing.on_support
    ]
    assert len(lowest) > 0
    assert np.abs(lowest).max() < 0.01


def test_a_camera_anywhere_looks_at_the_objects_from_where_its_sensor_can_read() -> None:
    world = make_scene("pile", np.random.default_rng(2001), frames=1)
    world = replace(world, things=world.things[:1])
    place = world.things[0].pose.translation
    for seed in range(20):
        pose = _viewpoint(world, KINECT, np.random.default_rng(seed))
        assert isinstance(pose, Pose)
        away = place - pose.translation
        distance = float(np.linalg.norm(away))
        assert KINECT.nearest_m < distance < 2.1
        assert pose.rotation[:, 2] @ away > 0.98 * distance
        assert -away[2] / distance > 0.13


@pytest.mark.many
def test_what_is_learned_does_not_depend_on_the_number_of_processes() -> None:
    one, two = (collect(SERIES, jobs) for jobs in (1, 2))
    assert np.array_equal(one.features, two.features)
    assert np.array_equal(one.objects, two.objects)
