"""What the trees that reject background learn from."""

import numpy as np
import pytest

from shapecat.models.structure import FEATURES, Series, collect, label_objects
from shapecat.simulation import KINECT, make_scene, render_frame

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


@pytest.mark.many
def test_what_is_learned_does_not_depend_on_the_number_of_processes() -> None:
    one, two = (collect(SERIES, jobs) for jobs in (1, 2))
    assert np.array_equal(one.features, two.features)
    assert np.array_equal(one.objects, two.objects)
