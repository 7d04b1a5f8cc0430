"""Scenes with moving, added and removed objects, or with a camera that passes a long counter."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.scenes.furniture import make_counter, make_room, make_table
from shapecat.simulation.scenes.layout import Layout
from shapecat.simulation.scenes.paths import Filming, arc_orbit, lateral_pass
from shapecat.simulation.scenes.worlds import Support, World
from shapecat.types import Pose

__all__ = ["crossing", "rearranged", "walking"]

_ANYWHERE = np.array([0.6, 0.3])
"""Half the size in x and y of an area that covers any strip; `Layout.put` draws positions in it and
rejects those outside the strip."""
_MOVERS = ("ball", "can", "cup", "bottle", "box")
"""Categories of moving objects, most of which are narrow enough for the strip they slide in."""


def walking(rng: Generator, categories: Sequence[str], filming: Filming) -> World:
    """Return a scene of a counter with objects of these categories.

    The camera moves along the counter and back, so that objects leave the view and return.
    """
    room, counter = make_room(rng, wall_chance=0.0), make_counter(rng)
    layout = Layout(rng, gap=rng.uniform(0.02, 0.05))
    for k, category in enumerate(categories):
        middle = -0.85 + 1.7 * (k + 0.5) / len(categories)  # spread along the counter
        strip = _strip(counter, (middle - 0.3, middle + 0.3), (-0.22, 0.22))
        layout.put(category, strip, _ANYWHERE)
    target = np.array([0, 0, counter.height + 0.05])
    path = lateral_pass(rng, target, filming)
    return World("walking", (*room, counter), tuple(layout.objects), path)


def crossing(rng: Generator, categories: Sequence[str], filming: Filming) -> World:
    """Return a scene of two rows of objects, between which two further objects slide.

    ``categories`` are those of the objects at rest. The moving objects occlude the others and each
    other.
    """
    room, table = make_room(rng, wall_chance=0.3), make_table(rng, (1.3, 0.85))
    layout = Layout(rng, gap=0.02, enclosed=True)
    t = filming.times()
    motions = {}
    for side, low in ((1.0, -0.13), (-1.0, 0.01)):
        lane = _strip(table, (-0.45, 0.45), (low, low + 0.12))
        if not layout.put(str(rng.choice(_MOVERS)), lane, _ANYWHERE, attempts=40):
            continue
        x = float(layout.objects[-1].pose.translation[0])
        amplitude, speed = rng.uniform(0.3, 0.4), side * rng.uniform(0.14, 0.25)
        phase = np.arcsin(np.clip(x / amplitude, -1, 1))
        along = amplitude * np.sin(speed / amplitude * t + phase) - amplitude * np.sin(phase)
        motions[len(layout.objects) - 1] = _shifted(along)
    rows = [_strip(table, (-0.5, 0.5), y) for y in ((-0.32, -0.15), (0.15, 0.37))]
    for k, category in enumerate(categories):
        layout.put(category, rows[k % 2], _ANYWHERE, attempts=20)
    path = _orbit_table(rng, table, filming, elevation=(25, 40), sweep=8)
    objects = tuple(layout.objects)
    return World("crossing", (*room, table), objects, path, motions=motions)


def rearranged(rng: Generator, categories: Sequence[str], filming: Filming) -> World:
    """Return a scene of a table, four of whose objects change.

    One object is added, one is removed, one is carried to another position, and one is pushed.
    ``categories`` are those of all objects except the pushed one.
    """
    room, table = make_room(rng, wall_chance=0.3), make_table(rng, (1.3, 0.85))
    layout = Layout(rng, gap=0.04)
    lane = _strip(table, (-0.4, 0.4), (-0.32, -0.2))  # kept free for the pushed object
    layout.put(str(rng.choice(_MOVERS)), lane, _ANYWHERE, attempts=40)
    back = _strip(table, (-0.45, 0.45), (-0.12, 0.36))
    for category in categories:
        layout.put(category, back, _ANYWHERE)
    duration, t = filming.frames / filming.rate_hz, filming.times()
    starts = rng.uniform([0.15, 0.15, 0.5, 0.15], [0.5, 0.5, 0.8, 0.5])
    pushed, carried, removed, added = starts * duration
    motions = {0: _pushed(layout.objects[0].pose.translation, t - pushed)}
    for k in range(1, len(layout.objects)):
        goal = layout.reserve_position(k, back, _ANYWHERE)
        if goal is not None:
            motions[k] = _carried(goal - layout.objects[k].pose.translation, t - carried)
            break
    others = [k for k in range(1, len(layout.objects)) if k not in motions]
    there = t[:, None] < removed, t[:, None] >= added
    for k, when in zip(others, there, strict=False):
        motions[k] = np.where(when, np.zeros(3), np.nan)
    path = _orbit_table(rng, table, filming, elevation=(30, 48), sweep=12)
    objects = tuple(layout.objects)
    return World("rearranged", (*room, table), objects, path, motions=motions)


def _orbit_table(
    rng: Generator,
    table: Support,
    filming: Filming,
    *,
    elevation: tuple[float, float],
    sweep: float,
) -> tuple[Pose, ...]:
    """Return a camera path on an arc in front of a table.

    ``elevation`` is a range and ``sweep`` half the arc, both in degrees, as for `arc_orbit`.
    """
    middle = np.array([0, 0, table.height + 0.05])
    return arc_orbit(rng, middle, filming, distance=(1.0, 1.3), elevation=elevation, sweep=sweep)


def _strip(support: Support, x: tuple[float, float], y: tuple[float, float]) -> Support:
    """Return a copy of a support that holds objects only within ranges of x and y, metres."""
    corners = [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]]
    return replace(support, outline=np.column_stack([corners, np.full(4, support.height)]))


def _shifted(along: F8) -> F8:
    """Return the motion (frames, 3) by ``along`` (frames,) in x, as in `World`; metres."""
    return np.round(np.outer(along, [1.0, 0, 0]), 6)


def _pushed(start: F8, t: F8) -> F8:
    """Return the motion (frames, 3) of an object pushed 0.4 m along x, at 0.2 m/s, from t = 0.

    ``start`` (3,) is its position, from which it moves towards x = 0; ``t`` (frames,) is the time
    of each frame, seconds.
    """
    distance = -np.sign(start[0] or 1.0) * 0.4
    return _shifted(distance * np.clip(t * 0.2 / abs(distance), 0, 1))


def _carried(displacement: F8, t: F8) -> F8:
    """Return the motion (frames, 3) of an object that is carried by ``displacement`` (3,), metres.

    It moves at 0.5 m/s from t = 0, and is lifted by up to 15 cm; ``t`` is as for `_pushed`.
    """
    share = np.clip(t * 0.5 / max(float(np.linalg.norm(displacement)), 0.1), 0, 1)
    height = 0.6 * share * (1 - share)
    return np.round(np.outer(share, displacement) + np.outer(height, [0, 0, 1.0]), 6)
