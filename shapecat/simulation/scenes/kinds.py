"""Random scenes of each kind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from shapecat.simulation.scenes.furniture import make_room, make_shelf, make_table, round_table
from shapecat.simulation.scenes.layout import SUPPORTING, Layout
from shapecat.simulation.scenes.moving import crossing, rearranged, walking
from shapecat.simulation.scenes.paths import Filming, arc_orbit, static_view
from shapecat.simulation.scenes.piles import bin_picking, pile, shelf_bin
from shapecat.simulation.scenes.rooms import room
from shapecat.simulation.scenes.rows import rows
from shapecat.simulation.scenes.worlds import World
from shapecat.types import CATEGORIES, UNKNOWN

__all__ = ["SCENES", "SceneKind", "make_scene"]

SceneKind = Literal[
    "tabletop",
    "shelf",
    "clutter",
    "pile",
    "bin",
    "shelf_bin",
    "room",
    "rows",
    "turntable",
    "walking",
    "crossing",
    "rearranged",
    "empty",
]


@dataclass(frozen=True)
class _SceneSpec:
    """Number of frames and frame rate of a scene, and the categories to draw from."""

    filming: Filming
    categories: tuple[str, ...]

    def draw(self, rng: Generator, count: int, *, unknown: int = 0) -> list[str]:
        """Draw the categories of ``count`` objects; append `UNKNOWN` ``unknown`` times.

        No category repeats before all have appeared.
        """
        first = [str(c) for c in rng.permutation(self.categories)]
        more = [str(c) for c in rng.choice(self.categories, max(0, count - len(first)))]
        return [*(first + more)[:count], *[UNKNOWN] * unknown]

    def draw_shuffled(self, rng: Generator) -> list[str]:
        """Draw the categories of 4 to 18 objects, one in six unknown, in random order."""
        count = int(rng.integers(4, 19))
        drawn = self.draw(rng, count - count // 6, unknown=count // 6)
        return [str(category) for category in rng.permutation(drawn)]


def make_scene(
    kind: SceneKind,
    rng: Generator,
    *,
    frames: int = 90,
    rate_hz: float = 30.0,
    categories: Sequence[str] = CATEGORIES,
) -> World:
    """Make a random scene and a camera path through it.

    Parameters
    ----------
    frames, rate_hz : number of frames, and frames per second; the objects do not depend on them.
    categories : categories to draw from; none is drawn twice before all have been drawn. Some
        scenes add distractors, or moving objects of other categories.

    Raises
    ------
    ValueError : the kind of scene does not exist.
    """
    if kind not in SCENES:
        msg = f"no scene {kind!r}; known: {', '.join(SCENES)}"
        raise ValueError(msg)
    return SCENES[kind](rng, _SceneSpec(Filming(frames, rate_hz), tuple(categories)))


def _tabletop(rng: Generator, spec: _SceneSpec) -> World:
    """Place up to ten objects, with gaps, on a table: one of each category first."""
    room, table = make_room(rng, wall_chance=0.3), make_table(rng)
    layout = Layout(rng, gap=rng.uniform(0.015, 0.05))
    count = int(rng.integers(min(max(6, len(spec.categories)), 10), 11))
    for category in spec.draw(rng, count):
        layout.put(category, table, np.array([0.38, 0.27]), stack=0.06)
    target = np.array([0, 0, table.height + 0.05])
    path = arc_orbit(
        rng, target, spec.filming, distance=(0.9, 1.4), elevation=(28, 52), sweep=(25, 60)
    )
    return World("tabletop", (*room, table), tuple(layout.objects), path)


def _clutter(rng: Generator, spec: _SceneSpec) -> World:
    """Crowd a table with objects that nearly touch, are stacked, and occlude each other."""
    room, table = make_room(rng, wall_chance=0.2), make_table(rng)
    layout = Layout(rng, gap=0.01)
    half = rng.uniform([0.2, 0.16], [0.32, 0.24])
    categories = spec.draw(rng, int(rng.integers(7, 13)), unknown=int(rng.integers(0, 3)))
    categories.sort(key=lambda category: category not in SUPPORTING)
    for category in categories:
        layout.gap = float(rng.choice([0.002, 0.008, 0.02]))
        layout.put(category, table, half, stack=0.3, attempts=4)
    target = np.array([0, 0, table.height + 0.06])
    path = arc_orbit(
        rng, target, spec.filming, distance=(0.65, 1.3), elevation=(25, 58), sweep=(20, 50)
    )
    return World("clutter", (*room, table), tuple(layout.objects), path)


def _shelf(rng: Generator, spec: _SceneSpec) -> World:
    """Place about twelve objects on three boards of a shelf, some of them stacked."""
    width, depth = rng.uniform(0.85, 1.15), rng.uniform(0.3, 0.42)
    low, step = rng.uniform(0.25, 0.4), rng.uniform(0.33, 0.42)
    boards, sides = make_shelf(width, depth, low, step)
    layout = Layout(rng, gap=0.015, headroom=step - 0.05, enclosed=True)
    half = np.array([width / 2 - 0.06, depth / 2 - 0.03])
    for k, category in enumerate(spec.draw(rng, 12, unknown=int(rng.integers(0, 2)))):
        layout.put(category, boards[k % 3], half, stack=0.5 if k > 5 else 0.0, attempts=8)
    target = np.array([0, 0, low + 1.15 * step])
    path = arc_orbit(
        rng, target, spec.filming, distance=(1.25, 1.55), elevation=(20, 30), sweep=(12, 28)
    )
    supports = (*make_room(rng, wall_chance=0.0), *boards, *sides)
    return World("shelf", supports, tuple(layout.objects), path)


def _turntable(rng: Generator, spec: _SceneSpec) -> World:
    """Rotate a round table with objects in front of a static camera."""
    room = make_room(rng, wall_chance=0.3)
    table = round_table(rng.uniform(0.38, 0.48), rng.uniform(0.65, 0.85), 0.03)
    layout = Layout(rng, gap=0.03)
    for category in spec.draw(rng, int(rng.integers(5, 9))):
        layout.put(category, table, np.array([0.3, 0.3]), attempts=4)
    target = np.array([0, 0, table.height + 0.04])
    path = static_view(rng, target, spec.filming.frames)
    speed = rng.choice([-1, 1]) * rng.uniform(0.25, 0.5)  # radians per second
    turns = np.round(speed * spec.filming.times(), 9)
    return World("turntable", (*room, table), tuple(layout.objects), path, turns)


def _empty(rng: Generator, spec: _SceneSpec) -> World:
    """Return a scene with a table and no objects."""
    room, table = make_room(rng, wall_chance=0.5), make_table(rng)
    target = np.array([0, 0, table.height])
    path = arc_orbit(
        rng, target, spec.filming, distance=(0.8, 1.5), elevation=(25, 60), sweep=(10, 50)
    )
    return World("empty", (*room, table), (), path)


SCENES: dict[str, Callable[[Generator, _SceneSpec], World]] = {
    "tabletop": _tabletop,
    "shelf": _shelf,
    "clutter": _clutter,
    "pile": lambda rng, spec: pile(rng, spec.draw_shuffled(rng), spec.filming),
    "bin": lambda rng, spec: bin_picking(rng, spec.draw_shuffled(rng), spec.filming),
    "shelf_bin": lambda rng, spec: shelf_bin(rng, spec.draw_shuffled(rng), spec.filming),
    "room": lambda rng, spec: room(rng, spec.draw(rng, 7), spec.filming),
    "rows": lambda rng, spec: rows(rng, spec.draw(rng, 7), spec.filming),
    "turntable": _turntable,
    "walking": lambda rng, spec: walking(rng, spec.draw(rng, 11), spec.filming),
    "crossing": lambda rng, spec: crossing(rng, spec.draw(rng, 7), spec.filming),
    "rearranged": lambda rng, spec: rearranged(rng, spec.draw(rng, 8), spec.filming),
    "empty": _empty,
}
"""For each kind of scene, the function that makes a random one."""
