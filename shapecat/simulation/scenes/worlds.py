"""Simulated worlds: supports, objects, their motions, and a camera path."""

from collections.abc import Mapping
from dataclasses import field
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F8, I4, U1, Record, array
from shapecat.geometry import IDENTITY, compose
from shapecat.simulation.camera.render import Geometry, geometry
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.types import Pose

__all__ = ["FIRST_OBJECT_LABEL", "PlacedObject", "Support", "World", "pose_from_yaw"]

FIRST_OBJECT_LABEL = 20
"""Pixel label of the object with track 0; supports have 1 to 9, pixels without depth 0."""


class Support(Record):
    """A table top, shelf board, floor or wall.

    Attributes
    ----------
    name : unique in its world.
    label : pixel label, 1 to 9. Supports that hold objects need different labels; otherwise, the
        ground truth counts their pixels together.
    mesh : metres, world frame.
    outline : (k, 3) corners of its horizontal surface, metres, world frame; empty (the default) if
        nothing can stand on it, as on a wall.
    """

    name: str
    label: int
    mesh: Mesh
    outline: F8 = array("k 3", "f8", default_factory=partial(np.zeros, (0, 3)))

    @property
    def holds_objects(self) -> bool:
        """Whether objects can stand on it."""
        return len(self.outline) > 0

    @property
    def height(self) -> float:
        """Height of its surface in the world, metres; only if it holds objects."""
        return float(self.outline[0, 2])


class PlacedObject(Record):
    """An object in a world.

    Attributes
    ----------
    track : number of the object, from 0; its pixel label is `FIRST_OBJECT_LABEL` + track.
    category : one of the shape categories, or ``unknown``.
    kind : the category, or the kind of distractor.
    mesh : metres, z up, standing on z = 0.
    pose : ``world_from_mesh`` at the start.
    on_support : name of the support that the object stands on; None if it stands on an object.
    on_track : track of the object that it stands on; None if it stands on a support.
    lying : whether its own z axis is horizontal; False for boxes.
    upside_down : whether its own z axis points down.
    tilted : whether none of its own axes is within 15 degrees of the vertical.
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
        return FIRST_OBJECT_LABEL + self.track

    @property
    def indistinct(self) -> bool:
        """Whether its shape also fits another category: an upside-down cup without a handle."""
        return self.category == "cup" and self.upside_down and not _one_sided(self.mesh)


class World(Record):
    """A scene over time; the world frame is fixed, with z up and the floor at z = 0.

    Attributes
    ----------
    kind : name of the kind of scene.
    supports, objects : contents of the scene; mesh ids count the supports, then the objects.
    path : ``world_from_camera`` for each of the t images, with the camera's optical axes.
    turns : (t,) rotation of all objects about the world's z axis in each frame, from their start
        poses, radians; None if they do not rotate.
    motions : for each track of an object that moves, comes or goes, its translation (t, 3) from its
        start pose in each frame, metres, world frame; NaN in frames where the object is absent.
    """

    kind: str
    supports: tuple[Support, ...]
    objects: tuple[PlacedObject, ...]
    path: tuple[Pose, ...]
    turns: F8 | None = array("t", "f8", default=None)
    motions: Mapping[int, F8] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.path)

    def pose_of(self, item: PlacedObject, frame: int) -> Pose:
        """Return ``world_from_mesh`` of an object in a frame; an absent object is not shifted."""
        pose = item.pose
        if item.track in self.motions and self.present(item, frame):
            pose = Pose(pose.rotation, pose.translation + self.motions[item.track][frame])
        turn = 0.0 if self.turns is None else float(self.turns[frame])
        return compose(pose_from_yaw(turn), pose) if turn else pose

    def present(self, item: PlacedObject, frame: int) -> bool:
        """Return whether an object is present in a frame."""
        shifts = self.motions.get(item.track)
        return shifts is None or bool(np.isfinite(shifts[frame]).all())

    def geometry(self, frame: int) -> Geometry:
        """Return the triangles of the supports, then of the present objects, in the world frame."""
        moves = self.motions or self.turns is not None
        return self._gather(frame) if moves else self._still

    def labels_of(self, mesh_ids: I4) -> U1:
        """Return the pixel labels (h, w), uint8, of the visible meshes; 0 for the mesh id -1."""
        labels = [s.label for s in self.supports] + [t.label for t in self.objects]
        return np.array([*labels, 0], np.uint8)[mesh_ids]

    @cached_property
    def _still(self) -> Geometry:
        return self._gather(0)

    def _gather(self, frame: int) -> Geometry:
        objects = [
            (item.mesh if self.present(item, frame) else _NOTHING, self.pose_of(item, frame))
            for item in self.objects
        ]
        return geometry([(support.mesh, IDENTITY) for support in self.supports] + objects)


_NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))


def pose_from_yaw(angle: float, place: ArrayLike = (0, 0, 0)) -> Pose:
    """Return the pose with yaw ``angle``, radians, at ``place`` (3,); rotation rounded to 1e-9."""
    c, s = np.round(np.cos(angle), 9), np.round(np.sin(angle), 9)
    return Pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.asarray(place))


def _one_sided(mesh: Mesh) -> bool:
    """Return whether a part, such as a handle, sticks out from one side of a mesh."""
    points = np.asarray(mesh.vertices, np.float64)
    rim = points[points[:, 2] > points[:, 2].max() - 0.002, :2]
    angle = np.arange(64) * (2 * np.pi / 64)
    radius = (points[:, :2] - (rim.min(axis=0) + rim.max(axis=0)) / 2) @ [
        np.cos(angle),
        np.sin(angle),
    ]
    radius = radius.max(axis=0)
    return bool(np.abs(radius - np.roll(radius, 32)).max() > 0.25 * radius.mean())
