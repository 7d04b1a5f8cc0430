"""Mesh primitives: solids of revolution, tubes, extruded outlines, rounded boxes."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F8, I4
from shapecat.simulation.shapes.mesh import Mesh, join, standing

__all__ = ["Points", "extrude", "lathe", "rounded_box", "smooth_path", "tube"]

Points: TypeAlias = F8 | Sequence[Sequence[float]]
"""Coordinates (n, d), one point per row."""


def _grid(rows: int, columns: int, *, closed: bool) -> I4:
    """Return triangles (m, 3) of a grid of vertices, row by row; if ``closed``, rows are rings."""
    row = np.arange(rows - 1)[:, None] * columns
    column = np.arange(columns if closed else columns - 1)[None]
    after = (column + 1) % columns
    a, b = row + column, row + after
    c, d = a + columns, b + columns
    return np.stack([a, b, c, b, d, c], -1).reshape(-1, 3).astype(np.int32)


def lathe(
    profile: Points,
    *,
    segments: int = 40,
    stretch: float = 1.0,
    squareness: float = 2.0,
    turn: float = 0.0,
) -> Mesh:
    """Make a solid of revolution about the z axis.

    Parameters
    ----------
    profile : (k, 2) radius and z, metres, along the surface.
    segments : number of corners of the cross-section.
    stretch : size of the cross-section along y divided by that along x.
    squareness : exponent of the superellipse: 2 is round, 6 a square with rounded corners.
    turn : angle of the first corner, radians.
    """
    profile = np.asarray(profile, np.float64)
    angle = turn + np.arange(segments) * (2 * np.pi / segments)
    c, s = np.cos(angle), np.sin(angle)
    if squareness != 2.0:
        norm = (np.abs(c) ** squareness + np.abs(s) ** squareness) ** (-1 / squareness)
        c, s = c * norm, s * norm
    ring = np.stack([c, s * stretch], -1)
    points = np.zeros((len(profile), segments, 3))
    points[..., :2] = profile[:, None, :1] * ring
    points[..., 2] = profile[:, 1:]
    return Mesh(points.reshape(-1, 3), _grid(len(profile), segments, closed=True))


def tube(
    path: Points,
    radius: ArrayLike,
    *,
    segments: int = 10,
    flatness: float = 1.0,
    closed: bool = False,
) -> Mesh:
    """Sweep an ellipse along a path.

    Parameters
    ----------
    path : (k, 3) metres.
    radius : radius in the plane of the path, metres: a number, or one per point (k,).
    segments : number of corners of the cross-section.
    flatness : radius perpendicular to the plane of the path, divided by the radius in the plane.
    closed : whether the path is a ring; if not, the ends are capped.
    """
    path = np.asarray(path, np.float64)
    k = len(path)
    along = (
        np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
        if closed
        else np.gradient(path, axis=0)
    )
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = _across(path, along)
    inward = np.cross(across, along)
    angle = np.arange(segments) * (2 * np.pi / segments)
    wide = np.broadcast_to(np.asarray(radius, np.float64), (k,))[:, None, None]
    offsets = (
        np.cos(angle)[:, None] * inward[:, None]
        + flatness * np.sin(angle)[:, None] * across[:, None]
    )
    rings = path[:, None] + wide * offsets
    if closed:
        rings = np.concatenate([rings, rings[:1]])
    else:
        ends = [np.repeat(path[[end], None], segments, axis=1) for end in (0, -1)]
        rings = np.concatenate([ends[0], rings, ends[1]])
    return Mesh(rings.reshape(-1, 3), _grid(len(rings), segments, closed=True))


def _across(path: F8, along: F8) -> F8:
    """Return unit vectors (k, 3) perpendicular to a path, with minimal rotation along it.

    For a path in a plane, they are normals of the plane. ``path`` (k, 3) are the points of the
    path, ``along`` (k, 3) its unit directions.
    """
    spread = np.linalg.svd(path - path.mean(axis=0), full_matrices=False)[2]
    start = spread[-1] if abs(spread[-1] @ along[0]) < 0.9 else spread[0]
    if start[np.argmax(np.abs(start))] < 0:  # the sign of a singular vector is free
        start = -start
    result = np.zeros_like(path)
    for i, direction in enumerate(along):
        start = start - (start @ direction) * direction
        start = start / np.linalg.norm(start)
        result[i] = start
    return result


def smooth_path(points: Points, count: int = 16) -> F8:
    """Return ``count`` points of a smooth curve (Catmull-Rom) through the given (k, d) points."""
    p = np.asarray(points, np.float64)
    p = np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
    t = np.linspace(0, len(p) - 3, count)
    i = np.minimum(t.astype(int), len(p) - 4)
    t = (t - i)[:, None]
    a, b, c, d = p[i], p[i + 1], p[i + 2], p[i + 3]
    return np.asarray(
        0.5
        * (
            2 * b
            + (c - a) * t
            + (2 * a - 5 * b + 4 * c - d) * t**2
            + (3 * b - a - 3 * c + d) * t**3
        )
    )


def rounded_box(size: ArrayLike, *, radius: float = 0.0, bulge: float = 0.0, fine: int = 4) -> Mesh:
    """Make a box with rounded edges that stands on z = 0.

    Parameters
    ----------
    size : (3,) metres.
    radius : radius of the edges, metres, limited to 0.225 times the smallest size; edges are sharp
        if it is at most 0.2 mm.
    bulge : outward displacement of the middle of each side face, metres.
    fine : number of mesh cells along the flat part of a face.
    """
    half = np.asarray(size, np.float64) / 2
    radius = min(radius, 0.45 * float(half.min()))
    radius = radius if radius > 2e-4 else 0.0  # sharp
    sides = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        s, t = _box_lines(half[a], radius, fine), _box_lines(half[b], radius, fine)
        points = np.zeros((s.size, t.size, 3))
        points[..., a], points[..., b] = s[:, None], t[None]
        for sign in (-1.0, 1.0):
            points[..., axis] = sign * half[axis]
            sides.append(Mesh(points.reshape(-1, 3), _grid(s.size, t.size, closed=False)))
    mesh = join(sides)
    points = np.asarray(mesh.vertices, np.float64)
    core = np.clip(points, radius - half, half - radius)
    if radius > 0:
        outward = points - core
        points = core + radius * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    if bulge:
        dome = np.cos(np.pi / 2 * np.clip(core / half, -1, 1))[:, 2]
        for axis, other in ((0, 1), (1, 0)):
            face = np.abs(np.abs(points[:, axis]) - half[axis]) < 1e-9
            lift = dome * np.cos(np.pi / 2 * core[:, other] / half[other])
            points[:, axis] += face * np.sign(points[:, axis]) * bulge * lift
    return standing(Mesh(points, mesh.triangles))


def _box_lines(half: float, radius: float, fine: int) -> F8:
    """Return the coordinates (n,) of the mesh lines on a face, dense where the edges are round.

    They are ascending from -``half`` to ``half``; ``radius`` and ``fine`` are as for `rounded_box`.
    """
    flat = np.linspace(radius - half, half - radius, fine + 1)
    if radius <= 0:
        return flat
    turn = radius * (1 - np.tan(np.pi / 4 * np.array([1.0, 0.66, 0.33])))
    # These points on the square edge, seen from the centre of the arc, are at equal angles.
    edge = np.sort(radius - turn)[::-1]
    return np.concatenate([-(half - radius) - edge, flat, (half - radius + edge)[::-1]])


def extrude(outline: Points, height: float) -> Mesh:
    """Extrude a flat outline from z = 0 to ``height``.

    Parameters
    ----------
    outline : (k, 2) corners in order, metres; star-shaped about their mean.
    height : metres.
    """
    outline = np.asarray(outline, np.float64)
    middle = outline.mean(axis=0)
    rings = np.zeros((4, len(outline), 3))
    rings[..., :2] = np.stack([np.tile(middle, (len(outline), 1)), outline, outline, outline])
    rings[3, :, :2] = middle
    rings[2:, :, 2] = height
    return Mesh(rings.reshape(-1, 3), _grid(4, len(outline), closed=True))
