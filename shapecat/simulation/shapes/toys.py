"""Toys, solids and lumps outside the seven categories."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.shapes.mesh import Mesh, join
from shapecat.simulation.shapes.parts import ellipsoid, placed, rod
from shapecat.simulation.shapes.primitives import extrude, lathe, rounded_box, smooth_path, tube

__all__ = ["TOYS"]


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
        [placed(rounded_box([e, e, e], radius=0.002, fine=1), np.array(p) * e) for p in places]
    )


def _hand(rng: Generator) -> Mesh:
    parts = [placed(ellipsoid([0.045, 0.042, 0.018]), [0, 0, 0.03])]
    curl = rng.uniform(0.0, 0.03)
    for k, y in enumerate(np.linspace(-0.032, 0.032, 4)):
        length = rng.uniform(0.06, 0.085) * (1 - 0.1 * abs(k - 1.5))
        path = [
            [0.03, y, 0.03],
            [0.035 + 0.5 * length, 1.15 * y, 0.04 + 0.3 * curl],
            [0.035 + length, 1.2 * y, 0.03 - curl],
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
    return placed(side, about="x", degrees=90)


def _duck(rng: Generator) -> Mesh:
    e = rng.uniform(0.03, 0.05)
    body = placed(ellipsoid([1.3 * e, e, 0.85 * e]), [0, 0, 0.8 * e])
    head = placed(ellipsoid([0.62 * e] * 3), [0.75 * e, 0, 1.9 * e])
    beak = placed(ellipsoid([0.4 * e, 0.25 * e, 0.12 * e]), [1.4 * e, 0, 1.8 * e])
    tail = placed(
        ellipsoid([0.5 * e, 0.4 * e, 0.2 * e]), [-1.2 * e, 0, 1.2 * e], about="y", degrees=40
    )
    return join([body, head, beak, tail])


def _chair(rng: Generator) -> Mesh:
    e, tall = rng.uniform(0.05, 0.09), rng.uniform(0.8, 1.2)
    legs = [
        placed(rod(tall * e, 0.005), [x * 0.42 * e, y * 0.42 * e, 0])
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    seat = placed(rounded_box([e, e, 0.008], fine=2), [0, 0, tall * e])
    back = placed(rounded_box([0.006, e, 1.1 * e], fine=2), [-0.48 * e, 0, tall * e])
    return join([*legs, seat, back])


def _star(rng: Generator) -> Mesh:
    arms = int(rng.integers(4, 7))
    t = np.arange(2 * arms) * (np.pi / arms)
    r = np.where(np.arange(2 * arms) % 2, rng.uniform(0.35, 0.5), 1.0) * rng.uniform(0.05, 0.09)
    return extrude(np.stack([r * np.cos(t), r * np.sin(t)], -1), rng.uniform(0.015, 0.05))


def _plush(rng: Generator) -> Mesh:
    e = rng.uniform(0.04, 0.065)
    limbs = [
        ([0.5, 0.7, 0.3], 0.42),
        ([0.5, -0.7, 0.3], 0.42),
        ([0.2, 0.9, 1.3], 0.36),
        ([0.2, -0.9, 1.3], 0.36),
    ]
    ears = [([0, 0.5, 2.95], 0.25), ([0, -0.5, 2.95], 0.25)]
    parts = [placed(ellipsoid([e * s] * 3), np.array(p) * e) for p, s in limbs + ears]
    return join(
        [
            placed(ellipsoid([0.8 * e, 0.9 * e, e]), [0, 0, e]),
            placed(ellipsoid([0.75 * e] * 3), [0.1 * e, 0, 2.35 * e]),
            *parts,
        ]
    )


def _blob(rng: Generator) -> Mesh:
    """Return a lump: a sphere with random waves."""
    ball = ellipsoid(rng.uniform(0.03, 0.07, 3))
    points = np.asarray(ball.vertices, np.float64)
    unit = points / (np.linalg.norm(points, axis=1, keepdims=True) + 1e-12)
    waves: F8 = rng.normal(size=(5, 3)) * 2.5
    swell = np.sin(unit @ waves.T + rng.uniform(0, 6, 5)).sum(axis=1)
    return Mesh(points * (1 + 0.12 * swell[:, None]), ball.triangles)


TOYS: dict[str, Callable[[Generator], Mesh]] = {
    "cone": _cone,
    "ring": _ring,
    "blocks": _blocks,
    "hand": _hand,
    "wedge": _wedge,
    "duck": _duck,
    "chair": _chair,
    "star": _star,
    "plush": _plush,
    "blob": _blob,
}
"""For each kind of object, the function that makes a random one."""
