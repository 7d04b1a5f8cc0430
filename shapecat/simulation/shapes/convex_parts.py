"""Approximate convex decomposition of meshes for a physics engine; hollow objects stay hollow."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import ConvexHull

from shapecat.arrays import F8
from shapecat.simulation.shapes.mesh import Mesh

__all__ = ["convex_parts", "hollowness"]

_PITCH_M = 0.004
"""Distance between samples of a surface."""
_BLOCKS = 4
"""Number of blocks along each axis of a hollow mesh; a wall is nearly flat within a block."""
_SKIN_M = 0.001
"""Half the minimum thickness of a part: physics engines reject solids without volume."""
_HOLLOW = 0.2
"""Minimum hollowness of a mesh that is cut into blocks."""
_COLUMNS = 9
"""Number of columns along x and along y in which the hollowness is measured."""


def convex_parts(mesh: Mesh) -> list[F8]:
    """Decompose a mesh into convex solids; return the corners (k, 3) of each, in metres.

    A mesh without an opening at its top becomes one solid, its convex hull. The walls of an open
    mesh are cut into blocks, so that an object can fall into a cup.
    """
    points = np.asarray(mesh.vertices, np.float64)
    if hollowness(mesh) < _HOLLOW:
        return [_thickened(_corners(points, _ALL_AROUND))]
    return list(_blocks(_samples(mesh)))


def hollowness(mesh: Mesh) -> float:
    """Return the fraction (0 to 1) of the convex hull's volume that is empty and open above."""
    points, hull = _samples(mesh), ConvexHull(mesh.vertices)
    low = hull.min_bound
    size = np.maximum(hull.max_bound - low, 1e-9)
    column = np.minimum(((points - low) / size * _COLUMNS).astype(int), _COLUMNS - 1)
    top = np.full((_COLUMNS, _COLUMNS), low[2])
    np.maximum.at(top, (column[:, 0], column[:, 1]), points[:, 2])
    step = size[:2] / _COLUMNS
    positions = low[:2] + (np.indices((_COLUMNS, _COLUMNS)).reshape(2, -1).T + 0.5) * step
    upper, lower = _span(hull, positions)
    covered = upper > lower
    open_m = np.clip(upper - np.maximum(top.reshape(-1), lower), 0, None)[covered]
    return float(open_m.sum() / max((upper - lower)[covered].sum(), 1e-12))


def _span(hull: ConvexHull, positions: F8) -> tuple[F8, F8]:
    """Return the upper and lower z (n,) of a hull at positions (n, 2); upper < lower outside it."""
    upward = hull.equations[:, 2]
    flat = np.column_stack([positions, np.ones(len(positions))])
    across = flat @ hull.equations[:, [0, 1, 3]].T
    level = np.abs(upward) < 1e-9
    limit = -across / np.where(level, 1.0, upward)
    upper = np.where(upward > 0, limit, np.inf).min(axis=1, where=~level, initial=np.inf)
    lower = np.where(upward < 0, limit, -np.inf).max(axis=1, where=~level, initial=-np.inf)
    upper[(across[:, level] > 0).any(axis=1)] = -np.inf
    return upper, lower


def _samples(mesh: Mesh) -> F8:
    """Return sample points (n, 3) of the whole surface, at most about `_PITCH_M` apart.

    They are farther apart in triangles with a side longer than 100 times `_PITCH_M`.
    """
    corners = np.asarray(mesh.vertices, np.float64)[mesh.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    counts = np.ceil(longest / _PITCH_M).astype(int).clip(1, 100)
    samples = [np.asarray(mesh.vertices, np.float64)]
    for n in np.unique(counts):
        i, j = np.triu_indices(n + 1)
        weights = np.stack([i, j - i, n - j], -1) / n
        samples.append((weights @ corners[counts == n]).reshape(-1, 3))
    return np.concatenate(samples)


def _blocks(points: F8) -> Iterator[F8]:
    """Divide points (n, 3) into the blocks of a grid; yield the corners (k, 3) of a solid for each.

    The solid of a block is the convex hull of its points, thickened.
    """
    low = points.min(axis=0)
    side = np.maximum((points.max(axis=0) - low) / _BLOCKS, 4 * _SKIN_M)
    cell = np.minimum(((points - low) / side).astype(int), _BLOCKS - 1)
    number = np.ravel_multi_index(tuple(cell.T), (_BLOCKS,) * 3)
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    for part in np.split(points[order], starts[1:]):
        yield _thickened(_corners(part, _AXES))


def _thickened(points: F8) -> F8:
    """Thicken points (n, 3) to at least twice `_SKIN_M` in all directions; return (m, 3)."""
    for _ in range(3):  # a plane, a line, or a point
        middle = points.mean(axis=0)
        normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
        across = (points - middle) @ normal
        if np.ptp(across) > 2 * _SKIN_M:
            break
        flat = points - across[:, None] * normal
        points = np.concatenate([flat - _SKIN_M * normal, flat + _SKIN_M * normal])
    return points


def _corners(points: F8, directions: F8) -> F8:
    """Return the points (k, 3) that are farthest along one of the directions (m, 3)."""
    return np.asarray(points[np.unique((points @ directions.T).argmax(axis=0))])


def _sphere(count: int) -> F8:
    """Return unit vectors (count, 3) spread over the sphere (Fibonacci spiral)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1)


_AXES = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 3).astype(float)
_ALL_AROUND = np.concatenate([_AXES, _sphere(100)])
"""Directions in which to look for the corners of a hull; `_AXES` finds all corners of a box."""
