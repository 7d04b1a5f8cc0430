"""Simulated tables with known objects: the views a model is trained and judged on."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.config import Settings
from shapecat.detection import detect
from shapecat.evaluation import View
from shapecat.evaluation.report import UNKNOWN
from shapecat.evaluation.views import describe_view
from shapecat.geometry import (
    IDENTITY,
    inverse,
    level_from_sensor,
    rotation_from_quaternion,
    transform,
)
from shapecat.learning.baselines import shape_functions
from shapecat.models.fragments import cut_fragment, cut_halo
from shapecat.simulation.distractors import make_distractor
from shapecat.simulation.mesh import Mesh, moved, rounded_box, standing
from shapecat.simulation.paths import looking_at
from shapecat.simulation.placement import Rest, choose_rest, rests, turn_about_z
from shapecat.simulation.render import Geometry, geometry, render
from shapecat.simulation.sensors import KINECT, REALSENSE, measure
from shapecat.simulation.shapes import make_object
from shapecat.surface import voxelize
from shapecat.types import CATEGORIES, Camera, Frame, Pose, Scene

__all__ = ["World", "WorldView", "simulate_mesh", "simulate_views", "simulate_world"]

_FEWEST_PIXELS = 80
_LEAST_VISIBLE = 0.3
_OVERLAP = 0.5
_FRAGMENTS = 0.4
_TABLE_M = (1.6, 1.2, 0.03)
_COARSE = 4
"""Visible shares are judged in images this many times smaller."""
_MANNERS = {
    "cup": {"upright": 0.78, "lying": 0.12, "upside_down": 0.1},
    "can": {"upright": 0.8, "lying": 0.2},
    "bottle": {"upright": 0.8, "lying": 0.2},
    "bowl": {"upright": 0.92, "upside_down": 0.08},
    "plate": {"upright": 0.95, "upside_down": 0.05},
    "box": {"upright": 0.5, "lying": 0.5},
    UNKNOWN: {"upright": 0.7, "lying": 0.3},
}
_ROUND = {"cup", "can", "bottle"}
_SETTINGS = Settings()


@dataclass(frozen=True)
class World:
    """What kind of tables are simulated.

    ``kinds`` are the distractors to choose from, ``unknown`` their share of the objects;
    ``lying`` the share of cups, cans and bottles that lie, if not the usual one: they are harder
    than others, so one learns from more of them; ``leaning`` the share of objects that lean on
    something unseen. ``keep`` keeps the clouds of the views.
    """

    seed: int
    kinds: tuple[str, ...]
    unknown: float = 0.17
    lying: float | None = None
    leaning: float = 0.0
    cameras: int = 4
    keep: bool = False


class WorldView(NamedTuple):
    """One described view and its circumstances.

    ``manner`` is upright, lying or upside_down; ``source`` truth, detected or fragment; ``visible``
    the share of its pixels that has readings, ``overlap`` how well it was cut: what its points and
    those readings share of what either covers; ``functions`` plain shape functions; ``view`` the
    voxels, where they are kept.
    """

    descriptor: F4
    label: str
    instance: str
    points: int
    distance: float
    seconds: float
    manner: str
    source: str
    visible: float
    overlap: float
    sensor: str
    functions: F4
    view: View | None


class _Actor(NamedTuple):
    """An object on the table: its mesh in the table's frame, where it stands, what it is."""

    mesh: Mesh
    label: str
    manner: str
    support_m: float


class _Shot(NamedTuple):
    """One image of a world: the frame, its truth, and where the camera was."""

    frame: Frame
    owners: I4
    visible: F8
    table_from_camera: Pose
    sensor: str


class _Seen(NamedTuple):
    """An object in an image: by which sensor, how much of it, how well it was cut."""

    actor: _Actor
    sensor: str
    visible: float
    overlap: float


def simulate_views(world: World, numbers: Sequence[int], *, jobs: int = 1) -> Iterator[WorldView]:
    """Yield the views of some worlds, in order, whatever the number of jobs."""
    one = partial(simulate_world, world)
    if jobs <= 1:
        for number in numbers:
            yield from one(number)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for views in pool.map(one, numbers, chunksize=2):
            yield from views


def simulate_world(world: World, number: int) -> list[WorldView]:
    """Simulate one table, look at it from several places, and describe what is seen."""
    rng = np.random.default_rng((world.seed, number))
    actors, name = _populate(world, rng), f"{world.seed}/{number}"
    return look(actors, name, cameras=world.cameras, rng=rng, keep=world.keep)


def simulate_mesh(
    mesh: Mesh, label: str, name: str, rest: Rest, *, cameras: int, rng: np.random.Generator
) -> list[WorldView]:
    """Look at one given object, alone on the table, from several places."""
    actor = _Actor(moved(mesh, rest.pose), label, rest.manner, 0.0)
    return look([_placed(actor, (0.0, 0.0), 0.0, rng)], name, cameras=cameras, rng=rng)


