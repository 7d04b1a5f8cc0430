"""Closed shapes: cans, bottles and boxes."""

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.shapes.mesh import Mesh, join, moved, standing
from shapecat.simulation.shapes.parts import placed
from shapecat.simulation.shapes.primitives import extrude, lathe, rounded_box, smooth_path, tube
from shapecat.simulation.shapes.randomness import log_uniform, with_random_yaw
from shapecat.types import Pose

__all__ = ["make_bottle", "make_box", "make_can"]


def make_can(rng: Generator) -> Mesh:
    """Make a can: a closed cylinder, such as a soda can, tin, jar, tube or drum."""
    family = rng.choice(
        ["soda", "tin", "flat", "tube", "jar", "plain", "drum"],
        p=[0.2, 0.2, 0.16, 0.12, 0.1, 0.15, 0.07],
    )
    diameter, ratio, make_profile = {
        "soda": (log_uniform(rng, 0.052, 0.072), rng.uniform(1.35, 2.6), _soda),
        "tin": (log_uniform(rng, 0.05, 0.11), rng.uniform(0.75, 1.7), _tin),
        "flat": (log_uniform(rng, 0.055, 0.15), rng.uniform(0.25, 0.65), _tin),
        "tube": (log_uniform(rng, 0.035, 0.09), rng.uniform(2.2, 4.7), _tube_can),
        "jar": (log_uniform(rng, 0.05, 0.11), rng.uniform(0.7, 1.9), _jar),
        "plain": (log_uniform(rng, 0.035, 0.14), log_uniform(rng, 0.4, 2.6), _plain),
        "drum": (log_uniform(rng, 0.11, 0.22), rng.uniform(0.35, 1.2), _tin),
    }[str(family)]
    profile = make_profile(rng, diameter / 2, min(ratio * diameter, 0.32))
    oval = family in {"tin", "flat", "drum"} and rng.random() < 0.06
    stretch = rng.uniform(0.75, 0.92) if oval else 1.0
    return standing(lathe(profile, segments=44, stretch=stretch, turn=rng.uniform(0, 1)))


def _soda(rng: Generator, r: float, h: float) -> F8:
    """Draw the profile (n, 2), radius and z, of a drinks can with radius ``r`` and height ``h``."""
    neck, foot = r * rng.uniform(0.78, 0.92), r * rng.uniform(0.7, 0.88)
    shoulder, sunk = h * rng.uniform(0.06, 0.12), rng.uniform(0.003, 0.007)
    return np.array(
        [
            [0, 0.008],
            [0.6 * foot, 0.004],
            [0.92 * foot, 0],
            [foot, 0],
            [0.97 * r, 0.6 * shoulder],
            [r, shoulder],
            [r, h - 1.4 * shoulder],
            [0.97 * r, h - 0.9 * shoulder],
            [neck, h - 0.003],
            [neck + 0.001, h],
            [neck - 0.0015, h],
            [neck - 0.003, h - sunk],
            [0, h - sunk],
        ]
    )


def _tin(rng: Generator, r: float, h: float) -> F8:
    """Draw the profile (n, 2), radius and z, of a tin with radius ``r`` and height ``h``."""
    rim, sunk = rng.uniform(0.0, 0.0015), rng.uniform(0.0, 0.005)
    z = np.linspace(0.004, h - 0.004, 26)
    ribs = rng.uniform(0.0, 0.0012) * (rng.random() < 0.5)
    inside = (z > 0.25 * h) & (z < 0.75 * h)
    wall = r - rim + ribs * np.cos(z * (2 * np.pi / 0.008)) * inside
    bottom = [[0, sunk], [r - 0.004, sunk], [r - 0.003, 0], [r, 0], [r, 0.003]]
    top = [[r, h - 0.003], [r, h], [r - 0.003, h], [r - 0.004, h - sunk], [0, h - sunk]]
    return np.concatenate([bottom, np.stack([wall, z], -1), top])


def _tube_can(rng: Generator, r: float, h: float) -> F8:
    """Draw the profile (n, 2), radius and z, of a tube-shaped can, radius ``r``, height ``h``."""
    lid, over = h * rng.uniform(0.03, 0.12), r * rng.uniform(0.98, 1.06)
    return np.array(
        [
            [0, 0],
            [r, 0],
            [r, h - lid],
            [over, h - lid],
            [over, h - 0.002],
            [over - 0.002, h],
            [0, h],
        ]
    )


