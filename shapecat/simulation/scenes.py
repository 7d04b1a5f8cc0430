"""Random scenes: tables, shelves, clutter, a turntable."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.distractors import make_distractor
from shapecat.simulation.footprints import Footprint, footprint, inside, overlap
from shapecat.simulation.mesh import Mesh, extrude, moved, rounded_box
from shapecat.simulation.paths import hold, walk
from shapecat.simulation.placement import Rest, choose_rest, rests, turn_about_z
from shapecat.simulation.shapes import make_object
from shapecat.simulation.worlds import Support, Thing, World
from shapecat.types import CATEGORIES, Pose

__all__ = ["SCENES", "SceneKind", "make_scene", "resting_thing"]

SceneKind = Literal["tabletop", "shelf", "clutter", "turntable", "empty"]

LYING = {"can": 0.2, "bottle": 0.22, "cup": 0.12, "box": 0.7}
"""How often things of a category lie; a box lies on any of its faces."""
UPSIDE_DOWN = {"cup": 0.06, "bowl": 0.06, "plate": 0.03}
"""How often open things stand on their rim."""


def make_scene(
    kind: SceneKind,
    rng: Generator,
    *,
    frames: int = 90,
    rate_hz: float = 30.0,
    categories: Sequence[str] = CATEGORIES,
    distractors: int | None = None,
) -> World:
    """Make a random scene and the way a camera takes through it.

    Parameters
    ----------
    categories : those that appear; each at least once where there is room.
    distractors : things of no category; by default none on a tabletop, a few elsewhere.

    Raises
    ------
    ValueError : there is no such kind of scene.
    """
    if kind not in SCENES:
        msg = f"no scene {kind!r}; known: {', '.join(SCENES)}"
        raise ValueError(msg)
    return SCENES[kind](rng, frames, rate_hz, tuple(categories), distractors)


def resting_thing(
    category: str, rng: Generator, *, manner: str | None = None
) -> tuple[str, Mesh, Rest]:
    """Make a thing and a way it rests: its kind, its mesh, its rest.

    Parameters
    ----------
    category : ``unknown`` is a distractor.
    manner : ``upright``, ``lying`` or ``upside_down``; drawn by default.
    """
    kind, mesh = (
        make_distractor(rng)
        if category == "unknown"
        else (
            category,
            make_object(category, rng),
        )
    )
    upright = Rest(Pose(np.eye(3), np.zeros(3)), "upright")
    if category in {"ball", "unknown"}:
        return kind, mesh, upright
    wanted = manner or _draw_manner(category, rng)
    if wanted == "upright":
        return kind, mesh, upright
    return kind, mesh, choose_rest(rests(mesh), wanted, rng) or upright


def _draw_manner(category: str, rng: Generator) -> str:
    luck = rng.random()
    over = UPSIDE_DOWN.get(category, 0.0)
    if luck < over:
        return "upside_down"
    return "lying" if luck < over + LYING.get(category, 0.0) else "upright"


class _Layout:
    """Things being placed on supports, none in another."""

    def __init__(self, rng: Generator) -> None:
        self.rng = rng
        self.things: list[Thing] = []
        self.places: list[Footprint] = []

    def put(
        self,
        category: str,
        support: Support,
        area: F8,
        *,
        gap: float,
        headroom: float = 1.0,
        stack: float = 0.0,
        enclosed: bool = False,
        tries: int = 60,
    ) -> bool:
        """Try to place a new thing: on another one with chance ``stack``, else in ``area``.

        ``area`` is (2, 2): low and high corner on the support, metres, world frame. Between walls
        (``enclosed``) nothing may stick out over the edge.
        """
        kind, mesh, rest = resting_thing(category, self.rng)
        print_ = footprint(mesh, rest.pose)
        if print_.high - print_.low > headroom or np.ptp(print_.outline, axis=0).max() > 0.42:
            return False
        if self.rng.random() < stack and self._on_top(kind, category, mesh, rest, headroom, gap):
            return True
        for _ in range(tries):
            place = np.array([*self.rng.uniform(area[0], area[1]), support.height])
            pose = turn_about_z(rest.pose, self.rng.uniform(0, 2 * np.pi), np.round(place, 6))
            here = footprint(mesh, pose)
            reach = here.outline if enclosed else here.contact
            fits = inside(reach, support.outline[:, :2], 0.01)
            if fits and self._is_free(here, gap):
                self._add(kind, category, mesh, rest, pose, here, support.name, None)
                return True
        return False

    def _on_top(
        self, kind: str, category: str, mesh: Mesh, rest: Rest, headroom: float, gap: float
    ) -> bool:
        bearers = [
            k
            for k, t in enumerate(self.things)
            if t.category in {"box", "can"} and _flat_top(self.places[k])
        ]
        if not bearers or category == "ball":
            return False
        for _ in range(8):
            k = bearers[int(self.rng.integers(len(bearers)))]
            below = self.places[k]
            middle = below.top.mean(axis=0)
            slack = 0.25 * np.ptp(below.top, axis=0)
            spot = [*(middle + self.rng.uniform(-slack, slack)), below.high]
            pose = turn_about_z(rest.pose, self.rng.uniform(0, 2 * np.pi), np.round(spot, 6))
            here = footprint(mesh, pose)
            base = self._ground(k)
            low_enough = here.high - self.places[base].low < headroom
            if low_enough and _bears(below, here) and self._is_free(here, gap):
                self._add(kind, category, mesh, rest, pose, here, None, self.things[k].track)
                return True
        return False

    def _is_free(self, here: Footprint, gap: float) -> bool:
        beside = [p for p in self.places if p.low < here.high and p.high > here.low + 1e-6]
        return not any(overlap(here.outline, p.outline, gap) for p in beside)

    def _ground(self, k: int) -> int:
        on = self.things[k].on_track
        return k if on is None else self._ground(on)

    def _add(
        self,
        kind: str,
        category: str,
        mesh: Mesh,
        rest: Rest,
        pose: Pose,
        here: Footprint,
        support: str | None,
        bearer: int | None,
    ) -> None:
        manner = rest.manner
        if category == "box":  # it has no upright
            manner = "upright"
        self.things.append(
            Thing(
                len(self.things),
                category,
                kind,
                mesh,
                pose,
                support,
                bearer,
                lying=manner == "lying",
                upside_down=manner == "upside_down",
            )
        )
        self.places.append(here)


def _flat_top(place: Footprint) -> bool:
    return len(place.top) > 2 and float(np.ptp(place.top, axis=0).min()) > 0.035


def _bears(below: Footprint, above: Footprint) -> bool:
    """Tell whether a thing's weight and most of its contact lie on the top below."""
    middle = above.contact.mean(axis=0)
    core = middle + 0.6 * (above.contact - middle)
    return inside(core, below.top, 0.002)


