"""Arrangements of objects for training: on a table, in a pile, a bin, a shelf or a room."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shapecat.geometry import rotation_from_quaternion
from shapecat.simulation.scenes.paths import Filming
from shapecat.simulation.scenes.piles import bin_picking, pile, shelf_bin
from shapecat.simulation.scenes.rooms import room
from shapecat.simulation.scenes.worlds import PlacedObject, World, pose_from_yaw
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.distractors import make_distractor
from shapecat.simulation.shapes.mesh import Mesh, moved, scaled, standing
from shapecat.simulation.shapes.primitives import rounded_box
from shapecat.simulation.shapes.stable_poses import choose_stable_pose
from shapecat.types import CATEGORIES, UNKNOWN, Pose

__all__ = ["BARE_TABLE", "ArrangedObject", "Arrangement", "ArrangementOptions", "arrange", "placed"]

_TABLE_M = (1.6, 1.2, 0.03)
"""Size of the table top in x, y and z."""
_RESTING_POSES = {
    "cup": {"upright": 0.78, "lying": 0.12, "upside_down": 0.1},
    "can": {"upright": 0.8, "lying": 0.2},
    "bottle": {"upright": 0.8, "lying": 0.2},
    "bowl": {"upright": 0.92, "upside_down": 0.08},
    "plate": {"upright": 0.95, "upside_down": 0.05},
    "box": {"upright": 0.5, "lying": 0.5},
    UNKNOWN: {"upright": 0.7, "lying": 0.3},
}
"""Probabilities of the resting poses of each category; others are always upright."""
_ROUND = {"cup", "can", "bottle"}
"""Categories to which `ArrangementOptions.lying` applies."""
_RESIZED = 0.3
"""Fraction of the tables on which one factor, in the range `_SIZES`, scales all objects."""
_SIZES = (0.55, 1.5)


@dataclass(frozen=True)
class ArrangementOptions:
    """Parameters of simulated arrangements.

    Attributes
    ----------
    seed : seed of all arrangements.
    kinds : kinds of distractors to choose from.
    unknown : fraction of the objects that are distractors.
    lying : fraction of cups, cans and bottles that lie; None for the default. Lying objects are
        harder, so training uses more of them.
    leaning : fraction of the objects on tables that are tilted, as if they leaned on something.
    settled : fraction of the arrangements made by physics: piles, bins, crowded compartments,
        tables in rooms.
    cameras : number of images of each arrangement.
    background : whether to add thin detections of furniture and noise as views of ``unknown``.
    """

    seed: int
    kinds: tuple[str, ...]
    unknown: float = 0.17
    lying: float | None = None
    leaning: float = 0.0
    settled: float = 0.0
    cameras: int = 4
    background: bool = False


class ArrangedObject(NamedTuple):
    """An object of an arrangement.

    Attributes
    ----------
    mesh : metres, in the frame of the arrangement.
    label : category, or ``unknown``.
    resting_pose : ``upright``, ``upside_down``, ``lying``, ``leaning`` or ``tilted``.
    support_m : height of the supporting surface, metres; for dropped objects, of the lowest vertex.
    """

    mesh: Mesh
    label: str
    resting_pose: str
    support_m: float


class Arrangement(NamedTuple):
    """Objects and furniture on a supporting surface at z = 0, and a range of viewpoints.

    ``elevation`` and ``azimuth`` are ranges in degrees; the open side of a shelf is at azimuth -90.
    """

    objects: list[ArrangedObject]
    furniture: tuple[Mesh, ...]
    elevation: tuple[float, float] = (8.0, 80.0)
    azimuth: tuple[float, float] = (-180.0, 180.0)


BARE_TABLE = moved(rounded_box(_TABLE_M), Pose(np.eye(3), np.array([0.0, 0.0, -_TABLE_M[2]])))
"""The furniture of a scene with nothing but a table: its top, with the upper face at z = 0."""
_SETTLED: tuple[tuple[Callable[..., World], float, Arrangement], ...] = (
    (pile, 0.5, Arrangement([], (), (8.0, 90.0))),
    (bin_picking, 0.15, Arrangement([], (), (50.0, 90.0))),
    (shelf_bin, 0.15, Arrangement([], (), (5.0, 35.0), (-120.0, -60.0))),
    (room, 0.2, Arrangement([], (), (8.0, 80.0))),
)
"""Scenes arranged by physics, with their probabilities and their ranges of viewpoints."""


def arrange(options: ArrangementOptions, rng: np.random.Generator) -> Arrangement:
    """Place random objects on a table, or drop them in a physics simulation."""
    if options.settled > 0 and rng.random() < options.settled:
        return _drop_objects(options, rng)
    return Arrangement(_place_on_table(options, rng), (BARE_TABLE,))


def _drop_objects(options: ArrangementOptions, rng: np.random.Generator) -> Arrangement:
    """Drop 4 to 18 objects into a pile, a bin, a shelf compartment, or a room."""
    chosen = int(rng.choice(len(_SETTLED), p=[share for _, share, _ in _SETTLED]))
    make, _, seen_from = _SETTLED[chosen]
    names = rng.choice(CATEGORIES, int(rng.integers(4, 19)))
    names = np.where(rng.random(names.size) < options.unknown, UNKNOWN, names)
    scene = make(rng, names.tolist(), Filming(1, 30.0), kinds=options.kinds)
    supports = {support.name: support for support in scene.supports}
    support_name = next((t.on_support for t in scene.objects if t.on_support is not None), "floor")
    down = Pose(np.eye(3), np.array([0.0, 0.0, -supports[support_name].height]))
    furniture = tuple(moved(support.mesh, down) for support in scene.supports)
    return seen_from._replace(
        objects=[_arranged_object(item, down) for item in scene.objects], furniture=furniture
    )


def _arranged_object(item: PlacedObject, down: Pose) -> ArrangedObject:
    mesh = moved(moved(item.mesh, item.pose), down)
    names = ("upside_down", "lying", "tilted")
    resting_pose = next((name for name in names if getattr(item, name)), "upright")
    return ArrangedObject(mesh, item.category, resting_pose, float(mesh.vertices[:, 2].min()))


def _place_on_table(options: ArrangementOptions, rng: np.random.Generator) -> list[ArrangedObject]:
    """Place objects on the table: apart, close together, or stacked."""
    objects: list[ArrangedObject] = []
    spots: list[tuple[float, float, float]] = []
    gap = float(rng.choice([0.003, 0.02, 0.08]))
    size = float(np.exp(rng.uniform(*np.log(_SIZES)))) if rng.random() < _RESIZED else 1.0
    for _ in range(int(rng.integers(3, 10))):
        item = _make(options, rng, size)
        if options.leaning > 0 and rng.random() < options.leaning:
            item = _tilted(item, rng)
        radius = float(np.hypot(item.mesh.vertices[:, 0], item.mesh.vertices[:, 1]).max())
        spot = _free_spot(spots, radius + gap / 2, rng)
        if spot is None:
            continue
        spots.append((*spot, radius + gap / 2))
        objects.append(placed(item, spot, 0.0, rng))
        top = item.mesh.extents
        if item.label == "box" and top[:2].min() > 0.05 and rng.random() < 0.3:
            above = _make(options, rng, size)
            if np.all(above.mesh.extents[:2] < 1.3 * top[:2].min()):
                objects.append(placed(above, spot, float(top[2]), rng))
    return objects


def _make(options: ArrangementOptions, rng: np.random.Generator, size: float) -> ArrangedObject:
    """Make a random object or distractor, scaled by ``size``."""
    if rng.random() < options.unknown:
        _, mesh = make_distractor(rng, options.kinds)
        return _at_rest(scaled(mesh, size), UNKNOWN, options, rng)
    label = str(rng.choice(list(CATEGORIES)))
    return _at_rest(scaled(make_object(label, rng), size), label, options, rng)


def _at_rest(
    mesh: Mesh, label: str, options: ArrangementOptions, rng: np.random.Generator
) -> ArrangedObject:
    """Put a mesh into a random resting pose; upright if it has no stable pose of that kind.

    ``label`` is its category, on which the probabilities of the poses depend.
    """
    chances = dict(_RESTING_POSES.get(label, {"upright": 1.0}))
    if options.lying is not None and label in _ROUND:
        chances["upright"] += chances["lying"] - options.lying
        chances["lying"] = options.lying
    resting_pose = str(rng.choice(list(chances), p=list(chances.values())))
    stable = None
    if resting_pose != "upright":
        stable = choose_stable_pose(mesh, resting_pose, rng)
    if stable is None:
        return ArrangedObject(standing(mesh), label, "upright", 0.0)
    return ArrangedObject(moved(mesh, stable.pose), label, resting_pose, 0.0)


def _tilted(item: ArrangedObject, rng: np.random.Generator) -> ArrangedObject:
    """Tilt an object by 5 to 25 degrees, as if it leaned on something."""
    azimuth, half = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(5, 25)) / 2
    axis = np.sin(half) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    turn = Pose(rotation_from_quaternion(np.round([*axis, np.cos(half)], 9)), np.zeros(3))
    return item._replace(mesh=standing(moved(item.mesh, turn)), resting_pose="leaning")


def placed(
    item: ArrangedObject, spot: tuple[float, float], support_m: float, rng: np.random.Generator
) -> ArrangedObject:
    """Turn an object randomly about z and place it on a support at ``spot`` (x, y), metres.

    ``support_m`` is the height of the support.
    """
    pose = pose_from_yaw(rng.uniform(0, 2 * np.pi), [*spot, support_m])
    return item._replace(mesh=moved(item.mesh, pose), support_m=support_m)


def _free_spot(
    spots: Sequence[tuple[float, float, float]], radius: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return a position (x, y) near the middle of the table, free within ``radius``; or None.

    ``spots`` holds the (x, y, radius) of the objects placed so far, in metres.
    """
    for half_width in np.repeat([0.08, 0.16, 0.26, 0.36], 4):
        x, y = rng.uniform(-half_width, half_width, 2)
        if all(np.hypot(x - u, y - v) > radius + other for u, v, other in spots):
            return float(x), float(y)
    return None
