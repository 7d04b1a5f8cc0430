"""Simulation of falling objects until they are at rest, with the physics engine MuJoCo."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from shapecat.arrays import F8
from shapecat.geometry import quaternion_from_rotation, rotation_from_quaternion, transform
from shapecat.simulation.shapes.convex_parts import convex_parts
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.types import Pose

__all__ = ["Drop", "SettledPose", "settle"]

_STEP_S = 0.004
"""Time step of the simulation."""
_DENSITY = 400.0
"""Density of a solid object, kg/m3."""
_HOLLOW_DENSITY = 1000.0
"""Density of the walls of a hollow object, kg/m3."""
_START_SPEED = 0.1
"""Downward speed at the start of a drop, m/s."""
_FRICTION = (0.7, 0.005, 0.002)
"""Coefficients of sliding (no unit), torsional and rolling friction (metres)."""
_CLEARANCE_M = 0.02
"""Height of a dropped object above the highest object below it."""
_FALL_STEPS = 75
"""Simulation steps after each drop, before the next one."""
_MAX_STEPS = 750
"""Maximum number of simulation steps after the `_FALL_STEPS` of the last drop."""
_STILL = 0.02
"""Speed, in m/s and rad/s, below which an object is at rest."""
_CHECK_STEPS = 12
"""Simulation steps between two checks that everything is at rest."""
_WAITING_M = 5.0
"""Minimum x, and y, of the positions where objects wait to be dropped, far from the scene."""


class Drop(NamedTuple):
    """An object to drop: its rotation (3, 3) and the x and y (2,) of its middle, metres, world."""

    mesh: Mesh
    rotation: F8
    place: F8


class SettledPose(NamedTuple):
    """Final pose of a dropped object.

    Attributes
    ----------
    pose : ``world_from_mesh``, rounded to 1 um.
    supported_by : index of the object that carries most of its weight; None if an obstacle does,
        or nothing.
    """

    pose: Pose
    supported_by: int | None


def settle(obstacles: Sequence[Mesh], drops: Sequence[Drop]) -> list[SettledPose]:
    """Drop objects one by one from just above the others, and simulate until all are at rest.

    The simulation ends at the latest `_FALL_STEPS` + `_MAX_STEPS` steps after the last drop.

    Parameters
    ----------
    obstacles : fixed meshes, world frame.

    Returns
    -------
    One settled pose for each drop, including objects that fell off.
    """
    import mujoco  # type: ignore[import-untyped]  # noqa: PLC0415  slow; most scenes need no physics

    # Otherwise, MuJoCo writes a log file into the working folder.
    mujoco.set_mju_user_warning(_ignore_warning)
    model = _model(mujoco, obstacles, drops)
    data = mujoco.MjData(model)
    shapes = [_extreme_points(drop.mesh) for drop in drops]
    fixed = [np.asarray(obstacle.vertices, np.float64) for obstacle in obstacles]
    for k, drop in enumerate(drops):
        placed_points = fixed + [transform(_pose(data, j), shapes[j]) for j in range(k)]
        start = _start(drop, shapes[k], placed_points)
        _release(model, data, k, start)
        for _ in range(_FALL_STEPS):
            mujoco.mj_step(model, data)
    for _ in range(_MAX_STEPS // _CHECK_STEPS):
        if float(np.abs(data.qvel).max()) < _STILL:
            break
        for _ in range(_CHECK_STEPS):
            mujoco.mj_step(model, data)
    return _settled_poses(mujoco, model, data, len(drops))


def _ignore_warning(_: str) -> None:
    """Ignore a warning of an unstable simulation; callers discard objects that fly off."""


def _model(mujoco: Any, obstacles: Sequence[Mesh], drops: Sequence[Drop]) -> Any:
    """Return the model of fixed obstacles and of objects that wait far away to be dropped."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _STEP_S
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)  # objects at rest cost nothing
    for k, obstacle in enumerate(obstacles):
        for j, part in enumerate(convex_parts(obstacle)):
            _add_solid(mujoco, spec, spec.worldbody, f"obstacle{k}part{j}", part)
    for k, drop in enumerate(drops):
        waiting = [_WAITING_M + k, _WAITING_M, 0.0]
        body = spec.worldbody.add_body(name=f"drop{k}", pos=waiting, gravcomp=1)
        body.add_freejoint()
        parts = convex_parts(drop.mesh)
        for j, part in enumerate(parts):
            solid = _add_solid(mujoco, spec, body, f"drop{k}part{j}", part)
            solid.density = _DENSITY if len(parts) == 1 else _HOLLOW_DENSITY
    return spec.compile()


