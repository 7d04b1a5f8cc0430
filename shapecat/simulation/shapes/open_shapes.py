"""Hollow shapes: cups, bowls and plates, which differ in the ratio of depth to diameter."""

from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from shapecat.arrays import F8
from shapecat.simulation.shapes.mesh import Mesh, join, standing
from shapecat.simulation.shapes.primitives import lathe, smooth_path, tube
from shapecat.simulation.shapes.randomness import log_uniform, with_random_yaw

__all__ = ["make_bowl", "make_cup", "make_plate"]


def make_cup(rng: Generator) -> Mesh:
    """Make a cup: a mug, glass, beaker or teacup, deeper than 0.65 times its diameter."""
    family = rng.choice(
        ["mug", "glass", "beaker", "teacup", "barrel", "espresso"],
        p=[0.34, 0.2, 0.1, 0.14, 0.14, 0.08],
    )
    ratio, radii = {
        "mug": (rng.uniform(0.85, 1.35), [rng.uniform(0.85, 1.0), rng.uniform(0.97, 1.02), 1.0]),
        "glass": (rng.uniform(1.0, 2.1), [rng.uniform(0.62, 1.0), rng.uniform(0.85, 1.0), 1.0]),
        "beaker": (rng.uniform(1.2, 2.3), [rng.uniform(0.6, 0.85), rng.uniform(0.8, 0.93), 1.0]),
        "teacup": (rng.uniform(0.74, 0.95), [rng.uniform(0.4, 0.65), rng.uniform(0.78, 0.98), 1.0]),
        "barrel": (rng.uniform(0.8, 1.4), [rng.uniform(0.7, 0.9), 1.0, rng.uniform(0.82, 0.98)]),
        "espresso": (rng.uniform(0.76, 1.1), [rng.uniform(0.6, 0.95), rng.uniform(0.85, 1), 1.0]),
    }[str(family)]
    diameter = (
        log_uniform(rng, 0.045, 0.07) if family == "espresso" else log_uniform(rng, 0.06, 0.115)
    )
    diameter = min(diameter, 0.2 / ratio)
    wall = rng.uniform(0.0015, 0.006) * min(1.0, diameter / 0.06)
    floor, foot = wall * rng.uniform(1, 2.5), _foot(rng, 0.3, 0.004)
    height = ratio * diameter + floor + foot[1]
    outer = _wall(radii, diameter / 2, height, power=rng.uniform(0.8, 1.2))
    profile = _hollow(outer, wall, floor=floor, foot=foot)
    section = _section(rng, oval=0.03, square=0.05, facets=0.06)
    body = lathe(profile, **section)
    handle = {
        "mug": 0.85,
        "glass": 0.08,
        "beaker": 0.1,
        "teacup": 0.85,
        "barrel": 0.75,
        "espresso": 0.8,
    }
    if rng.random() < handle[str(family)]:
        sides = [0.0, np.pi] if rng.random() < 0.04 else [0.0]
        shape = _handle_shape(rng, diameter, height)
        body = join([body, *(_handle(outer, shape, wall, side) for side in sides)])
    return standing(with_random_yaw(body, rng))


def make_bowl(rng: Generator) -> Mesh:
    """Make a bowl, ramekin or basin, with a depth of 0.2 to 0.65 times its diameter."""
    family = rng.choice(
        ["round", "cone", "flared", "straight", "tulip"], p=[0.38, 0.2, 0.17, 0.15, 0.1]
    )
    ratio = rng.uniform(0.42, 0.6) if rng.random() < 0.35 else rng.uniform(0.23, 0.45)
    base = {
        "round": rng.uniform(0.25, 0.5),
        "cone": rng.uniform(0.35, 0.65),
        "flared": rng.uniform(0.3, 0.5),
        "straight": rng.uniform(0.75, 0.98),
        "tulip": rng.uniform(0.4, 0.6),
    }[str(family)]
    straight = 0.5 * (1 + base)
    middle = {
        "round": rng.uniform(min(straight + 0.1, 0.9), 0.97),
        "cone": straight + rng.uniform(-0.02, 0.04),
        "flared": straight - rng.uniform(0.02, 0.1),
        "straight": straight,
        "tulip": rng.uniform(0.9, 1.02),
    }[str(family)]
    diameter = log_uniform(rng, 0.075, 0.3)
    wall = max(0.0015, diameter * rng.uniform(0.01, 0.035))
    bottom = wall * rng.uniform(1.0, 1.6)
    foot = _foot(rng, 0.4, 0.01)
    height = ratio * diameter + bottom + foot[1]
    outer = _wall([base, middle, 1.0], diameter / 2, height, power=1.0)
    rim = rng.random() < 0.15 and ratio < 0.4
    profile = _hollow(outer, wall, floor=bottom, foot=foot, lip=diameter * 0.06 if rim else 0.0)
    section = _section(rng, oval=0.06, square=0.07, facets=0.03)
    return standing(with_random_yaw(lathe(profile, **section), rng))


