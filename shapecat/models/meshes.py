"""Views of scanned and CAD meshes, which the simulator did not make: what a model is judged by."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapecat.models.worlds import WorldView, simulate_mesh
from shapecat.simulation.scans import load_mesh, upright_poses, uprighted

__all__ = ["mesh_views"]

_PLACEMENTS = {"upright": 3, "lying": 2}
"""How many in two, of each manner of resting."""
_NEVER_LIE = {"ball", "bowl", "plate"}


def mesh_views(
    folder: Path, *, seed: int, placements: int = 2, cameras: int = 2
) -> Iterator[WorldView]:
    """Yield views of each mesh of ``<category>/*.ply``, alone on a table.

    Parameters
    ----------
    placements : 3 upright and 2 lying ones for each of these; what never lies stands in all.
    cameras : views of each placement; those of one placement share the name of their instance.

    Raises
    ------
    RecordingError : one of the files is not a mesh.
    """
    for number, path in enumerate(sorted(folder.glob("*/*.ply"))):
        label = path.parent.name
        rng = np.random.default_rng((seed, number))
        mesh = uprighted(load_mesh(path), label)
        found = upright_poses(mesh, label)
        for manner, share in _PLACEMENTS.items():
            wanted = "upright" if label in _NEVER_LIE else manner
            fitting = [rest for rest in found if rest.manner == wanted] or list(found)
            for k in range(share * placements):
                rest = fitting[int(rng.integers(len(fitting)))]
                name = f"{label}/{path.stem}/{manner}_{k}"
                yield from simulate_mesh(mesh, label, name, rest, cameras=cameras, rng=rng)
