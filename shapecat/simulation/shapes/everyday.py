"""Families of random everyday objects outside the categories: cutlery, clothes, bags, gadgets."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from shapecat.simulation.shapes.mesh import Mesh, join, standing
from shapecat.simulation.shapes.parts import ellipsoid, placed, rod
from shapecat.simulation.shapes.primitives import extrude, rounded_box, smooth_path, tube
from shapecat.simulation.shapes.randomness import log_uniform

__all__ = ["EVERYDAY", "any_side"]


def _cutlery(rng: Generator) -> Mesh:
    """Return a thin handle with a wide, flat end: a spoon, knife, spatula, brush or comb."""
    length = log_uniform(rng, 0.12, 0.32)
    head, start = rng.uniform(0.15, 0.45), rng.uniform(0.0, 0.06)
    t = np.linspace(0, 1, 24)
    handle = length * rng.uniform(0.02, 0.045) * (1 + 0.4 * rng.random() * np.cos(3 * t))
    inside = np.clip((t - 1 + head) / head, 0, 1)
    bulge = np.sin(np.pi * inside) ** rng.uniform(0.3, 1.0) * (inside > 0)
    radius = handle + length * rng.uniform(0.03, 0.12) * bulge
    bend = length * rng.uniform(-0.12, 0.12) * (t - 0.5) ** 2
    path = np.stack([length * t, bend, start * np.sin(np.pi * t) * length], -1)
    return standing(tube(path, radius, segments=12, flatness=rng.uniform(0.12, 0.5)))


def _cloth(rng: Generator) -> Mesh:
    """Return a crumpled sheet: clothes, a towel, a glove or wrapping."""
    side, count = log_uniform(rng, 0.08, 0.35), 22
    u, v = np.meshgrid(*[np.linspace(-0.5, 0.5, count)] * 2, indexing="ij")
    height = np.zeros(u.shape)
    for scale in (3.0, 7.0, 14.0):
        across, along = rng.normal(size=(2, 3)) * scale
        waves = np.sin(u[..., None] * across + v[..., None] * along + rng.uniform(0, 6, 3))
        height += (waves**2).sum(axis=-1) * rng.uniform(0.03, 0.12) / scale
    angle = np.arctan2(v, u)
    radius = 0.5 * (1 + 0.25 * np.sin(angle * rng.integers(2, 6) + rng.uniform(0, 6)))
    edge = np.clip(1.3 - np.hypot(u, v) / radius, 0, 1) ** 0.5
    heap = rng.uniform(0, 0.5) * np.exp(-8 * (u**2 + v**2))
    flat = np.minimum(1.0, radius / np.maximum(np.hypot(u, v), 1e-6))
    top = np.stack([u * flat, v * flat, (height + heap) * edge], -1) * side
    under = top * [1, 1, 0]
    row = np.arange(count - 1)[:, None] * count + np.arange(count - 1)[None]
    cells = np.stack([row, row + count, row + 1, row + count, row + count + 1, row + 1], -1)
    triangles = cells.reshape(-1, 3)
    return join([Mesh(top.reshape(-1, 3), triangles), Mesh(under.reshape(-1, 3), triangles)])


def _bag(rng: Generator) -> Mesh:
    """Return a filled bag, flat at its seams: a snack bag, pouch, sack or cushion."""
    half = np.array([log_uniform(rng, 0.04, 0.13), log_uniform(rng, 0.05, 0.16)])
    full = float(half.min()) * rng.uniform(0.25, 0.8)
    mesh = ellipsoid([1.0, 1.0, 1.0])
    points = np.asarray(mesh.vertices, np.float64)
    flat = np.linalg.norm(points[:, :2], axis=1, keepdims=True) + 1e-9
    square = rng.uniform(3, 8)
    norm = (np.abs(points[:, :2]) ** square).sum(axis=1, keepdims=True) ** (1 / square) + 1e-9
    outline = points[:, :2] * flat / norm * half
    waves = rng.normal(size=(5, 2)) * 40
    crease = np.sin(outline @ waves.T + rng.uniform(0, 6, 5)).mean(axis=1)
    tall = np.sign(points[:, 2]) * np.abs(points[:, 2]) ** rng.uniform(0.8, 1.6) * full
    tall *= 1 + rng.uniform(0.05, 0.35) * crease
    bag = Mesh(np.column_stack([outline, tall]), mesh.triangles)
    return standing(placed(bag, about="x", degrees=float(rng.choice([0, 0, 80]))))


def _gadget(rng: Generator) -> Mesh:
    """Return a body with knobs, lenses and aerials: a remote, camera, charger or radio."""
    size = np.array([log_uniform(rng, low, high) for low, high in _GADGET])
    parts = [rounded_box(size, radius=rng.uniform(0, 0.3) * float(size.min()), fine=2)]
    for _ in range(int(rng.integers(1, 6))):
        spot = [*(rng.uniform(-0.4, 0.4, 2) * size[:2]), 0.9 * size[2]]
        small = float(size[:2].min()) * rng.uniform(0.15, 0.5)
        kind = rng.integers(3)
        if kind == 0:
            part = rod(small * rng.uniform(0.3, 2.5), small / 2)
        elif kind == 1:
            part = rounded_box(small * rng.uniform(0.4, 2.0, 3), fine=1)
        else:
            part = ellipsoid(small * rng.uniform(0.3, 0.8, 3))
        parts.append(placed(part, spot))
    if rng.random() < 0.3:  # a lens or a plug at its side
        lens = rod(float(size[2]) * rng.uniform(0.3, 1.2), float(size[2]) * rng.uniform(0.2, 0.45))
        parts.append(placed(lens, [0, size[1] / 2, size[2] / 2], about="x", degrees=-90))
    return any_side(join(parts), rng)


_GADGET = ((0.05, 0.2), (0.03, 0.12), (0.012, 0.07))
"""Ranges of the size of a gadget's body in x, y and z, metres."""


