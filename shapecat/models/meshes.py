"""Views of scanned and CAD meshes, for evaluation on shapes that the simulator does not make."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapecat.models.simulated_views import SimulatedView, simulate_mesh
from shapecat.simulation.shapes.scans import load_mesh, uprighted
from shapecat.simulation.shapes.stable_poses import stable_poses

__all__ = ["mesh_views"]

_PLACEMENTS = {"upright": 3, "lying": 2}
"""Number of placements in each resting pose, per round (see `mesh_views`)."""
_NEVER_LIE = {"ball", "bowl", "plate"}


def mesh_views(
    folder: Path, *, seed: int, placements: int = 2, cameras: int = 2
) -> Iterator[SimulatedView]:
    """Yield views of each mesh in ``<category>/*.ply``, alone on a table.

    Parameters
    ----------
    placements : number of rounds. In each, a mesh is placed 3 times upright and 2 times lying;
        balls, bowls and plates are always upright. A mesh without such a stable pose gets any.
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