def make_plate(rng: Generator) -> Mesh:
    """Make a plate, saucer or shallow dish, with a depth of at most 0.2 times its diameter."""
    family = rng.choice(["rimmed", "coupe", "flat", "deep"], p=[0.4, 0.22, 0.2, 0.18])
    diameter = log_uniform(rng, 0.11, 0.34)
    ratio = {
        "rimmed": rng.uniform(0.06, 0.14),
        "coupe": rng.uniform(0.06, 0.16),
        "flat": rng.uniform(0.03, 0.09),
        "deep": rng.uniform(0.12, 0.18),
    }[str(family)]
    wall = max(0.0015, diameter * rng.uniform(0.008, 0.022))
    radius, depth = diameter / 2, ratio * diameter
    well = rng.uniform(0.55, 0.75)
    inner = {
        "rimmed": [(0, 0), (well - 0.1, 0), (well, 0.08), (well + 0.07, 0.55), (1, 1)],
        "coupe": [(0, 0), (0.45, 0.06), (0.75, 0.3), (0.92, 0.7), (1, 1)],
        "flat": [(0, 0), (0.8, 0), (0.93, 0.06), (0.98, 0.5), (1, 1)],
        "deep": [(0, 0), (0.42, 0), (0.6, 0.2), (0.72, 0.7), (1, 1)],
    }[str(family)]
    top = smooth_path(inner, 18) * [radius, depth]
    top[:, 1] = np.maximum.accumulate(np.maximum(top[:, 1], 0))
    top[:, 0] = np.maximum.accumulate(top[:, 0])
    under = top - [0, wall]
    if rng.random() < 0.6:  # a foot ring
        ring, tall = radius * rng.uniform(0.4, 0.65), radius * rng.uniform(0.02, 0.05)
        at = int(np.searchsorted(under[:, 0], ring))
        foot = under[at] + [[0, -tall - 0.1 * depth], [wall, -tall - 0.1 * depth], [wall, 0]]
        under = np.concatenate([under[: at + 1], foot, under[at + 1 :]])
    profile = np.concatenate([under, top[::-1]])
    section = _section(rng, oval=0.08, square=0.13, facets=0.02)
    return standing(with_random_yaw(standing(lathe(profile, **section)), rng))


def _wall(radii: ArrayLike, radius: float, height: float, *, power: float) -> F8:
    """Return the outer profile of a vessel from bottom to top: radius and z (m, 2), metres.

    ``radii`` (k,), from bottom to top, are scaled so that the largest is ``radius``. They are
    evenly spaced in height for a ``power`` of 1, and closer to the bottom for a larger one.
    """
    radii = np.asarray(radii, np.float64)
    heights = np.linspace(0, 1, len(radii)) ** power
    path = smooth_path(np.stack([radii, heights], -1), 14)
    path[:, 0] = path[:, 0] / path[:, 0].max() * radius
    path[:, 1] = (
        np.linspace(0, height, len(path))
        if np.any(np.diff(path[:, 1]) <= 0)
        else (path[:, 1] * height)
    )
    return path


def _foot(rng: Generator, chance: float, tallest: float) -> tuple[float, float]:
    """Draw a foot ring: its radius relative to the bottom's radius, and its height in metres.

    There is one with probability ``chance``, at most ``tallest`` high; otherwise, the height is 0.
    """
    if rng.random() >= chance:
        return 1.0, 0.0
    return rng.uniform(0.7, 0.95), rng.uniform(0.3, 1.0) * tallest


