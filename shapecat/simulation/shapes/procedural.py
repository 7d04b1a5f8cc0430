"""Procedural objects outside the categories, for a wide variety of *unknown* shapes."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.simulation.shapes.everyday import EVERYDAY, any_side
from shapecat.simulation.shapes.mesh import Mesh, join, moved, standing
from shapecat.simulation.shapes.parts import ellipsoid, placed, rod
from shapecat.simulation.shapes.primitives import extrude, lathe, rounded_box, smooth_path, tube
from shapecat.simulation.shapes.randomness import log_uniform, random_rotation
from shapecat.types import Pose

__all__ = ["PROCEDURAL"]


def _assembly(rng: Generator) -> Mesh:
    """Return three to five intersecting solids of different kinds: a machine, toy or fitting."""
    size = log_uniform(rng, 0.03, 0.09)
    parts, place = [], np.zeros(3)
    for _ in range(int(rng.integers(3, 6))):
        body = _body(rng, size * rng.uniform(0.35, 1.0))
        parts.append(moved(body, Pose(random_rotation(rng), place)))
        points = np.asarray(parts[-1].vertices, np.float64)
        place = points[int(rng.integers(len(points)))] * rng.uniform(0.6, 1.0)
    return join(parts)


def _body(rng: Generator, size: float) -> Mesh:
    kind = rng.integers(4)
    if kind == 0:
        return rounded_box(size * rng.uniform(0.3, 1.6, 3), radius=0.002)
    if kind == 1:
        return rod(size * rng.uniform(0.6, 3.0), size * rng.uniform(0.1, 0.5))
    if kind == 2:
        return ellipsoid(size * rng.uniform(0.25, 0.8, 3))
    return lathe(
        [[0, 0], [size * rng.uniform(0.2, 0.8), 0], [size * rng.uniform(0.1, 0.6), size], [0, size]]
    )


def _bent_rod(rng: Generator) -> Mesh:
    """Return a rod of varying width along a bent path: a tool, cutlery, fruit or cable."""
    length = log_uniform(rng, 0.1, 0.32)
    steps = rng.normal(size=(int(rng.integers(3, 7)), 3)) * [0.5, 0.5, 0.15]
    steps[:, 0] = np.abs(steps[:, 0]) + rng.uniform(0.1, 1.2)
    path = smooth_path(np.cumsum(steps, axis=0), 24)
    path *= length / np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    knots = rng.uniform(0.3, 1.0, (5, 1))
    width = np.interp(np.linspace(0, 4, 24), np.arange(5), knots[:, 0])
    radius = length * rng.uniform(0.03, 0.12) * width
    flat = float(rng.choice([1.0, rng.uniform(0.15, 0.8)]))
    return standing(tube(path, radius, segments=12, flatness=flat))


def _slab(rng: Generator) -> Mesh:
    """Return a slab with an irregular outline: a gadget, a lying tool or part of a package."""
    corners = int(rng.choice([3, 5, 6, 7, 8, 9, 11, 13]))
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners)) + rng.uniform(0, 6)
    radius = log_uniform(rng, 0.03, 0.1) * rng.uniform(0.25, 1.0, corners)
    outline: F8 = np.stack([np.cos(angle), np.sin(angle)], -1) * radius[:, None]
    if rng.random() < 0.5:
        outline = smooth_path(np.concatenate([outline, outline[:1]]), 40)[:-1]
    return extrude(outline * [1, rng.uniform(0.4, 1.0)], log_uniform(rng, 0.008, 0.09))


def _lump(rng: Generator) -> Mesh:
    """Return a lump with bumps of several wavelengths: a stone, bread, clothes or a bag."""
    ball = ellipsoid(log_uniform(rng, 0.025, 0.08) * rng.uniform(0.35, 1.4, 3))
    points = np.asarray(ball.vertices, np.float64)
    unit = points / (np.linalg.norm(points, axis=1, keepdims=True) + 1e-12)
    swell = np.zeros(len(points))
    for scale in (1.5, 3.0, 6.0):
        waves = rng.normal(size=(4, 3)) * scale
        height = rng.uniform(0.05, 0.35) / scale
        swell += height * np.sin(unit @ waves.T + rng.uniform(0, 6, 4)).sum(axis=1)
    return Mesh(points * np.maximum(1 + swell, 0.3)[:, None], ball.triangles)


def _turned(rng: Generator) -> Mesh:
    """Return a solid of revolution with bulges and waists: a chess piece, lamp, vase or top."""
    height = log_uniform(rng, 0.05, 0.25)
    count = int(rng.integers(5, 9))
    wide = (np.arange(count) + rng.integers(2)) % 2  # bulges and waists alternate
    radius = height * log_uniform(rng, 0.15, 0.6) * np.where(wide, 1.0, 0.35)
    radius *= rng.uniform(0.6, 1.3, count)
    levels = np.linspace(0, height, count)
    path = smooth_path(np.column_stack([radius, levels]), 30)
    path[:, 0] = np.maximum(path[:, 0], 0.004)
    closed = np.concatenate([[[0, 0]], path, [[0, path[-1, 1]]]])
    squareness = float(rng.choice([2.0, 2.0, rng.uniform(2.5, 6)]))
    return lathe(closed, squareness=squareness, stretch=rng.uniform(0.5, 1.0))


def _branched(rng: Generator) -> Mesh:
    """Return a body with limbs: a plant, animal, tap or clamp."""
    size = log_uniform(rng, 0.02, 0.05)
    parts = [ellipsoid(size * rng.uniform(0.4, 1.2, 3))]
    for _ in range(int(rng.integers(2, 7))):
        steps = rng.normal(size=(3, 3)) * size * rng.uniform(0.5, 1.5)
        path = smooth_path(np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), 10)
        width = np.linspace(rng.uniform(0.15, 0.5), rng.uniform(0.1, 0.4), 10) * size
        parts.append(tube(path, width, segments=8))
    return join(parts)


def _frame(rng: Generator) -> Mesh:
    """Return a distorted ring, crossed by up to two rods: glasses, a handle, wire or tape."""
    t = np.arange(40) * (2 * np.pi / 40)
    radius = log_uniform(rng, 0.03, 0.09) * (
        1 + rng.uniform(0, 0.4) * np.cos(int(rng.integers(2, 5)) * t + rng.uniform(0, 6))
    )
    height = rng.uniform(0, 0.3) * radius * np.sin(2 * t)
    path = np.stack([radius * np.cos(t), radius * np.sin(t) * rng.uniform(0.4, 1), height], -1)
    wire = float(radius.mean()) * rng.uniform(0.06, 0.3)
    parts = [tube(path, wire, segments=10, closed=True)]
    for _ in range(int(rng.integers(0, 3))):
        ends = path[rng.integers(0, 40, 2)]
        ends[1] += rng.normal(size=3) * radius.mean() * rng.uniform(0.05, 1)
        parts.append(tube(smooth_path(ends + 1e-4 * rng.normal(size=(2, 3)), 6), wire, segments=8))
    return join(parts)


def _block(rng: Generator) -> Mesh:
    """Return a building block other than a box: a prism, part of a disc, cross, L, T or bridge."""
    size, kind = log_uniform(rng, 0.018, 0.05), rng.integers(4)
    thick = size * log_uniform(rng, 0.5, 2.0)
    if kind == 0:
        corners = int(rng.choice([3, 5]))
        angle = np.arange(corners) * (2 * np.pi / corners)
        outline: F8 = np.stack([np.cos(angle), np.sin(angle)], -1) * [1, rng.uniform(0.7, 1.3)]
    elif kind == 1:
        angle = np.linspace(0, np.pi * rng.choice([0.5, 1.0]), 16)
        outline = np.stack([np.append(np.cos(angle), 0), np.append(np.sin(angle), 0)], -1)
    elif kind == 2:
        a = rng.uniform(0.25, 0.5)
        quarter: F8 = np.array([[1, -a], [1, a], [a, a]])
        turns = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        outline = np.concatenate([quarter @ turn.T for turn in turns])
    else:
        bar = rounded_box(2 * size * np.array([1, rng.uniform(0.25, 0.5), thick / size / 2]))
        leg = rounded_box(2 * size * np.array([rng.uniform(0.25, 0.5), 1, thick / size / 2]))
        ends = [[[-0.7, 0.6]], [[0, 0.6]], [[-0.7, 0.6], [0.7, 0.6]]][int(rng.integers(3))]
        legs = [placed(leg, [x * size, y * size, 0]) for x, y in ends]
        return any_side(join([bar, *legs]), rng)
    return any_side(extrude(size * outline, thick), rng)


PROCEDURAL: dict[str, Callable[[Generator], Mesh]] = {
    "assembly": _assembly,
    "bent_rod": _bent_rod,
    "slab": _slab,
    "lump": _lump,
    "turned": _turned,
    "branched": _branched,
    "frame": _frame,
    "block": _block,
    **EVERYDAY,
}
"""For each family of objects, the function that makes a random one."""
