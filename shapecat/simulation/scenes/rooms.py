"""Rooms: a table with objects among robot arms, people, screens, chairs, walls and curtains."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.scenes.equipment import (
    make_arm,
    make_cable,
    make_chair,
    make_curtain,
    make_forearm,
    make_keyboard,
    make_laptop,
    make_monitor,
    make_plant,
)
from shapecat.simulation.scenes.furniture import as_equipment, make_room, make_table, make_wall
from shapecat.simulation.scenes.paths import Filming, arc_orbit
from shapecat.simulation.scenes.physics import Drop
from shapecat.simulation.scenes.piles import Item, make_item, settled
from shapecat.simulation.scenes.worlds import Support, World, pose_from_yaw
from shapecat.simulation.shapes.distractors import KINDS
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.types import UNKNOWN

__all__ = ["room"]

_DEVICES = {"laptop": make_laptop, "keyboard": make_keyboard, "plant": make_plant}
"""Functions that make large objects on the table, outside the categories, by name."""


def room(
    rng: Generator, categories: Sequence[str], filming: Filming, *, kinds: Sequence[str] = KINDS
) -> World:
    """Return a scene of a table with objects among equipment; the parameters are as for `pile`."""
    supports = [*make_room(rng, wall_chance=0.7), make_table(rng)]
    table = supports[-1]
    supports += _walls(rng)
    standing = [*_arms(rng, table), *_screens(rng, table)]
    around = [*_surroundings(rng), *_cables(rng, table)]
    drops, items = [], [make_item(category, rng, kinds) for category in categories]
    items += [
        Item(UNKNOWN, name, make(rng)) for name, make in _DEVICES.items() if rng.random() < 0.35
    ]
    half = np.ptp(table.outline[:, :2], axis=0) / 2
    for item in items:
        margin = float(item.mesh.extents[:2].max()) / 2
        place = rng.uniform(-1, 1, 2) * np.clip(half - margin, 0.02, (0.45, 0.3))
        drops.append(Drop(item.mesh, pose_from_yaw(rng.uniform(-0.6, 0.6)).rotation, place))
    solid = (table, *as_equipment("robot", standing))
    objects = settled(items, drops, solid, table)
    target = np.array([0, 0, table.height + rng.uniform(0.0, 0.2)])
    path = arc_orbit(rng, target, filming, distance=(0.7, 2.2), elevation=(12, 60), sweep=(15, 60))
    other_supports = [s for s in supports if s is not table]
    everything = (*other_supports, *solid, *as_equipment("room", around))
    return World("room", everything, objects, path)


def _walls(rng: Generator) -> Iterator[Support]:
    """Yield walls and cupboards beside the table."""
    for side in (-1, 1):
        if rng.random() < 0.35:
            distance = side * rng.uniform(1.0, 1.9)
            yield make_wall(f"wall_{side}", (0.1, 6.0, 2.6), (distance, 0.0))
        elif rng.random() < 0.3:
            size = (rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.5, 1.9))
            place = (side * rng.uniform(1.1, 1.6), rng.uniform(0, 0.7))
            yield make_wall(f"cupboard_{side}", size, place)


def _arms(rng: Generator, table: Support) -> Iterator[Mesh]:
    """Yield the parts of a robot arm, a person's arm, both or none, which reach over the table."""
    top = table.height
    if rng.random() < 0.75:
        beside = rng.choice([-1, 1]) * rng.uniform(0.35, 0.6)
        base = np.array([beside, rng.uniform(-0.2, 0.4), top])
        tip = np.array([*rng.uniform(-0.2, 0.2, 2), top + rng.uniform(0.08, 0.35)])
        yield from make_arm(rng, base, tip)
    if rng.random() < 0.3:
        tip = np.array([*rng.uniform(-0.25, 0.25, 2), top + rng.uniform(0.06, 0.25)])
        beside = rng.choice([-1, 1]) * rng.uniform(0.6, 0.9)
        start = np.array([beside, -0.3, top + rng.uniform(0.1, 0.3)])
        yield from make_forearm(rng, tip, start)


def _screens(rng: Generator, table: Support) -> Iterator[Mesh]:
    if rng.random() < 0.4:
        back = float(table.outline[:, 1].max()) - 0.15
        place = [rng.uniform(-0.35, 0.35), back, table.height]
        yield from make_monitor(rng, place, degrees=rng.normal(0, 12))


def _surroundings(rng: Generator) -> Iterator[Mesh]:
    """Yield chairs, curtains and plants around the table."""
    for _ in range(int(rng.integers(0, 3))):
        place = _position_beside_table(rng)
        yield from make_chair(rng, place, degrees=float(np.degrees(np.arctan2(*place[:2]))))
    if rng.random() < 0.35:
        hung = [rng.uniform(-0.5, 0.5), rng.uniform(0.8, 1.4), 0.1]
        yield make_curtain(rng, rng.uniform(0.6, 2.0), hung)
    if rng.random() < 0.3:
        plant = make_plant(rng)
        shift = _position_beside_table(rng).astype(np.float32)
        yield Mesh(plant.vertices * np.float32(2.5) + shift, plant.triangles)


def _position_beside_table(rng: Generator) -> F8:
    """Return a position (3,) on the floor beside or behind the table."""
    angle = rng.uniform(0.0, np.pi)
    return rng.uniform(0.95, 1.5) * np.array([np.cos(angle), np.sin(angle), 0.0])


def _cables(rng: Generator, table: Support) -> Iterator[Mesh]:
    for _ in range(int(rng.integers(0, 3))):
        ends = np.full((2, 3), table.height + 0.004)
        ends[:, 0] = rng.uniform(-0.45, 0.45, 2)
        ends[:, 1] = rng.choice([-1, 1]) * rng.uniform(0.2, 0.33, 2)
        yield make_cable(rng, ends)