def _add_solid(mujoco: Any, spec: Any, body: Any, name: str, corners: F8) -> Any:
    """Add a convex solid with these ``corners`` (n, 3), metres, to a body; return it."""
    spec.add_mesh(name=name, uservert=np.asarray(corners, np.float64).reshape(-1))
    kind = mujoco.mjtGeom.mjGEOM_MESH
    return body.add_geom(type=kind, meshname=name, name=name, friction=_FRICTION, condim=6)


def _extreme_points(mesh: Mesh) -> F8:
    """Return the vertices (n, 3) of a mesh that are corners of its convex hull."""
    points = np.asarray(mesh.vertices, np.float64)
    return np.asarray(points[ConvexHull(points).vertices])


def _start(drop: Drop, points: F8, placed_points: Sequence[F8]) -> Pose:
    """Return the start pose of a dropped object, slightly above everything at its position.

    ``points`` (n, 3) are its extreme vertices; ``placed_points`` are the vertices (m, 3) of each
    mesh that is already in the scene, world frame.
    """
    turned = points @ drop.rotation.T
    middle = (turned.min(axis=0) + turned.max(axis=0)) / 2
    shift = np.array([*drop.place, 0.0]) - [*middle[:2], turned[:, 2].min()]
    low, high = turned.min(axis=0)[:2] + shift[:2], turned.max(axis=0)[:2] + shift[:2]
    below = [
        float(other[:, 2].max())
        for other in placed_points
        if (other[:, :2].min(axis=0) < high).all() and (other[:, :2].max(axis=0) > low).all()
    ]
    top = max(below, default=0.0)
    return Pose(drop.rotation, shift + np.array([0, 0, top + _CLEARANCE_M]))


def _release(model: Any, data: Any, k: int, start: Pose) -> None:
    """Move a waiting object to its start pose and let it fall."""
    model.body_gravcomp[k + 1] = 0.0  # the world is body 0
    x, y, z, w = quaternion_from_rotation(start.rotation)
    data.qpos[7 * k : 7 * k + 7] = [*start.translation, w, x, y, z]
    data.qvel[6 * k : 6 * k + 6] = [0, 0, -_START_SPEED, 0, 0, 0]  # wakes it


def _pose(data: Any, k: int) -> Pose:
    *place, w, x, y, z = np.round(data.qpos[7 * k : 7 * k + 7], 9)
    return Pose(rotation_from_quaternion([x, y, z, w]), np.round(place, 6))


def _settled_poses(mujoco: Any, model: Any, data: Any, count: int) -> list[SettledPose]:
    """Return the settled pose of each object; the body that pushes it up most is its support."""
    model.opt.enableflags = 0  # sleeping bodies have no contacts
    mujoco.mj_forward(model, data)
    upward_force = np.zeros((count, count + 1))  # the last column: obstacles
    force = np.zeros(6)
    for k in range(data.ncon):
        contact = data.contact[k]
        mujoco.mj_contactForce(model, data, k, force)
        upward = float(force[:3] @ contact.frame.reshape(3, 3)[:, 2])  # on the second geom
        one, two = (int(model.geom_bodyid[geom]) - 1 for geom in contact.geom)
        for body, other, up in ((two, one, upward), (one, two, -upward)):
            if body >= 0:
                upward_force[body, other] += up
    supporting = upward_force.argmax(axis=1)
    supporting[upward_force.max(axis=1) <= 0] = count  # still in the air
    return [
        SettledPose(_pose(data, k), None if supporting[k] == count else int(supporting[k]))
        for k in range(count)
    ]