def _wanted(rng: Generator, categories: tuple[str, ...], count: int, unknown: int) -> list[str]:
    """Return categories for ``count`` things: each once, then any; then the distractors."""
    first = list(rng.permutation(categories))
    more = list(rng.choice(categories, max(0, count - len(first))))
    return [*(first + more)[:count], *["unknown"] * unknown]


def _slab(name: str, label: int, size: Sequence[float], top_middle: Sequence[float]) -> Support:
    """Return a level board; ``top_middle`` is the centre of its upper face."""
    x, y, z = top_middle
    mesh = moved(rounded_box(size, fine=1), Pose(np.eye(3), np.array([x, y, z - size[2]])))
    a, b = size[0] / 2, size[1] / 2
    corners = [[x - a, y - b, z], [x + a, y - b, z], [x + a, y + b, z], [x - a, y + b, z]]
    return Support(name, label, mesh, np.array(corners))


def _disc(name: str, label: int, radius: float, height: float, thick: float) -> Support:
    t = np.arange(48) * (2 * np.pi / 48)
    ring = np.stack([radius * np.cos(t), radius * np.sin(t)], -1)
    mesh = moved(extrude(ring, thick), Pose(np.eye(3), np.array([0, 0, height - thick])))
    return Support(name, label, mesh, np.column_stack([ring, np.full(48, height)]))


def _wall(name: str, label: int, size: Sequence[float], middle: Sequence[float]) -> Support:
    mesh = rounded_box(size, fine=1)
    shift = np.array([middle[0], middle[1], middle[2] - size[2] / 2])
    return Support(name, label, moved(mesh, Pose(np.eye(3), shift)), np.zeros((0, 3)))


def _room(rng: Generator, *, wall_chance: float) -> list[Support]:
    floor = _slab("floor", 1, (8.0, 8.0, 0.05), (0, 0, 0))
    if rng.random() >= wall_chance:
        return [floor]
    return [floor, _wall("wall", 9, (8.0, 0.1, 2.6), (0, rng.uniform(0.8, 1.6), 1.3))]


def _table(rng: Generator) -> Support:
    height, thick = rng.uniform(0.6, 0.9), rng.uniform(0.018, 0.04)
    if rng.random() < 0.2:
        return _disc("table", 2, rng.uniform(0.5, 0.7), height, thick)
    size = (rng.uniform(1.1, 1.8), rng.uniform(0.75, 1.0), thick)
    return _slab("table", 2, size, (0, 0, height))


def _tabletop(
    rng: Generator, frames: int, rate: float, categories: tuple[str, ...], distractors: int | None
) -> World:
    room, table = _room(rng, wall_chance=0.3), _table(rng)
    layout = _Layout(rng)
    area = np.array([[-0.38, -0.27], [0.38, 0.27]])
    count = int(rng.integers(max(6, len(categories)), 11))
    for category in _wanted(rng, categories, count, distractors or 0):
        for _ in range(6):
            if layout.put(category, table, area, gap=rng.uniform(0.015, 0.05), stack=0.06):
                break
    target = np.array([0, 0, table.height + 0.05])
    path = walk(
        rng,
        target,
        frames,
        rate,
        distance=rng.uniform(0.9, 1.4),
        elevation=rng.uniform(28, 52),
        sweep=rng.uniform(25, 60),
    )
    return World("tabletop", (*room, table), tuple(layout.things), path, np.zeros(frames))


