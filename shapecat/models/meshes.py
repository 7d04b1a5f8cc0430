"""Views of scanned and CAD meshes, for evaluation on shapes that the simulator does not make."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from shapecat.arrays import F8, I4
from shapecat.errors import ConfigError, RecordingError
from shapecat.geometry import IDENTITY
from shapecat.models.simulated_views import SimulatedView, simulate_mesh
from shapecat.simulation.camera.render import geometry, render
from shapecat.simulation.shapes.mesh import Mesh, moved, standing
from shapecat.simulation.shapes.stable_poses import stable_poses
from shapecat.types import Camera, Pose

__all__ = ["load_mesh", "mesh_views", "uprighted"]

_PLACEMENTS = {"upright": 3, "lying": 2}
"""Number of placements in each resting pose, per round (see `mesh_views`)."""
_NEVER_LIE = {"ball", "bowl", "plate"}
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
"""Rotations that turn the axes +z, -z, +x, -x, +y and -y of the file to +z, in this order."""


def mesh_views(
    folder: Path, *, seed: int, placements: int = 2, cameras: int = 2
) -> Iterator[SimulatedView]:
    """Yield views of each mesh in ``<category>/*.ply``, alone on a table.

    Parameters
    ----------
    placements : number of rounds. In each, a mesh is placed 3 times upright and 2 times lying;
        balls, bowls and plates are always upright. A mesh without such a stable pose gets any other
        stable pose.
    cameras : number of images of each placement; their views share an instance name.

    Raises
    ------
    RecordingError : a file is not a mesh.
    ConfigError : Open3D is not installed.
    """
    for number, path in enumerate(sorted(folder.glob("*/*.ply"))):
        label = path.parent.name
        rng = np.random.default_rng((seed, number))
        mesh = uprighted(load_mesh(path), label)
        poses = stable_poses(mesh)
        for resting_pose, share in _PLACEMENTS.items():
            pose_name = "upright" if label in _NEVER_LIE else resting_pose
            fitting = [stable for stable in poses if stable.name == pose_name] or poses
            for k in range(share * placements):
                stable = fitting[int(rng.integers(len(fitting)))]
                name = f"{label}/{path.stem}/{resting_pose}_{k}"
                yield from simulate_mesh(mesh, label, name, stable, cameras=cameras, rng=rng)


def load_mesh(path: Path) -> Mesh:
    """Read a triangle mesh in metres (.ply, .obj, .stl), with the axes of the file.

    Raises
    ------
    RecordingError : the file holds no triangles.
    ConfigError : Open3D is not installed.
    """
    try:
        import open3d  # noqa: PLC0415  # an extra
    except ImportError as error:
        how = "in a clone of shapecat, pip install '.[meshes]'"
        msg = f"{path}: reading meshes needs Open3D: {how} ({error})"
        raise ConfigError(msg) from error
    read: Any = open3d.io.read_triangle_mesh(path)
    if len(read.triangles) == 0:
        msg = f"{path}: no triangles found; expected a triangle mesh in metres"
        raise RecordingError(msg)
    return Mesh(np.asarray(read.vertices), np.asarray(read.triangles, np.int32))


def uprighted(mesh: Mesh, category: str) -> Mesh:
    """Turn a mesh upright and stand it on z = 0; its category tells which direction is up.

    For a can, this is the axis along which the outline looks roundest. For a bottle, the length
    along the axis counts, too, and the narrow end is up. Boxes and balls keep the axes of the file.
    Any other mesh, such as a cup, is turned so that its inside, seen from above, lies as deep as
    possible below its top.
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


def _roundness(points: F8) -> float:
    """Return the smallest width of points (n, 3), seen along z, divided by the largest width."""
    angle = np.arange(16) * (np.pi / 16)
    flat = points[:, :2] @ [np.cos(angle), np.sin(angle)]
    widths = np.ptp(flat, axis=0)
    return float(widths.min() / widths.max())


def _narrow_end(points: F8, triangles: I4) -> float:
    """Return a positive number if the upper half is narrower than the lower half, else <= 0.

    ``points`` (n, 3) and ``triangles`` (m, 3) are those of the mesh.
    """
    low, high = points[:, 2].min(), points[:, 2].max()
    levels = np.linspace(low, high, 18)[1:-1]
    areas = [_slice_area(points[triangles], float(z)) for z in levels]
    return sum(areas[:8]) - sum(areas[8:])


def _slice_area(corners: F8, z: float) -> float:
    """Return the area of the section of triangles (m, 3, 3) at ``z``, taken to be convex."""
    a, b = corners, np.roll(corners, -1, axis=1)
    cut = (a[..., 2] < z) != (b[..., 2] < z)
    a, b = a[cut], b[cut]
    if len(a) < 3:
        return 0.0
    share = (z - a[:, 2]) / (b[:, 2] - a[:, 2])
    return float(ConvexHull(a[:, :2] + share[:, None] * (b[:, :2] - a[:, :2])).volume)


def _hollow(points: F8, mesh: Mesh) -> float:
    """Return the depth of the middle below the top, relative to the largest absolute x or y.

    The mesh is rendered from above; the depth is the median over the pixels in the middle of the
    image, 0 if nothing is visible there. ``points`` (n, 3) are the vertices, turned.
    """
    turned = Mesh(points, mesh.triangles)
    distance = 40 * float(np.abs(points).max())
    span = float(np.abs(points[:, :2]).max())
    camera = Camera(64, 64, 31 * distance / span, 31 * distance / span, 31.5, 31.5)
    above = Pose(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array([0, 0, distance]))
    image = render(geometry([(turned, IDENTITY)]), camera, above)
    visible = image.mesh_ids >= 0
    height = distance - image.depth
    middle = np.zeros_like(visible)
    middle[20:44, 20:44] = True
    inside = height[visible & middle]
    if inside.size == 0:
        return 0.0
    return float(points[:, 2].max() - np.median(inside)) / span
