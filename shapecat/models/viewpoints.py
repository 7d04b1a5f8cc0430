"""Viewpoints of the scenes that the trees of detection are trained on."""

from dataclasses import replace

import numpy as np

from shapecat.simulation.camera.sensors import Sensor
from shapecat.simulation.scenes.paths import Filming, arc_orbit
from shapecat.simulation.scenes.worlds import World
from shapecat.simulation.shapes.randomness import log_uniform
from shapecat.types import Pose

__all__ = ["move_to_floor", "random_viewpoint"]

_DISTANCE_M, _ELEVATION_DEG, _SWEEP_DEG = (0.35, 2.6), (12.0, 84.0), (20.0, 150.0)
"""Ranges of the camera's position relative to its target, as for `arc_orbit`."""
_CLOSER_M = 0.08
"""Minimum distance by which the target is beyond the sensor's near limit."""


def random_viewpoint(
    world: World,
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    distance_m: tuple[float, float] = _DISTANCE_M,
) -> Pose | int:
    """Return a random ``world_from_camera`` that faces the objects.

    If there are no objects, return 0, the first frame of the path.

    Parameters
    ----------
    distance_m : minimum and maximum distance from a point among the objects, metres; larger if the
        near limit of the sensor requires it.
    """
    places = [item.pose.translation for item in world.objects]
    if not places:
        return 0
    target = (np.mean(places, axis=0) + places[rng.integers(len(places))]) / 2
    nearest, farthest = max(distance_m[0], sensor.nearest_m + _CLOSER_M), distance_m[1]
    distance = log_uniform(rng, nearest, max(nearest, farthest))
    (pose,) = arc_orbit(
        rng,
        np.asarray(target),
        Filming(1, 30.0),
        distance=distance,
        elevation=_ELEVATION_DEG,
        sweep=_SWEEP_DEG,
    )
    return pose


def move_to_floor(world: World) -> World:
    """Remove the table, and the arms and the screen on it; put the objects on the floor.

    The world must have a support named ``table``.
    """
    table = next(support for support in world.supports if support.name == "table")
    down = np.array([0.0, 0.0, -table.height])
    objects = (
        replace(
            item,
            pose=Pose(item.pose.rotation, item.pose.translation + down),
            on_support="floor" if item.on_support == table.name else item.on_support,
        )
        for item in world.objects
    )
    rest = (s for s in world.supports if s is not table and not s.name.startswith("robot"))
    return replace(world, supports=tuple(rest), objects=tuple(objects))