def _hollow(
    outer: F8, wall: float, *, floor: float, foot: tuple[float, float], lip: float = 0.0
) -> F8:
    """Return the closed profile of a vessel, radius and z (m, 2): foot, outside, rim, inside.

    ``outer`` is from `_wall` and ``foot`` from `_foot`. ``wall`` and ``floor`` are thicknesses,
    ``lip`` is the width of a flared rim, all in metres.
    """
    share, tall = foot
    bottom = outer[0, 0]
    outside = outer.copy()
    outside[:, 1] = tall + (outside[:, 1] - outside[0, 1]) * (1 - tall / outer[-1, 1])
    start = [[0.0, tall], [0.0, tall]]
    if tall > 0:
        ring = bottom * share
        inner = max(ring - max(0.003, wall), 0.0)
        start = [[0, 0.5 * tall], [inner, 0.5 * tall], [inner, 0], [ring, 0], [ring, tall]]
    inside = outside[outside[:, 1] > tall + floor] - [wall, 0]
    inside[:, 0] = np.maximum(inside[:, 0], 0.2 * bottom)
    low = np.interp(tall + floor, outside[:, 1], outside[:, 0]) - wall
    corner = min(0.25 * low, 0.004)
    rim = outside[-1]
    edge = [[rim[0] + lip, rim[1]], [rim[0] + lip, rim[1] - 0.6 * wall]] if lip else []
    top = [[rim[0] - 0.5 * wall, rim[1] + 0.3 * wall]]
    end = [[low, tall + floor + corner], [low - corner, tall + floor], [0.0, tall + floor]]
    inside = inside[inside[:, 1] > tall + floor + corner]
    parts: list[Any] = [start, outside, edge[::-1], top, inside[::-1], end]
    return np.concatenate([np.reshape(part, (-1, 2)) for part in parts])


def _section(rng: Generator, *, oval: float, square: float, facets: float) -> dict[str, Any]:
    """Draw a cross-section, mostly a round one; return it as keyword arguments of `lathe`.

    ``oval``, ``square`` and ``facets`` are the probabilities of an oval, a rounded square and a
    polygon.
    """
    kind = rng.random()
    if kind < oval:
        return {"stretch": rng.uniform(0.7, 0.95)}
    if kind < oval + square:
        return {"squareness": rng.uniform(3.5, 8.0), "segments": 48}
    if kind < oval + square + facets:
        return {"segments": int(rng.integers(6, 13))}
    return {}


def _handle_shape(rng: Generator, diameter: float, height: float) -> tuple[F8, float, float]:
    """Draw a handle for a cup of this size: its curve (k, 2), and radius and flatness for `tube`.

    The columns of the curve are the distance from the wall and the height above the middle of the
    cup, metres.
    """
    tall = height * rng.uniform(0.25, 0.4)
    depth = diameter * rng.uniform(0.2, 0.42)
    curves = (
        [(-0.12, 1), (0.55, 1.0), (1, 0.55), (1, -0.5), (0.55, -0.95), (-0.12, -0.9)],  # D
        [(-0.1, 0.95), (0.7, 1.0), (1.05, 0.35), (0.75, -0.3), (-0.1, -0.9)],  # ear
        [(-0.1, 0.9), (0.95, 0.98), (1.0, -0.95), (-0.1, -0.9)],  # square
    )
    curve = np.array(curves[int(rng.integers(len(curves)))]) * [depth, tall]
    radius = float(np.clip(diameter * rng.uniform(0.045, 0.085), 0.003, 0.01))
    lifted = height * rng.uniform(-0.02, 0.08)
    curve[:, 1] += min(lifted, 0.43 * height - radius - curve[:, 1].max())
    return smooth_path(curve, 16), radius, rng.uniform(0.8, 1.8)


def _handle(outer: F8, shape: tuple[F8, float, float], wall: float, side: float) -> Mesh:
    """Return a handle at the angle ``side`` about z, radians, of a cup's wall.

    ``outer`` is the outer profile of the wall, from `_wall`, and ``wall`` its thickness, metres;
    ``shape`` is from `_handle_shape`.
    """
    curve, radius, flatness = shape
    height = curve[:, 1] + outer[-1, 1] / 2
    ends = np.interp(height[[0, -1]], outer[:, 1], outer[:, 0]) - 0.5 * wall
    start = np.interp(np.linspace(0, 1, len(curve)), [0, 1], ends)
    from_axis = start + np.maximum(curve[:, 0], 0)
    points = np.stack([from_axis * np.cos(side), from_axis * np.sin(side), height], -1)
    return tube(points, radius, segments=8, flatness=flatness)