def look(
    actors: Sequence[_Actor],
    name: str,
    *,
    cameras: int,
    rng: np.random.Generator,
    keep: bool = False,
) -> list[WorldView]:
    """Describe the objects on a table as seen from several places."""
    table = rounded_box(_TABLE_M)
    below = Pose(np.eye(3), np.array([0.0, 0.0, -_TABLE_M[2]]))
    seen = geometry([*((actor.mesh, IDENTITY) for actor in actors), (table, below)])
    views: list[WorldView] = []
    for _ in range(cameras):
        shot = _shoot(seen, actors, rng)
        scene = detect(shot.frame, up=None, settings=_SETTINGS.detection, rng=rng)
        for k, actor in enumerate(actors):
            if shot.visible[k] >= _LEAST_VISIBLE:
                views += _views_of(shot, scene, k, actor, f"{name}/{k}", rng)
    return views if keep else [view._replace(view=None) for view in views]


# --- the table ---------------------------------------------------------------------------------


def _populate(world: World, rng: np.random.Generator) -> list[_Actor]:
    """Put objects on the table: apart, close together, or one on another."""
    actors: list[_Actor] = []
    spots: list[tuple[float, float, float]] = []
    gap = float(rng.choice([0.003, 0.02, 0.08]))
    for _ in range(int(rng.integers(3, 10))):
        actor = _make(world, rng)
        if world.leaning > 0 and rng.random() < world.leaning:
            actor = _leant(actor, rng)
        radius = float(np.hypot(actor.mesh.vertices[:, 0], actor.mesh.vertices[:, 1]).max())
        spot = _free_spot(spots, radius + gap / 2, rng)
        if spot is None:
            continue
        spots.append((*spot, radius + gap / 2))
        actors.append(_placed(actor, spot, 0.0, rng))
        top = actor.mesh.extents
        if actor.label == "box" and top[:2].min() > 0.05 and rng.random() < 0.3:
            above = _make(world, rng)
            if np.all(above.mesh.extents[:2] < 1.3 * top[:2].min()):
                actors.append(_placed(above, spot, float(top[2]), rng))
    return actors


def _make(world: World, rng: np.random.Generator) -> _Actor:
    if rng.random() < world.unknown:
        _, mesh = make_distractor(rng, str(rng.choice(list(world.kinds))))
        return _rested(mesh, UNKNOWN, world, rng)
    label = str(rng.choice(list(CATEGORIES)))
    return _rested(make_object(label, rng), label, world, rng)


def _rested(mesh: Mesh, label: str, world: World, rng: np.random.Generator) -> _Actor:
    """Let an object lie as such objects do; upright where it cannot."""
    chances = dict(_MANNERS.get(label, {"upright": 1.0}))
    if world.lying is not None and label in _ROUND:
        chances["upright"] += chances["lying"] - world.lying
        chances["lying"] = world.lying
    manner = str(rng.choice(list(chances), p=list(chances.values())))
    rest = choose_rest(rests(mesh), manner, rng) if manner != "upright" else None
    if rest is None:
        return _Actor(standing(mesh), label, "upright", 0.0)
    return _Actor(moved(mesh, rest.pose), label, manner, 0.0)


def _leant(actor: _Actor, rng: np.random.Generator) -> _Actor:
    """Tilt an object by up to 25 degrees, as if it leant on something."""
    azimuth, half = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(5, 25)) / 2
    axis = np.sin(half) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    turn = Pose(rotation_from_quaternion(np.round([*axis, np.cos(half)], 9)), np.zeros(3))
    return actor._replace(mesh=standing(moved(actor.mesh, turn)), manner="leaning")


def _placed(
    actor: _Actor, spot: tuple[float, float], support_m: float, rng: np.random.Generator
) -> _Actor:
    pose = turn_about_z(IDENTITY, rng.uniform(0, 2 * np.pi), np.array([*spot, support_m]))
    return actor._replace(mesh=moved(actor.mesh, pose), support_m=support_m)


