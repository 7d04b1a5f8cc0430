"""What stands where, and from where it is seen."""

from functools import cached_property

import numpy as np

from shapecat.arrays import F8, Record, array
from shapecat.geometry import compose
from shapecat.simulation.mesh import Mesh
from shapecat.simulation.render import Geometry, geometry
from shapecat.types import Pose

__all__ = ["FIRST_THING_LABEL", "Motion", "Support", "Thing", "World", "turned_about_z"]

FIRST_THING_LABEL = 20
"""Pixel label of the thing with track 0; supports have 1 to 9, no reading is 0."""


class Support(Record):
    """A table top, shelf board, floor or wall.

    Attributes
    ----------
    name : unique in its world.
    label : pixel label, 1 to 9.
    mesh : in the world frame.
    outline : (k, 3) metres, world frame: corners of the level surface things can stand on; none
        for a wall.
    """

    name: str
    label: int
    mesh: Mesh
    outline: F8 = array("k 3", "f8")

    @property
    def level(self) -> bool:
        """Whether things can stand on it."""
        return len(self.outline) > 0

    @property
    def height(self) -> float:
        """Height of its surface in the world, metres."""
        return float(self.outline[0, 2])


class Thing(Record):
    """An object in a world.

    Attributes
    ----------
    track : its number, from 0; its pixel label is `FIRST_THING_LABEL` more.
    category : one of the shape categories, or ``unknown``.
    kind : what it is, for people: the category or the kind of distractor.
    pose : ``world_from_mesh`` at the start.
    on_support : name of the support it stands on, or None.
    on_track : track of the thing it stands on, or None.
    lying, upside_down : its own z axis is level, or points down.
    tilted : none of its own axes is within 15 degrees of the vertical.
    """

    track: int
    category: str
    kind: str
    mesh: Mesh
    pose: Pose
    on_support: str | None
    on_track: int | None
    lying: bool = False
    upside_down: bool = False
    tilted: bool = False

    @property
    def label(self) -> int:
        """Its pixel label."""
        return FIRST_THING_LABEL + self.track

    @property
    def indistinct(self) -> bool:
        """Whether its shape does not tell its category: a cup upside down without a handle."""
        return self.category == "cup" and self.upside_down and not _one_sided(self.mesh)


class Motion(Record):
    """How a thing moves, comes and goes.

    Attributes
    ----------
    track : the thing.
    shifts : (t, 3) metres, for each frame, from its pose at the start; NaN where it is not there.
    """

    track: int
    shifts: F8 = array("t 3", "f8")


class World(Record):
    """A scene over time. The world frame is fixed, z up, the floor at z = 0.

    Attributes
    ----------
    path : ``world_from_camera`` for each frame, optical axes.
    turns : (t,) angle, for each frame, by which the things have turned about the world's z axis.
    motions : of the things that do more than that.
    """

    kind: str
    supports: tuple[Support, ...]
    things: tuple[Thing, ...]
    path: tuple[Pose, ...]
    turns: F8 = array("t", "f8")
    motions: tuple[Motion, ...] = ()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.path)

    def pose_of(self, thing: Thing, frame: int) -> Pose:
        """Return ``world_from_mesh`` of a thing in a frame; where it would be if it is absent."""
        shift = self._shifts.get(thing.track)
        pose = thing.pose
        if shift is not None and np.isfinite(shift[frame]).all():
            pose = Pose(pose.rotation, pose.translation + shift[frame])
        turn = float(self.turns[frame])
        return compose(turned_about_z(turn), pose) if turn else pose

    def present(self, thing: Thing, frame: int) -> bool:
        """Return whether a thing is there in a frame."""
        shift = self._shifts.get(thing.track)
        return shift is None or bool(np.isfinite(shift[frame]).all())

    def geometry(self, frame: int) -> Geometry:
        """Return the triangles in the world frame; owners as in `labels`."""
        return self._gather(frame) if self.motions or self.turns[frame] else self._still

    @cached_property
    def labels(self) -> F8:
        """(n,) uint8 pixel label of each owner: the supports, then the things."""
        found = [s.label for s in self.supports] + [t.label for t in self.things]
        return np.array(found, np.uint8)

    @cached_property
    def _shifts(self) -> dict[int, F8]:
        return {motion.track: motion.shifts for motion in self.motions}

    @cached_property
    def _still(self) -> Geometry:
        return self._gather(0)

    def _gather(self, frame: int) -> Geometry:
        here = Pose(np.eye(3), np.zeros(3))
        things = [
            (thing.mesh if self.present(thing, frame) else _NOTHING, self.pose_of(thing, frame))
            for thing in self.things
        ]
        return geometry([(support.mesh, here) for support in self.supports] + things)


_NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3)))


def turned_about_z(angle: float) -> Pose:
    """Return the turn about z as a pose; entries are multiples of 1e-9."""
    c, s = np.round(np.cos(angle), 9), np.round(np.sin(angle), 9)
    return Pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.zeros(3))


def _one_sided(mesh: Mesh) -> bool:
    """Tell whether something, such as a handle, sticks out on one side of an upright thing."""
    points = np.asarray(mesh.vertices, np.float64)
    rim = points[points[:, 2] > points[:, 2].max() - 0.002, :2]
    angle = np.arange(64) * (2 * np.pi / 64)
    reach = (points[:, :2] - (rim.min(axis=0) + rim.max(axis=0)) / 2) @ [
        np.cos(angle),
        np.sin(angle),
    ]
    reach = reach.max(axis=0)
    return bool(np.abs(reach - np.roll(reach, 32)).max() > 0.25 * reach.mean())