def _jar(rng: Generator, r: float, h: float) -> F8:
    """Draw the profile (n, 2), radius and z, of a jar with radius ``r`` and height ``h``."""
    lid, top = h * rng.uniform(0.1, 0.22), r * rng.uniform(0.84, 1.03)
    curve = rng.uniform(0.0, 0.006)
    z = np.linspace(0.1 * r, h - lid - 0.12 * r, 8)
    wall = np.stack([r - curve * (2 * z / h - 0.9) ** 2, z], -1)
    neck = min(top, r) * 0.97
    lower = [[0, 0], [0.9 * r, 0]]
    upper = [[neck, h - lid], [top, h - lid], [top, h - 0.002], [top - 0.002, h], [0, h]]
    return np.concatenate([lower, wall, upper])


def _plain(rng: Generator, r: float, h: float) -> F8:
    """Draw the profile (n, 2), radius and z, of a cylinder with radius ``r`` and height ``h``."""
    e = rng.uniform(0.0, 0.08) * min(r, h / 2)
    taper = rng.uniform(0.96, 1.0)
    t = r * taper
    return np.array([[0, 0], [r - e, 0], [r, e], [t, h - e], [t - e, h], [0, h]])


def make_bottle(rng: Generator) -> Mesh:
    """Make a bottle: a closed body with a neck at most 0.62 times as wide as the body."""
    family = rng.choice(
        ["water", "wine", "shampoo", "spray", "cleanser", "squeeze", "slim", "pump", "trigger"],
        p=[0.2, 0.13, 0.17, 0.1, 0.1, 0.1, 0.08, 0.06, 0.06],
    )
    height, width, stretch = {
        "water": (log_uniform(rng, 0.13, 0.34), rng.uniform(0.26, 0.48), 1.0),
        "wine": (log_uniform(rng, 0.16, 0.34), rng.uniform(0.22, 0.36), 1.0),
        "shampoo": (log_uniform(rng, 0.12, 0.26), rng.uniform(0.28, 0.5), rng.uniform(0.45, 0.95)),
        "spray": (log_uniform(rng, 0.12, 0.26), rng.uniform(0.2, 0.36), 1.0),
        "cleanser": (log_uniform(rng, 0.17, 0.32), rng.uniform(0.26, 0.42), rng.uniform(0.55, 1)),
        "squeeze": (log_uniform(rng, 0.12, 0.24), rng.uniform(0.26, 0.42), rng.uniform(0.6, 1.0)),
        "slim": (log_uniform(rng, 0.07, 0.18), rng.uniform(0.15, 0.32), rng.uniform(0.6, 1.0)),
        "pump": (log_uniform(rng, 0.13, 0.2), rng.uniform(0.4, 0.6), rng.uniform(0.6, 1.0)),
        "trigger": (log_uniform(rng, 0.16, 0.24), rng.uniform(0.4, 0.55), rng.uniform(0.5, 0.9)),
    }[str(family)]
    radius = height * width / 2
    body, shoulder, neck = {
        "water": (rng.uniform(0.58, 0.78), rng.uniform(0.1, 0.2), rng.uniform(0.28, 0.55)),
        "wine": (rng.uniform(0.5, 0.66), rng.uniform(0.08, 0.16), rng.uniform(0.3, 0.45)),
        "shampoo": (rng.uniform(0.68, 0.84), rng.uniform(0.04, 0.12), rng.uniform(0.35, 0.6)),
        "spray": (rng.uniform(0.74, 0.86), rng.uniform(0.03, 0.08), rng.uniform(0.4, 0.6)),
        "cleanser": (rng.uniform(0.5, 0.65), rng.uniform(0.15, 0.28), rng.uniform(0.3, 0.5)),
        "squeeze": (rng.uniform(0.6, 0.75), rng.uniform(0.06, 0.12), rng.uniform(0.3, 0.5)),
        "slim": (rng.uniform(0.5, 0.7), rng.uniform(0.05, 0.12), rng.uniform(0.42, 0.6)),
        "pump": (rng.uniform(0.72, 0.85), rng.uniform(0.05, 0.12), rng.uniform(0.3, 0.45)),
        "trigger": (rng.uniform(0.62, 0.75), rng.uniform(0.12, 0.2), rng.uniform(0.25, 0.4)),
    }[str(family)]
    sides = _bottle_side(rng, str(family), body)
    profile = _bottle(rng, sides, shoulder, neck, tip=family in {"squeeze", "slim"})
    square = rng.uniform(3, 6) if rng.random() < 0.15 else rng.uniform(2.0, 2.6)
    mesh = lathe(profile * [radius, height], segments=40, squareness=square if stretch < 1 else 2.0)
    mesh = _flattened(mesh, stretch, height * body, height * (body + shoulder), neck)
    if family in {"shampoo", "cleanser", "squeeze"} and rng.random() < 0.3:
        mesh = _bent(mesh, rng.uniform(0.3, 0.7) * radius, 0.7 * height * body, height)
    if family == "pump":
        mesh = join([mesh, *_pump(rng, radius * neck, height)])
    if family == "trigger":
        mesh = join([mesh, *_trigger(rng, radius, height)])
    return standing(with_random_yaw(mesh, rng))