def _free_spot(
    spots: Sequence[tuple[float, float, float]], radius: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return a place of that radius near the middle of the table that nothing stands on."""
    for reach in np.repeat([0.08, 0.16, 0.26, 0.36], 4):
        x, y = rng.uniform(-reach, reach, 2)
        if all(np.hypot(x - u, y - v) > radius + other for u, v, other in spots):
            return float(x), float(y)
    return None


# --- the camera --------------------------------------------------------------------------------


def _shoot(seen: Geometry, actors: Sequence[_Actor], rng: np.random.Generator) -> _Shot:
    """Look at the table from somewhere with one of the sensors, better or worse than usual."""
    name, sensor = (("kinect", KINECT), ("realsense", REALSENSE))[rng.integers(2)]
    worse = float(rng.uniform(0.5, 1.3))
    sensor = replace(sensor, noise=sensor.noise * worse, wave=sensor.wave * worse)
    camera, pose = sensor.camera, _viewpoint(actors, rng)
    image = render(seen, camera, pose)
    depth, owners = measure(image, sensor, rng)
    visible = _visible_shares(seen, owners, camera, pose, len(actors))
    frame = Frame("/camera", 0, 0, 0, "camera", depth=depth, camera=camera)
    return _Shot(frame, owners, visible, pose, name)


def _viewpoint(actors: Sequence[_Actor], rng: np.random.Generator) -> Pose:
    """Return ``table_from_camera``: 0.45 to 1.9 m away, 15 to 65 degrees above the table."""
    points = np.concatenate([actor.mesh.vertices for actor in actors])
    target = points.mean(axis=0) + rng.normal(0, 0.04, 3)
    distance = float(np.exp(rng.uniform(np.log(0.45), np.log(1.9))))
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(15, 65))
    back = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    return looking_at(target + distance * back, target, roll=rng.normal(0, 0.05))


def _visible_shares(seen: Geometry, owners: I4, camera: Camera, pose: Pose, count: int) -> F8:
    """Return for each object which share of its pixels, in and out of the image, has readings."""
    seen_pixels = np.bincount(owners[owners >= 0], minlength=count + 1)
    width, height = camera.width // _COARSE, camera.height // _COARSE
    wide = Camera(
        2 * width,
        2 * height,
        camera.fx / _COARSE,
        camera.fy / _COARSE,
        camera.cx / _COARSE + width // 2,
        camera.cy / _COARSE + height // 2,
    )
    result = np.zeros(count)
    for k in range(count):
        mine = seen.owners == k
        alone = Geometry(seen.vertices, seen.triangles[mine], seen.owners[mine])
        total = int((render(alone, wide, pose).owners >= 0).sum()) * _COARSE**2
        if seen_pixels[k] >= _FEWEST_PIXELS:
            result[k] = min(1.0, seen_pixels[k] / max(total, 1))
    return result


# --- the views ---------------------------------------------------------------------------------


def _views_of(
    shot: _Shot, scene: Scene, k: int, actor: _Actor, instance: str, rng: np.random.Generator
) -> list[WorldView]:
    """Return one view of an object, cut by the truth or as detected, and maybe a piece of it."""
    found = _cut_by_detection(shot, scene, k)
    if found is not None and rng.random() < 0.6:
        (view, overlap), source = found, "detected"
    else:
        view, overlap = cut_halo(_cut_by_truth(shot, k, actor, rng), rng), 1.0
        source = "truth"
    view = View(view.points, view.eye, actor.label, instance)
    seen = _Seen(actor, shot.sensor, float(shot.visible[k]), overlap)
    described = [_described(view, source, seen, rng)]
    if rng.random() < _FRAGMENTS:
        piece = cut_fragment(view, rng)
        if piece is not None:
            described.append(_described(piece, "fragment", seen, rng))
    return [item for item in described if item is not None]


def _cut_by_detection(shot: _Shot, scene: Scene, k: int) -> tuple[View, float] | None:
    """Return the object as detection cuts it, and how well; None where it was not found."""
    owners = shot.owners.reshape(-1)
    valid = np.asarray(shot.frame.depth).reshape(-1) > 0
    total = int(np.count_nonzero((owners == k) & valid))
    for candidate in scene.candidates:
        hits = int(np.count_nonzero(owners[candidate.indices] == k))
        overlap = hits / (total + candidate.indices.size - hits)
        if overlap >= _OVERLAP:
            plane = scene.planes[candidate.plane or 0]
            points = shot.frame.xyz(candidate.indices)
            points = points[np.isfinite(points[:, 0])]
            level = level_from_sensor(scene.up, plane.offset + candidate.support_m, points)
            return View(transform(level, points), level.translation, "", ""), overlap
    return None


def _cut_by_truth(shot: _Shot, k: int, actor: _Actor, rng: np.random.Generator) -> View:
    """Return the object's pixels, level up to a degree and a few millimetres."""
    indices = np.flatnonzero((shot.owners == k) & (np.asarray(shot.frame.depth) > 0))
    points = shot.frame.xyz(indices)
    camera_from_table = inverse(shot.table_from_camera)
    up = camera_from_table.rotation[:, 2] + rng.normal(0, 0.008, 3)
    up /= np.linalg.norm(up)
    foot = np.array([*_centre(actor), actor.support_m])
    offset = float(up @ transform(camera_from_table, foot)) + rng.normal(0, 0.002)
    level = level_from_sensor(up, offset, points)
    return View(transform(level, points), level.translation, "", "")


def _centre(actor: _Actor) -> F8:
    points = actor.mesh.vertices[:, :2]
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _described(view: View, source: str, seen: _Seen, rng: np.random.Generator) -> WorldView | None:
    described = describe_view(view, settings=_SETTINGS, rng=rng)
    if described is None:
        return None
    return WorldView(
        descriptor=described.descriptor,
        label=seen.actor.label,
        instance=view.instance,
        points=described.points,
        distance=float(np.linalg.norm(view.points.mean(axis=0) - view.eye)),
        seconds=described.seconds,
        manner=seen.actor.manner,
        source=source,
        visible=seen.visible,
        overlap=seen.overlap,
        sensor=seen.sensor,
        functions=shape_functions(view.points, rng),
        view=replace(view, points=voxelize(view.points, voxel_m=_SETTINGS.surface.voxel_m)),
    )
