"""Scanned and CAD meshes: read from PLY, stood upright whatever their axes."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from shapecat.arrays import F8, I4
from shapecat.errors import ConfigError, RecordingError
from shapecat.simulation.mesh import Mesh, moved, standing
from shapecat.simulation.placement import Rest, rests
from shapecat.simulation.render import geometry, render
from shapecat.types import Camera, Pose

__all__ = ["fill_ratio", "load_mesh", "upright_poses", "uprighted"]

_AXES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    ],
    np.float64,
)
"""Rotations that bring +z, -z, +x, -x, +y, -y of the file to +z."""


def load_mesh(path: Path) -> Mesh:
    """Read a triangle mesh in metres (.ply, .obj, .stl); axes as in the file.

    Raises
    ------
    RecordingError : there are no triangles in it.
    ConfigError : Open3D is not installed.
    """
    try:
        import open3d  # noqa: PLC0415  # an extra
    except ImportError as error:
        msg = f"{path}: meshes are read by Open3D: pip install 'shapecat[meshes]' ({error})"
        raise ConfigError(msg) from error
    read: Any = open3d.io.read_triangle_mesh(path)
    if len(read.triangles) == 0:
        msg = f"{path}: no triangles found; expected a triangle mesh in metres"
        raise RecordingError(msg)
    return Mesh(np.asarray(read.vertices), np.asarray(read.triangles, np.int32))


def uprighted(mesh: Mesh, category: str) -> Mesh:
    """Stand a mesh upright: find which of its six axes is up, from its shape.

    The axis of a turned body is the one about which its hull is roundest. A cup, bowl or plate
    opens upward: seen from above its surface lies deepest under its hull. The top of a bottle is
    its narrow end. A can and a ball have no top; a box stands as its file says.
    """
    points = np.asarray(mesh.vertices, np.float64)
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    if category in {"box", "ball"}:
        return standing(mesh)
    if category in {"bottle", "can"}:
        scores = [_roundness(points @ r.T) for r in _AXES[::2]]
        if category == "bottle":
            scores = [
                s + float(np.ptp(points @ r[2])) * 4
                for s, r in zip(scores, _AXES[::2], strict=True)
            ]
        best = 2 * int(np.argmax(scores))
        if category == "bottle" and _narrow_end(points @ _AXES[best].T, mesh.triangles) < 0:
            best += 1
    else:
        best = int(np.argmax([_hollow(points @ r.T, mesh) for r in _AXES]))
    return standing(moved(mesh, Pose(_AXES[best], np.zeros(3))))


def upright_poses(mesh: Mesh, category: str) -> tuple[Rest, ...]:
    """Return the ways a mesh can rest, in terms of its own axes, upright first.

    Raises
    ------
    ValueError : no face of its hull is stable; the mesh is not of this world.
    """
    found = rests(uprighted(mesh, category))
    if not found:
        msg = f"a {category} that cannot stand or lie"
        raise ValueError(msg)
    order = {"upright": 0, "lying": 1, "upside_down": 2}
    return tuple(sorted(found, key=lambda rest: order[rest.manner]))


def fill_ratio(mesh: Mesh) -> float:
    """Return the volume of the hull by that of the bounding box: pi / 4 for a cylinder."""
    hull = ConvexHull(np.asarray(mesh.vertices, np.float64))
    return float(hull.volume / np.prod(np.asarray(mesh.extents, np.float64)))


def _roundness(points: F8) -> float:
    """Return 1 if the outline seen along z is a circle, less the further it is from one."""
    angle = np.arange(16) * (np.pi / 16)
    flat = points[:, :2] @ [np.cos(angle), np.sin(angle)]
    widths = np.ptp(flat, axis=0)
    return float(widths.min() / widths.max())


def _narrow_end(points: F8, triangles: I4) -> float:
    """Return whether the upper part is narrower (positive) or wider than the lower part."""
    low, high = points[:, 2].min(), points[:, 2].max()
    levels = np.linspace(low, high, 18)[1:-1]
    areas = [_slice_area(points[triangles], float(z)) for z in levels]
    return sum(areas[:8]) - sum(areas[8:])


def _slice_area(corners: F8, z: float) -> float:
    """Return the area of the hull of a level cut through triangles (m, 3, 3)."""
    a, b = corners, np.roll(corners, -1, axis=1)
    cut = (a[..., 2] < z) != (b[..., 2] < z)
    a, b = a[cut], b[cut]
    if len(a) < 3:
        return 0.0
    share = (z - a[:, 2]) / (b[:, 2] - a[:, 2])
    return float(ConvexHull(a[:, :2] + share[:, None] * (b[:, :2] - a[:, :2])).volume)


def _hollow(points: F8, mesh: Mesh) -> float:
    """Return how far, on average, the surface seen from above lies below the top: its opening."""
    turned = Mesh(points, mesh.triangles)
    far = 40 * float(np.abs(points).max())
    span = float(np.abs(points[:, :2]).max())
    camera = Camera(64, 64, 31 * far / span, 31 * far / span, 31.5, 31.5)
    above = Pose(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array([0, 0, far]))
    image = render(geometry([(turned, Pose(np.eye(3), np.zeros(3)))]), camera, above)
    seen = image.owners >= 0
    height = far - image.depth
    middle = np.zeros_like(seen)
    middle[20:44, 20:44] = True
    inside = height[seen & middle]
    if inside.size == 0:
        return 0.0
    return float(points[:, 2].max() - np.median(inside)) / span
