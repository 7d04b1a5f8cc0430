"""Tools and household objects outside the seven categories."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from shapecat.simulation.shapes.mesh import Mesh, join
from shapecat.simulation.shapes.parts import ellipsoid, placed, rod
from shapecat.simulation.shapes.primitives import extrude, lathe, rounded_box, smooth_path, tube

__all__ = ["TOOLS"]


def _hammer(rng: Generator) -> Mesh:
    long = rng.uniform(0.22, 0.32)
    grip = placed(rod(long, rng.uniform(0.011, 0.016)), [0, 0, 0.02], about="y", degrees=90)
    head = placed(rod(rng.uniform(0.08, 0.12), 0.015), [long, 0.05, 0.02], about="x", degrees=90)
    return join([grip, head])


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


def _coil(rng: Generator) -> Mesh:
    turns, r, thick = rng.uniform(2.5, 5), rng.uniform(0.04, 0.08), rng.uniform(0.004, 0.007)
    t = np.linspace(0, 2 * np.pi * turns, int(20 * turns))
    wander = r * (1 + 0.1 * np.sin(1.37 * t + rng.uniform(0, 6)))
    height = thick * (1 + 0.8 * (1 + np.sin(0.31 * t + rng.uniform(0, 6))) * turns / 2)
    return tube(np.stack([wander * np.cos(t), wander * np.sin(t), height], -1), thick, segments=6)


def _stapler(rng: Generator) -> Mesh:
    long = rng.uniform(0.11, 0.16)
    base = rounded_box([long, 0.035, 0.012], radius=0.003, fine=2)
    top = placed(
        rounded_box([0.95 * long, 0.03, 0.022], radius=0.006, fine=3),
        [0, 0, 0.02],
        about="y",
        degrees=rng.uniform(5, 12),
    )
    hinge = placed(rounded_box([0.03, 0.03, 0.03], fine=1), [-0.42 * long, 0, 0.008])
    return join([base, top, hinge])


def _scissors(rng: Generator) -> Mesh:
    parts = []
    spread = rng.uniform(8, 35)
    for side in (-1, 1):
        blade = placed(rounded_box([0.11, 0.012, 0.004], fine=1), [0.02, 0, 0])
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
            placed(
                join([blade, loop]),
                [0, 0, 0.004 * (side > 0)],
                about="z",
                degrees=side * spread / 2,
            )
        )
    return join(parts)


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
    return placed(lathe(profile, segments=18), about="y", degrees=90)


def _dumbbell(rng: Generator) -> Mesh:
    r, long = rng.uniform(0.03, 0.05), rng.uniform(0.12, 0.2)
    weight = lathe([[0, 0], [r, 0.004], [r, 0.04], [0, 0.044]], segments=int(rng.choice([6, 32])))
    upright = join([weight, placed(rod(long, 0.012), [0, 0, 0.02]), placed(weight, [0, 0, long])])
    return placed(upright, about="y", degrees=90)


def _mouse(rng: Generator) -> Mesh:
    shell = ellipsoid([0.058, 0.032, rng.uniform(0.03, 0.04)])
    points = np.array(shell.vertices, np.float64)
    points[:, 2] = np.maximum(points[:, 2], 0) * (1 - 3 * np.maximum(points[:, 0], 0))
    return Mesh(points, shell.triangles)


def _phone(rng: Generator) -> Mesh:
    """Return a desk telephone: a wedge with a receiver on top."""
    deep = rng.uniform(0.15, 0.2)
    wedge = placed(
        extrude([[0, 0], [deep, 0], [deep, 0.03], [0, 0.07]], 0.15),
        [-0.09, 0.075, 0],
        about="x",
        degrees=90,
    )
    bar = [[-0.02, -0.1, 0.07], [-0.02, -0.08, 0.085], [-0.02, 0.08, 0.085], [-0.02, 0.1, 0.07]]
    return join([wedge, tube(smooth_path(bar, 12), [0.022, *[0.016] * 10, 0.022])])


def _spool(rng: Generator) -> Mesh:
    """Return a spool: two discs on an axle."""
    r, h = rng.uniform(0.04, 0.07), rng.uniform(0.05, 0.12)
    core, disc = r * rng.uniform(0.25, 0.5), 0.008
    return lathe(
        [[0, 0], [r, 0], [r, disc], [core, disc], [core, h - disc], [r, h - disc], [r, h], [0, h]]
    )


def _shoe(rng: Generator) -> Mesh:
    long, t = rng.uniform(0.2, 0.29), np.linspace(0, 1, 14)
    tall = np.interp(t, [0, 0.12, 0.35, 0.6, 0.85, 1], [0.03, 0.05, 0.048, 0.03, 0.024, 0.01])
    path = np.stack([long * t, 0.01 * np.sin(3 * t), tall], -1)
    return tube(path, tall, segments=14, flatness=rng.uniform(0.75, 1.0))


TOOLS: dict[str, Callable[[Generator], Mesh]] = {
    "hammer": _hammer,
    "lamp": _lamp,
    "coil": _coil,
    "stapler": _stapler,
    "scissors": _scissors,
    "screwdriver": _screwdriver,
    "dumbbell": _dumbbell,
    "mouse": _mouse,
    "phone": _phone,
    "spool": _spool,
    "shoe": _shoe,
}
"""For each kind of object, the function that makes a random one."""
