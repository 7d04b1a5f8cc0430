"""Kitchen objects outside the seven categories."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from shapecat.simulation.shapes.mesh import Mesh, join
from shapecat.simulation.shapes.parts import ellipsoid, placed, turned_body
from shapecat.simulation.shapes.primitives import lathe, smooth_path, tube

__all__ = ["KITCHEN"]


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
    return join([body, *ears, placed(ellipsoid([0.018, 0.018, 0.014]), [0, 0, h + 0.045])])


def _spout(way: list[list[float]], narrowest: float) -> Mesh:
    """Return a spout along ``way`` (n, 3), metres, which tapers to the radius ``narrowest``."""
    return tube(smooth_path(way, 10), np.linspace(narrowest + 0.009, narrowest, 10))


def _kettle(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.075, 0.1), rng.uniform(0.11, 0.18)
    body = turned_body(
        [(0, 0), (r, 0), (1.03 * r, 0.3 * h), (0.75 * r, 0.85 * h), (0.3 * r, h), (0, 1.02 * h)]
    )
    spout = _spout([[0.8 * r, 0, 0.45 * h], [1.35 * r, 0, 0.7 * h], [1.6 * r, 0, 0.95 * h]], 0.009)
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
    body = turned_body(
        [(0, 0), (0.55 * r, 0), (r, 0.45 * h), (0.5 * r, 0.95 * h), (0.15 * r, h), (0, 1.02 * h)]
    )
    spout = _spout([[0.85 * r, 0, 0.35 * h], [1.35 * r, 0, 0.5 * h], [1.6 * r, 0, 0.95 * h]], 0.007)
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
            placed(ellipsoid([0.013] * 3), [0, 0, 1.08 * h]),
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


def _funnel(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.045, 0.075), rng.uniform(0.1, 0.15)
    profile = [[r, 0], [0.012, 0.6 * h], [0.008, h], [0.006, h], [0.01, 0.6 * h], [r - 0.003, 0]]
    return lathe(profile, segments=32)


def _tap(rng: Generator) -> Mesh:
    h, length = rng.uniform(0.15, 0.25), rng.uniform(0.08, 0.15)
    neck = [
        [0.0, 0, 0],
        [0, 0, 0.8 * h],
        [0.3 * length, 0, h],
        [0.85 * length, 0, 0.95 * h],
        [length, 0, 0.75 * h],
    ]
    return join(
        [lathe([[0, 0], [0.035, 0], [0.03, 0.02], [0, 0.025]]), tube(smooth_path(neck, 18), 0.011)]
    )


def _banana(rng: Generator) -> Mesh:
    bend, long = rng.uniform(0.4, 0.75), rng.uniform(0.16, 0.22)
    t = np.linspace(-1, 1, 18) * bend
    path = np.stack([np.sin(t), np.cos(t), 0 * t], -1) * long / (2 * bend)
    return tube(path, 0.019 * (1 - 0.85 * np.abs(t / bend) ** 4), segments=12)


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
    return turned_body(knots)


def _mushroom(rng: Generator) -> Mesh:
    r, h = rng.uniform(0.03, 0.05), rng.uniform(0.06, 0.1)
    knots = [(0, 0), (0.4 * r, 0), (0.35 * r, 0.55 * h), (r, 0.6 * h), (0.75 * r, 0.9 * h), (0, h)]
    return turned_body(knots, 30)


KITCHEN: dict[str, Callable[[Generator], Mesh]] = {
    "pan": _pan,
    "pot": _pot,
    "kettle": _kettle,
    "teapot": _teapot,
    "wine_glass": _wine_glass,
    "basket": _basket,
    "watering_can": _watering_can,
    "funnel": _funnel,
    "tap": _tap,
    "banana": _banana,
    "pear": _pear,
    "mushroom": _mushroom,
}
"""For each kind of object, the function that makes a random one."""
