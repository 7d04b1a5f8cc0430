"""Things that are none of the seven categories, to learn what *unknown* looks like."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from shapecat.arrays import F8
from shapecat.geometry import rotation_from_quaternion
from shapecat.simulation.mesh import (
    Mesh,
    extrude,
    join,
    lathe,
    moved,
    rounded_box,
    scaled,
    smooth_path,
    standing,
    tube,
)
from shapecat.simulation.open_shapes import log_uniform
from shapecat.types import Pose

__all__ = ["DISTRACTORS", "make_distractor"]

Maker = Callable[[Generator], Mesh]


def make_distractor(rng: Generator, kind: str | None = None) -> tuple[str, Mesh]:
    """Make a random object outside the categories; returns its kind and shape.

    Raises
    ------
    ValueError : there is no such kind.
    """
    chosen = str(rng.choice(list(DISTRACTORS))) if kind is None else kind
    if chosen not in DISTRACTORS:
        msg = f"no distractor {chosen!r}; known: {', '.join(DISTRACTORS)}"
        raise ValueError(msg)
    mesh = DISTRACTORS[chosen](rng)
    jitter = np.exp(rng.uniform(-0.12, 0.12, 3))
    return chosen, standing(scaled(mesh, jitter * log_uniform(rng, 0.75, 1.35)))


def _at(mesh: Mesh, place: ArrayLike, *, about: str = "", degrees: float = 0.0) -> Mesh:
    """Turn a mesh about an axis and move it."""
    half = np.radians(degrees) / 2
    quaternion = [0.0, 0.0, 0.0, float(np.cos(half))]
    if about:
        quaternion["xyz".index(about)] = float(np.sin(half))
    return moved(mesh, Pose(rotation_from_quaternion(quaternion), np.asarray(place, np.float64)))


def _rod(length: float, radius: float) -> Mesh:
    """Return an upright round rod from z = 0."""
    return lathe([[0, 0], [radius, 0], [radius, length], [0, length]], segments=16)


def _ellipsoid(axes: ArrayLike) -> Mesh:
    t = np.linspace(-np.pi / 2, np.pi / 2, 17)
    return scaled(
        lathe(np.stack([np.cos(t), np.sin(t)], -1) * 0.1, segments=24), np.asarray(axes) * 10
    )


def _turned(knots: Sequence[tuple[float, float]], count: int = 26) -> Mesh:
    path = smooth_path(knots, count)
    path[:, 0] = np.maximum(path[:, 0], 0)
    return lathe(path, segments=36)


def _pan(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.09, 0.14), rng.uniform(0.035, 0.07)
    bowl = lathe([[0, 0], [0.85 * r, 0], [r, h], [r - 0.003, h], [0.84 * r, 0.004], [0, 0.004]])
    long = rng.uniform(1.1, 1.7) * r
    grip = [[0.97 * r, 0, 0.8 * h], [r + 0.3 * long, 0, h], [r + long, 0, h + 0.01]]
    return join([bowl, tube(smooth_path(grip, 10), 0.011, flatness=1.3)])


def _pot(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.08, 0.13), rng.uniform(0.08, 0.15)
    body = lathe(
        [
            [0, 0],
            [r, 0],
            [r, h],
            [1.04 * r, h],
            [0.8 * r, h + 0.02],
            [0.02, h + 0.03],
            [0, h + 0.03],
        ]
    )
    ears = [
        tube(
            smooth_path(
                [
                    [s * r, -0.03, 0.8 * h],
                    [s * (r + 0.035), -0.025, 0.8 * h],
                    [s * (r + 0.035), 0.025, 0.8 * h],
                    [s * r, 0.03, 0.8 * h],
                ],
                10,
            ),
            0.006,
        )
        for s in (-1, 1)
    ]
    return join([body, *ears, _at(_ellipsoid([0.018, 0.018, 0.014]), [0, 0, h + 0.045])])


def _kettle(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.075, 0.1), rng.uniform(0.11, 0.18)
    body = _turned(
        [(0, 0), (r, 0), (1.03 * r, 0.3 * h), (0.75 * r, 0.85 * h), (0.3 * r, h), (0, 1.02 * h)]
    )
    spout = tube(
        smooth_path([[0.8 * r, 0, 0.45 * h], [1.35 * r, 0, 0.7 * h], [1.6 * r, 0, 0.95 * h]], 10),
        np.linspace(0.018, 0.009, 10),
    )
    arch = [
        [-0.75 * r, 0, 0.8 * h],
        [-0.6 * r, 0, 1.35 * h],
        [0.6 * r, 0, 1.35 * h],
        [0.7 * r, 0, 0.85 * h],
    ]
    return join([body, spout, tube(smooth_path(arch, 16), 0.008)])


def _teapot(rng: Generator) -> Mesh:
    r = rng.uniform(0.06, 0.09)
    h = r * rng.uniform(1.1, 1.6)
    body = _turned(
        [(0, 0), (0.55 * r, 0), (r, 0.45 * h), (0.5 * r, 0.95 * h), (0.15 * r, h), (0, 1.02 * h)]
    )
    spout = tube(
        smooth_path([[0.85 * r, 0, 0.35 * h], [1.35 * r, 0, 0.5 * h], [1.6 * r, 0, 0.95 * h]], 10),
        np.linspace(0.016, 0.007, 10),
    )
    ear = [
        [-0.8 * r, 0, 0.8 * h],
        [-1.55 * r, 0, 0.8 * h],
        [-1.5 * r, 0, 0.35 * h],
        [-0.9 * r, 0, 0.25 * h],
    ]
    return join(
        [
            body,
            spout,
            tube(smooth_path(ear, 12), 0.007),
            _at(_ellipsoid([0.013] * 3), [0, 0, 1.08 * h]),
        ]
    )


def _wine_glass(rng: Generator) -> Mesh:
    r, h, stem = rng.uniform(0.03, 0.05), rng.uniform(0.15, 0.22), rng.uniform(0.35, 0.5)
    low = stem * h
    cup = smooth_path(
        [
            (0.006, low),
            (0.9 * r, low + 0.25 * (h - low)),
            (r, low + 0.55 * (h - low)),
            (0.8 * r, h),
        ],
        14,
    )
    inner = cup[::-1] - [0.002, 0]
    foot = [[0, 0], [0.9 * r, 0], [0.9 * r, 0.003], [0.005, 0.01], [0.004, 0.9 * low]]
    return lathe(np.concatenate([foot, cup, inner[:-1], [[0, low + 0.006]]]), segments=32)


def _hammer(rng: Generator) -> Mesh:
    long = rng.uniform(0.22, 0.32)
    grip = _at(_rod(long, rng.uniform(0.011, 0.016)), [0, 0, 0.02], about="y", degrees=90)
    head = _at(_rod(rng.uniform(0.08, 0.12), 0.015), [long, 0.05, 0.02], about="x", degrees=90)
    return join([grip, head])


def _banana(rng: Generator) -> Mesh:
    bend, long = rng.uniform(0.4, 0.75), rng.uniform(0.16, 0.22)
    t = np.linspace(-1, 1, 18) * bend
    path = np.stack([np.sin(t), np.cos(t), 0 * t], -1) * long / (2 * bend)
    return tube(path, 0.019 * (1 - 0.85 * np.abs(t / bend) ** 4), segments=12)


def _lamp(rng: Generator) -> Mesh:
    h = rng.uniform(0.25, 0.38)
    foot = lathe(
        [[0, 0], [0.07, 0], [0.065, 0.015], [0.009, 0.02], [0.008, h], [0, h]], segments=28
    )
    r = rng.uniform(0.07, 0.11)
    shade = lathe(
        [[r, 0.65 * h], [0.6 * r, 1.05 * h], [0.6 * r - 0.002, 1.05 * h], [r - 0.003, 0.65 * h]]
    )
    return join([foot, shade])


def _cone(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.035, 0.08), rng.uniform(0.1, 0.22)
    return lathe([[0, 0], [r, 0], [0.002, h], [0, h]], segments=int(rng.choice([4, 6, 36])))


def _ring(rng: Generator) -> Mesh:
    r = rng.uniform(0.04, 0.09)
    t = np.arange(32) * (2 * np.pi / 32)
    thick = r * rng.uniform(0.18, 0.45)
    path = np.stack([np.cos(t), np.sin(t), 0 * t], -1) * r
    return tube(path, thick, segments=14, closed=True)


def _blocks(rng: Generator) -> Mesh:
    e = rng.uniform(0.025, 0.045)
    shapes = (
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0)],
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (1, 1, 0)],
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 1, 0)],
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 2)],
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 0, 1), (2, 0, 1)],
    )
    places = shapes[int(rng.integers(len(shapes)))]
    return join(
        [_at(rounded_box([e, e, e], radius=0.002, fine=1), np.array(p) * e) for p in places]
    )


def _coil(rng: Generator) -> Mesh:
    turns, r, thick = rng.uniform(2.5, 5), rng.uniform(0.04, 0.08), rng.uniform(0.004, 0.007)
    t = np.linspace(0, 2 * np.pi * turns, int(20 * turns))
    wander = r * (1 + 0.1 * np.sin(1.37 * t + rng.uniform(0, 6)))
    height = thick * (1 + 0.8 * (1 + np.sin(0.31 * t + rng.uniform(0, 6))) * turns / 2)
    return tube(np.stack([wander * np.cos(t), wander * np.sin(t), height], -1), thick, segments=6)


def _stapler(rng: Generator) -> Mesh:
    long = rng.uniform(0.11, 0.16)
    base = rounded_box([long, 0.035, 0.012], radius=0.003, fine=2)
    top = _at(
        rounded_box([0.95 * long, 0.03, 0.022], radius=0.006, fine=3),
        [0, 0, 0.02],
        about="y",
        degrees=rng.uniform(5, 12),
    )
    hinge = _at(rounded_box([0.03, 0.03, 0.03], fine=1), [-0.42 * long, 0, 0.008])
    return join([base, top, hinge])


def _hand(rng: Generator) -> Mesh:
    parts = [_at(_ellipsoid([0.045, 0.042, 0.018]), [0, 0, 0.03])]
    curl = rng.uniform(0.0, 0.03)
    for k, y in enumerate(np.linspace(-0.032, 0.032, 4)):
        reach = rng.uniform(0.06, 0.085) * (1 - 0.1 * abs(k - 1.5))
        path = [
            [0.03, y, 0.03],
            [0.035 + 0.5 * reach, 1.15 * y, 0.04 + 0.3 * curl],
            [0.035 + reach, 1.2 * y, 0.03 - curl],
        ]
        parts.append(tube(smooth_path(path, 7), 0.009, segments=8))
    thumb = [[-0.01, 0.035, 0.03], [0.02, 0.065, 0.03], [0.05, 0.075, 0.028]]
    arm = [[-0.03, 0, 0.03], [-0.1, 0, 0.035], [-0.22, 0, 0.05]]
    return join(
        [*parts, tube(smooth_path(thumb, 6), 0.011, segments=8), tube(smooth_path(arm, 8), 0.029)]
    )


def _wedge(rng: Generator) -> Mesh:
    a, h = rng.uniform(0.06, 0.16), rng.uniform(0.03, 0.1)
    side = extrude([[0, 0], [a, 0], [rng.uniform(0, 0.3) * a, h]], rng.uniform(0.04, 0.12))
    return _at(side, [0, 0, 0], about="x", degrees=90)


def _pear(rng: Generator) -> Mesh:
    r, neck = rng.uniform(0.032, 0.045), rng.uniform(0.45, 0.62)
    knots = [
        (0, 0),
        (0.6 * r, 0.05 * r),
        (r, 0.9 * r),
        (neck * r, 1.9 * r),
        (0.35 * r, 2.5 * r),
        (0, 2.55 * r),
    ]
    return _turned(knots)


def _shoe(rng: Generator) -> Mesh:
    long, t = rng.uniform(0.2, 0.29), np.linspace(0, 1, 14)
    tall = np.interp(t, [0, 0.12, 0.35, 0.6, 0.85, 1], [0.03, 0.05, 0.048, 0.03, 0.024, 0.01])
    path = np.stack([long * t, 0.01 * np.sin(3 * t), tall], -1)
    return tube(path, tall, segments=14, flatness=rng.uniform(0.75, 1.0))


def _dumbbell(rng: Generator) -> Mesh:
    r, long = rng.uniform(0.03, 0.05), rng.uniform(0.12, 0.2)
    weight = lathe([[0, 0], [r, 0.004], [r, 0.04], [0, 0.044]], segments=int(rng.choice([6, 32])))
    upright = join([weight, _at(_rod(long, 0.012), [0, 0, 0.02]), _at(weight, [0, 0, long])])
    return _at(upright, [0, 0, 0], about="y", degrees=90)


def _scissors(rng: Generator) -> Mesh:
    parts = []
    spread = rng.uniform(8, 35)
    for side in (-1, 1):
        blade = _at(rounded_box([0.11, 0.012, 0.004], fine=1), [0.02, 0, 0])
        t = np.arange(20) * (2 * np.pi / 20)
        loop = tube(
            np.stack(
                [0.022 * np.cos(t) - 0.055, 0.016 * np.sin(t) + side * 0.006, 0 * t + 0.006], -1
            ),
            0.005,
            closed=True,
            segments=6,
        )
        parts.append(
            _at(
                join([blade, loop]),
                [0, 0, 0.004 * (side > 0)],
                about="z",
                degrees=side * spread / 2,
            )
        )
    return join(parts)


def _tap(rng: Generator) -> Mesh:
    h, reach = rng.uniform(0.15, 0.25), rng.uniform(0.08, 0.15)
    neck = [
        [0.0, 0, 0],
        [0, 0, 0.8 * h],
        [0.3 * reach, 0, h],
        [0.85 * reach, 0, 0.95 * h],
        [reach, 0, 0.75 * h],
    ]
    return join(
        [lathe([[0, 0], [0.035, 0], [0.03, 0.02], [0, 0.025]]), tube(smooth_path(neck, 18), 0.011)]
    )


def _duck(rng: Generator) -> Mesh:
    e = rng.uniform(0.03, 0.05)
    body = _at(_ellipsoid([1.3 * e, e, 0.85 * e]), [0, 0, 0.8 * e])
    head = _at(_ellipsoid([0.62 * e] * 3), [0.75 * e, 0, 1.9 * e])
    beak = _at(_ellipsoid([0.4 * e, 0.25 * e, 0.12 * e]), [1.4 * e, 0, 1.8 * e])
    tail = _at(
        _ellipsoid([0.5 * e, 0.4 * e, 0.2 * e]), [-1.2 * e, 0, 1.2 * e], about="y", degrees=40
    )
    return join([body, head, beak, tail])


def _chair(rng: Generator) -> Mesh:
    e, tall = rng.uniform(0.05, 0.09), rng.uniform(0.8, 1.2)
    legs = [
        _at(_rod(tall * e, 0.005), [x * 0.42 * e, y * 0.42 * e, 0])
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    seat = _at(rounded_box([e, e, 0.008], fine=2), [0, 0, tall * e])
    back = _at(rounded_box([0.006, e, 1.1 * e], fine=2), [-0.48 * e, 0, tall * e])
    return join([*legs, seat, back])


def _basket(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.06, 0.1), rng.uniform(0.06, 0.1)
    body = lathe(
        [[0, 0], [0.8 * r, 0], [r, h], [r - 0.004, h], [0.8 * r - 0.004, 0.004], [0, 0.004]]
    )
    t = np.linspace(0, np.pi, 16)
    arch = np.stack([(r - 0.003) * np.cos(t), 0 * t, h - 0.005 + 1.3 * h * np.sin(t)], -1)
    return join([body, tube(arch, 0.006)])


def _watering_can(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.05, 0.08), rng.uniform(0.1, 0.15)
    body = lathe([[0, 0], [r, 0], [0.9 * r, h], [0.88 * r, h], [r - 0.004, 0.005], [0, 0.005]])
    spout = tube(
        smooth_path([[0.9 * r, 0, 0.15 * h], [1.8 * r, 0, 0.7 * h], [2.5 * r, 0, 1.15 * h]], 10),
        np.linspace(0.014, 0.009, 10),
    )
    rose = tube([[2.4 * r, 0, 1.1 * h], [2.7 * r, 0, 1.28 * h]], [0.01, 0.024])
    ear = [
        [-0.9 * r, 0, 0.95 * h],
        [-1.9 * r, 0, 0.9 * h],
        [-1.6 * r, 0, 0.2 * h],
        [-0.95 * r, 0, 0.15 * h],
    ]
    return join([body, spout, rose, tube(smooth_path(ear, 14), 0.006)])


def _mouse(rng: Generator) -> Mesh:
    shell = _ellipsoid([0.058, 0.032, rng.uniform(0.03, 0.04)])
    points = np.array(shell.vertices, np.float64)
    points[:, 2] = np.maximum(points[:, 2], 0) * (1 - 3 * np.maximum(points[:, 0], 0))
    return Mesh(points, shell.triangles)


def _phone(rng: Generator) -> Mesh:
    """Return a desk telephone: a wedge with a receiver on top."""
    deep = rng.uniform(0.15, 0.2)
    wedge = _at(
        extrude([[0, 0], [deep, 0], [deep, 0.03], [0, 0.07]], 0.15),
        [-0.09, 0.075, 0],
        about="x",
        degrees=90,
    )
    bar = [[-0.02, -0.1, 0.07], [-0.02, -0.08, 0.085], [-0.02, 0.08, 0.085], [-0.02, 0.1, 0.07]]
    return join([wedge, tube(smooth_path(bar, 12), [0.022, *[0.016] * 10, 0.022])])


def _stool(rng: Generator) -> Mesh:
    """Return a trivet or spool: discs around an axle."""
    r, h = rng.uniform(0.04, 0.07), rng.uniform(0.05, 0.12)
    core, disc = r * rng.uniform(0.25, 0.5), 0.008
    return lathe(
        [[0, 0], [r, 0], [r, disc], [core, disc], [core, h - disc], [r, h - disc], [r, h], [0, h]]
    )


def _star(rng: Generator) -> Mesh:
    arms = int(rng.integers(4, 7))
    t = np.arange(2 * arms) * (np.pi / arms)
    r = np.where(np.arange(2 * arms) % 2, rng.uniform(0.35, 0.5), 1.0) * rng.uniform(0.05, 0.09)
    return extrude(np.stack([r * np.cos(t), r * np.sin(t)], -1), rng.uniform(0.015, 0.05))


def _mushroom(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.03, 0.05), rng.uniform(0.06, 0.1)
    knots = [(0, 0), (0.4 * r, 0), (0.35 * r, 0.55 * h), (r, 0.6 * h), (0.75 * r, 0.9 * h), (0, h)]
    return _turned(knots, 30)


def _screwdriver(rng: Generator) -> Mesh:
    grip, shaft = rng.uniform(0.08, 0.11), rng.uniform(0.08, 0.15)
    r = rng.uniform(0.012, 0.017)
    profile = [
        [0.0, 0],
        [0.8 * r, 0],
        [r, 0.2 * grip],
        [0.8 * r, 0.7 * grip],
        [r, 0.9 * grip],
        [0.35 * r, grip],
    ]
    profile += [[0.25 * r, grip + 0.005], [0.25 * r, grip + shaft], [0, grip + shaft]]
    return _at(lathe(profile, segments=18), [0, 0, 0], about="y", degrees=90)


def _plush(rng: Generator) -> Mesh:
    e = rng.uniform(0.04, 0.065)
    limbs = [
        ([0.5, 0.7, 0.3], 0.42),
        ([0.5, -0.7, 0.3], 0.42),
        ([0.2, 0.9, 1.3], 0.36),
        ([0.2, -0.9, 1.3], 0.36),
    ]
    ears = [([0, 0.5, 2.95], 0.25), ([0, -0.5, 2.95], 0.25)]
    parts = [_at(_ellipsoid([e * s] * 3), np.array(p) * e) for p, s in limbs + ears]
    return join(
        [
            _at(_ellipsoid([0.8 * e, 0.9 * e, e]), [0, 0, e]),
            _at(_ellipsoid([0.75 * e] * 3), [0.1 * e, 0, 2.35 * e]),
            *parts,
        ]
    )


def _blob(rng: Generator) -> Mesh:
    """Return a lump: a sphere with random waves."""
    ball = _ellipsoid(rng.uniform(0.03, 0.07, 3))
    points = np.asarray(ball.vertices, np.float64)
    unit = points / (np.linalg.norm(points, axis=1, keepdims=True) + 1e-12)
    waves: F8 = rng.normal(size=(5, 3)) * 2.5
    swell = np.sin(unit @ waves.T + rng.uniform(0, 6, 5)).sum(axis=1)
    return Mesh(points * (1 + 0.12 * swell[:, None]), ball.triangles)


def _funnel(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.045, 0.075), rng.uniform(0.1, 0.15)
    profile = [[r, 0], [0.012, 0.6 * h], [0.008, h], [0.006, h], [0.01, 0.6 * h], [r - 0.003, 0]]
    return lathe(profile, segments=32)


DISTRACTORS: dict[str, Maker] = {
    "pan": _pan,
    "pot": _pot,
    "kettle": _kettle,
    "teapot": _teapot,
    "wine_glass": _wine_glass,
    "hammer": _hammer,
    "banana": _banana,
    "lamp": _lamp,
    "cone": _cone,
    "ring": _ring,
    "blocks": _blocks,
    "coil": _coil,
    "stapler": _stapler,
    "hand": _hand,
    "wedge": _wedge,
    "pear": _pear,
    "shoe": _shoe,
    "dumbbell": _dumbbell,
    "scissors": _scissors,
    "tap": _tap,
    "duck": _duck,
    "chair": _chair,
    "basket": _basket,
    "watering_can": _watering_can,
    "mouse": _mouse,
    "phone": _phone,
    "spool": _stool,
    "star": _star,
    "mushroom": _mushroom,
    "screwdriver": _screwdriver,
    "plush": _plush,
    "blob": _blob,
    "funnel": _funnel,
}
"""The kinds of things outside the categories, each with its maker."""