def _clutter(
    rng: Generator, frames: int, rate: float, categories: tuple[str, ...], distractors: int | None
) -> World:
    room, table = _room(rng, wall_chance=0.2), _table(rng)
    layout = _Layout(rng)
    half = rng.uniform([0.2, 0.16], [0.32, 0.24])
    area = np.array([-half, half])
    count = int(rng.integers(7, 13))
    unknown = int(rng.integers(0, 3)) if distractors is None else distractors
    wanted = _wanted(rng, categories, count, unknown)
    wanted.sort(key=lambda c: c not in {"box", "can"})  # bearers first
    for category in wanted:
        for _ in range(4):
            gap = float(rng.choice([0.002, 0.008, 0.02]))
            if layout.put(category, table, area, gap=gap, stack=0.3):
                break
    target = np.array([0, 0, table.height + 0.06])
    path = walk(
        rng,
        target,
        frames,
        rate,
        distance=rng.uniform(0.65, 1.3),
        elevation=rng.uniform(25, 58),
        sweep=rng.uniform(20, 50),
    )
    return World("clutter", (*room, table), tuple(layout.things), path, np.zeros(frames))


def _shelf(
    rng: Generator, frames: int, rate: float, categories: tuple[str, ...], distractors: int | None
) -> World:
    width, depth = rng.uniform(0.85, 1.15), rng.uniform(0.3, 0.42)
    low, step, thick = rng.uniform(0.25, 0.4), rng.uniform(0.33, 0.42), 0.02
    boards = [
        _slab(f"board_{k + 1}", 2 + k, (width, depth, thick), (0, 0, low + k * step))
        for k in range(3)
    ]
    top = low + 3 * step
    sides = [
        _wall(f"side_{k}", 7, (thick, depth, top), (s * (width / 2 + thick / 2), 0, top / 2))
        for k, s in enumerate((-1, 1))
    ]
    back = _wall("back", 8, (width + 2 * thick, thick, top), (0, depth / 2 + thick / 2, top / 2))
    layout = _Layout(rng)
    unknown = int(rng.integers(0, 2)) if distractors is None else distractors
    half = np.array([width / 2 - 0.06, depth / 2 - 0.03])
    room = step - thick - 0.03
    for k, category in enumerate(_wanted(rng, categories, 12, unknown)):
        board = boards[k % 3]
        for _ in range(8):
            stack = 0.25 if k > 5 else 0.0
            if layout.put(
                category, board, np.array([-half, half]), gap=0.015, headroom=room, stack=stack
            ):
                break
    target = np.array([0, 0, low + 1.15 * step])
    path = walk(
        rng,
        target,
        frames,
        rate,
        distance=rng.uniform(1.25, 1.55),
        elevation=rng.uniform(20, 30),
        sweep=rng.uniform(12, 28),
    )
    floor = _room(rng, wall_chance=0.0)
    return World(
        "shelf", (*floor, *boards, *sides, back), tuple(layout.things), path, np.zeros(frames)
    )


def _turntable(
    rng: Generator, frames: int, rate: float, categories: tuple[str, ...], distractors: int | None
) -> World:
    room = _room(rng, wall_chance=0.3)
    table = _disc("table", 2, rng.uniform(0.38, 0.48), rng.uniform(0.65, 0.85), 0.03)
    layout = _Layout(rng)
    area = np.array([[-0.3, -0.3], [0.3, 0.3]])
    for category in _wanted(rng, categories, int(rng.integers(5, 9)), distractors or 0):
        for _ in range(4):
            if layout.put(category, table, area, gap=0.03):
                break
    target = np.array([0, 0, table.height + 0.04])
    path = hold(rng, target, frames, distance=rng.uniform(0.9, 1.2), elevation=rng.uniform(28, 48))
    speed = rng.choice([-1, 1]) * rng.uniform(0.25, 0.5)
    turns = np.round(speed / rate * np.arange(frames), 9)
    return World("turntable", (*room, table), tuple(layout.things), path, turns)


def _empty(
    rng: Generator, frames: int, rate: float, categories: tuple[str, ...], distractors: int | None
) -> World:
    del categories, distractors
    room, table = _room(rng, wall_chance=0.5), _table(rng)
    target = np.array([0, 0, table.height])
    path = walk(
        rng,
        target,
        frames,
        rate,
        distance=rng.uniform(0.8, 1.5),
        elevation=rng.uniform(25, 60),
        sweep=rng.uniform(10, 50),
    )
    return World("empty", (*room, table), (), path, np.zeros(frames))


SCENES = {
    "tabletop": _tabletop,
    "shelf": _shelf,
    "clutter": _clutter,
    "turntable": _turntable,
    "empty": _empty,
}
"""The kinds of scenes."""