def _power_tool(rng: Generator) -> Mesh:
    """Return a barrel with a grip and sometimes a foot: a drill, pistol or hair dryer."""
    long, thick = log_uniform(rng, 0.09, 0.22), log_uniform(rng, 0.012, 0.03)
    path = long * np.array([[0, 0, 0], [0.5, 0, 0], [1, 0, rng.uniform(-0.1, 0.1)]])
    width = thick * np.interp(np.linspace(0, 1, 12), [0, 0.3, 0.7, 1], rng.uniform(0.5, 1.2, 4))
    barrel = tube(smooth_path(path, 12), width, segments=10)
    grip_m = long * rng.uniform(0.4, 0.9)
    grip = rounded_box([thick * rng.uniform(0.9, 1.8), thick * rng.uniform(0.7, 1.3), grip_m])
    tilt = rng.uniform(150, 205)
    parts = [barrel, placed(grip, [rng.uniform(0, 0.4) * long, 0, 0], about="y", degrees=tilt)]
    if rng.random() < 0.5:
        foot = rounded_box(np.array([2.6, 2.0, 1.2]) * thick * rng.uniform(0.7, 1.4), fine=2)
        parts.append(placed(foot, [0.15 * long, 0, -grip_m - 0.4 * thick]))
    return standing(placed(join(parts), about="x", degrees=float(rng.choice([0, 90]))))


def _vehicle(rng: Generator) -> Mesh:
    """Return a body with a cabin and wheels: a toy car, train or cart."""
    long = log_uniform(rng, 0.05, 0.2)
    wide, tall = long * rng.uniform(0.3, 0.6), long * rng.uniform(0.12, 0.3)
    wheel = long * rng.uniform(0.07, 0.16)
    body = placed(rounded_box([long, wide, tall], radius=0.1 * tall, fine=2), [0, 0, wheel])
    cabin = rounded_box([long * rng.uniform(0.25, 0.6), 0.9 * wide, tall * rng.uniform(0.6, 1.8)])
    parts = [body, placed(cabin, [rng.uniform(-0.2, 0.2) * long, 0, wheel + tall])]
    for x in (-0.3, 0.3):
        axle = rod(wide * 1.15, wheel)
        parts.append(placed(axle, [x * long, 0.575 * wide, wheel], about="x", degrees=90))
    return join(parts)


def _fixture(rng: Generator) -> Mesh:
    """Return a bent profile: a bracket, pipe elbow, hook, stand or clamp."""
    arm = log_uniform(rng, 0.03, 0.11)
    if rng.random() < 0.5:
        radius = arm * rng.uniform(0.12, 0.4)
        bend = arm * np.array([[0, 0, 0], [1, 0, 0], [1.6, 0.4, 0], [1.6, 1.4, 0]])
        return standing(tube(smooth_path(bend, 16), radius, segments=14))
    thick = arm * rng.uniform(0.1, 0.4)
    long, other = arm * rng.uniform(1, 2.2), arm * rng.uniform(0.6, 1.6)
    foot = rounded_box([long, arm * rng.uniform(0.4, 1.4), thick], fine=2)
    wall = rounded_box([thick, arm * rng.uniform(0.4, 1.4), other], fine=2)
    place = [rng.choice([-0.5, -0.2, 0.0]) * long, 0, 0]
    parts = [foot, placed(wall, place)]
    if rng.random() < 0.4:
        rib = extrude([[0, 0], [0.4 * long, 0], [0, 0.6 * other]], thick)
        parts.append(placed(rib, [0, thick / 2, thick], about="x", degrees=90))
    return any_side(join(parts), rng)


def any_side(mesh: Mesh, rng: Generator) -> Mesh:
    """Turn a mesh by 0, 90 or 180 degrees about x or y, at random, and stand it on z = 0."""
    about, degrees = str(rng.choice(["x", "y"])), float(rng.choice([0, 0, 90, 180]))
    return standing(placed(mesh, about=about, degrees=degrees))


EVERYDAY: dict[str, Callable[[Generator], Mesh]] = {
    "cutlery": _cutlery,
    "cloth": _cloth,
    "bag": _bag,
    "gadget": _gadget,
    "power_tool": _power_tool,
    "vehicle": _vehicle,
    "fixture": _fixture,
}
"""For each family of objects, the function that makes a random one."""