def _bottle_side(rng: Generator, family: str, body: float) -> F8:
    """Draw the profile (n, 2), radius and z, of a bottle's body, from its foot to its shoulder.

    ``family`` is the kind of bottle, as in `make_bottle`. The bottle has height 1 and a radius of
    about 1; its body ends at z = ``body``.
    """
    foot = rng.uniform(0.85, 0.98)
    waist = {"cleanser": rng.uniform(0.72, 1.0), "water": rng.uniform(0.84, 1.02)}.get(family, 1.0)
    top = {"squeeze": rng.uniform(0.75, 1.0), "shampoo": rng.uniform(0.8, 1.05)}.get(family, 1.0)
    knots = [(foot, 0), (1, 0.04), (1, 0.25 * body), (waist, 0.55 * body), (top, body)]
    path = smooth_path(knots, 18)
    path[:, 1] = np.maximum.accumulate(np.clip(path[:, 1], 0, body))
    return path


def _bottle(rng: Generator, side: F8, shoulder: float, neck: float, *, tip: bool) -> F8:
    """Draw the profile (n, 2), radius and z, of a bottle of height 1, with its shoulder and cap.

    ``side`` is the profile of its body, from `_bottle_side`. ``shoulder`` is the height of the
    shoulder above the body, ``neck`` the radius of the neck; with ``tip``, the cap is pointed.
    """
    start, width = side[-1, 1], side[-1, 0]
    t = np.linspace(0, 1, 9)[1:]
    shape = rng.choice(["round", "cone", "bell"])
    fall = {"round": 1 - np.sqrt(1 - t**2 * 0.999), "cone": t, "bell": t * t * (3 - 2 * t)}[
        str(shape)
    ]
    shoulder = min(shoulder, 0.94 - start)
    slope = np.stack([width + (neck - width) * fall, start + shoulder * t], -1)
    low = start + shoulder
    cap = rng.uniform(0.02, max(0.025, min(0.12, 0.6 * (1 - low))))
    wide = min(neck * rng.uniform(1.0, 1.25), 0.62)
    top = wide * (rng.uniform(0.25, 0.6) if tip else rng.uniform(0.9, 1.0))
    step = 1 - low if tip or rng.random() < 0.3 else cap
    end = [[wide, 1 - step], [wide, 1 - step + 0.3 * step], [top, 0.995], [0.9 * top, 1], [0, 1]]
    ring = [[neck, 1 - step]]
    return np.concatenate([[[0, 0]], side, slope, ring, end])


def _flattened(mesh: Mesh, stretch: float, low: float, high: float, neck: float) -> Mesh:
    """Make the body of a bottle oval; keep the neck round, or at least no wider than the body.

    ``stretch`` is the body's width along y divided by that along x; 1 changes nothing. The body
    ends at z = ``low``; the neck begins at ``high`` and has ``neck`` times the body's radius.
    """
    if stretch >= 1:
        return mesh
    points = np.asarray(mesh.vertices, np.float64)
    at_neck = np.interp(points[:, 2], [low, high], [0.0, 1.0])
    factor = stretch + (max(stretch, min(1.0, stretch / neck)) - stretch) * at_neck
    return Mesh(
        points * np.column_stack([np.ones_like(factor), factor, np.ones_like(factor)]),
        mesh.triangles,
    )


def _bent(mesh: Mesh, shift: float, low: float, high: float) -> Mesh:
    """Shift the part above z = ``low`` to one side, like the neck of a detergent bottle.

    The shift grows smoothly to ``shift``, metres, at z = ``high``, and is constant above.
    """
    points = np.array(mesh.vertices, np.float64)
    t = np.clip((points[:, 2] - low) / (high - low), 0, 1)
    points[:, 0] += shift * t * t * (3 - 2 * t)
    return Mesh(points, mesh.triangles)


def _pump(rng: Generator, radius: float, height: float) -> list[Mesh]:
    """Return the stem and spout of a pump on a bottle; ``radius`` is that of the bottle's neck."""
    stem = rng.uniform(0.02, 0.045)
    thick = float(np.clip(0.35 * radius, 0.003, 0.006))
    z = height + stem
    length = rng.uniform(0.02, 0.04)
    beak = [[-1.6 * thick, 0, z], [0.4 * length, 0, z + 0.002], [length, 0, z - 0.004]]
    return [
        tube([[0, 0, height - 0.004], [0, 0, height + stem / 2], [0, 0, z]], thick, segments=8),
        tube(smooth_path(beak, 6), 1.5 * thick, segments=8),
    ]


def _trigger(rng: Generator, radius: float, height: float) -> list[Mesh]:
    """Return the head of a spray bottle of this size: a box with a nozzle and a lever."""
    long, tall = radius * rng.uniform(1.2, 1.9), rng.uniform(0.022, 0.035)
    thick = rng.uniform(0.018, 0.026)
    head = rounded_box([long, thick, tall], radius=0.004, fine=2)
    x = 0.55 * long
    lever = [[x, 0, height + 0.004], [x + 0.008, 0, height - 0.02], [x + 0.002, 0, height - 0.045]]
    head = placed(head, [0.25 * long, 0, height - 0.004])
    return [head, tube(smooth_path(lever, 6), 0.004, segments=6)]


def make_box(rng: Generator) -> Mesh:
    """Make a box: a cuboid with sharp or slightly rounded edges, or rarely a gabled carton."""
    family = rng.choice(
        ["any", "packet", "book", "small", "cube", "bar", "carton"],
        p=[0.22, 0.25, 0.15, 0.15, 0.09, 0.09, 0.05],
    )
    if family == "carton":
        return _gable_carton(rng)
    size = {
        "any": [log_uniform(rng, 0.03, 0.28) for _ in range(3)],
        "packet": [
            log_uniform(rng, 0.03, 0.09),
            log_uniform(rng, 0.09, 0.22),
            log_uniform(rng, 0.12, 0.3),
        ],
        "book": [
            log_uniform(rng, 0.1, 0.22),
            log_uniform(rng, 0.14, 0.3),
            log_uniform(rng, 0.01, 0.05),
        ],
        "small": [log_uniform(rng, 0.03, 0.1) for _ in range(3)],
        "cube": [log_uniform(rng, 0.035, 0.16)] * 3,
        "bar": [
            log_uniform(rng, 0.025, 0.06),
            log_uniform(rng, 0.025, 0.07),
            log_uniform(rng, 0.12, 0.26),
        ],
    }[str(family)]
    radius = rng.uniform(0.0, 0.005) if rng.random() < 0.6 else 0.0
    bulge = rng.uniform(0.0, 0.004) if family == "packet" and rng.random() < 0.5 else 0.0
    return rounded_box(size, radius=radius, bulge=bulge)


def _gable_carton(rng: Generator) -> Mesh:
    """Return a milk carton with a gable."""
    width, tall, roof = log_uniform(rng, 0.055, 0.1), rng.uniform(1.3, 2.2), rng.uniform(0.25, 0.45)
    high = (tall + roof) * width
    outline = [
        (-0.5, 0),
        (0.5, 0),
        (0.5, tall),
        (0.03, tall + roof),
        (-0.03, tall + roof),
        (-0.5, tall),
    ]
    side = extrude(np.array(outline) * width, width)
    stand = moved(side, Pose(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.zeros(3)))
    ridge = rounded_box([0.004, width, 0.015], fine=1)
    return standing(join([stand, placed(ridge, [0, -width / 2, high - 0.002])]))
